"""The peers that are installed: each against the kernels' reference, and against the truth without noise."""

import numpy as np
import pytest
import rotations
from rotations import UNEVEN, Setup

from mirrorskin.bench.peers.normals import Turn, find_peers
from mirrorskin.bench.peers.normals.odd import answer

FOUND, _ = find_peers()
BY_NAME = pytest.mark.parametrize("peer", FOUND, ids=lambda peer: peer.name)
SETUPS = {
    "uint8": Setup(phase=UNEVEN),
    "uint16": Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16", phase=UNEVEN),
    "float32": Setup(gain=5.0, noise=1.5, offset=9.0, dtype="float32", phase=UNEVEN),
}


def turn_of(setup, noise=None):
    low, high = (0, np.iinfo(setup.dtype).max) if setup.dtype != "float32" else (-np.inf, np.inf)
    known = np.array(setup.phase), setup.tilt, setup.offset, setup.slope
    return Turn(*known, setup.spread if noise is None else noise, low, high)


def picture(setup, shape, seed=0):
    """Normals all over the cap that a sensor sees, and their frames; some pixels lose contact."""
    generator = np.random.default_rng(seed)
    zenith = np.radians(60) * np.sqrt(generator.random(shape))
    normals = rotations.direction(zenith, generator.uniform(-np.pi, np.pi, shape))
    frames = rotations.expose(normals, setup, seed)
    sunken = frames[0, ::7, ::3].astype(float) - 12 * setup.gain
    frames[2:5, ::7, ::3] = np.maximum(sunken, setup.offset).astype(setup.dtype)
    return normals, frames


def compare(found, frames, turn):
    """Compare with the reference; contact but where limits a thousandth wider or narrower would change it."""
    expected = answer(frames, turn, np.arange(frames[0].size))
    maps = found.flat()
    apart = np.abs(maps.vectors - expected.vectors).max(axis=1)
    assert np.array_equal(np.isnan(maps.sigma), np.isnan(expected.sigma))
    assert np.nanmax(np.where(expected.contact, apart / expected.sigma, 0)) < 5e-3
    assert np.count_nonzero(apart > 1e-3) <= 0.01 * np.count_nonzero(~expected.contact)
    np.testing.assert_allclose(maps.sigma, expected.sigma, rtol=1e-3)
    np.testing.assert_allclose(maps.mean, expected.mean, rtol=1e-6)
    wide, narrow = (answer(frames, turn, np.arange(frames[0].size), by).contact for by in (1.001, 0.999))
    sure = wide == narrow
    np.testing.assert_array_equal(maps.contact[sure], expected.contact[sure])
    return expected


def test_what_is_always_installed_is_found():
    assert "NumPy" in {peer.name for peer in FOUND}


@BY_NAME
@pytest.mark.parametrize("dtype", sorted(SETUPS))
def test_a_peer_answers_as_the_reference_does(peer, dtype):
    setup = SETUPS[dtype]
    _, frames = picture(setup, (33, 61))
    if dtype == "float32":
        frames[4, 5, ::9] = np.nan
        frames[:, 7, 8] = np.nan
    else:
        frames[1, 5, ::9], frames[2, 6, ::9] = 0, np.iinfo(dtype).max
    expected = compare(peer.normals(frames, turn_of(setup)), frames, turn_of(setup))
    assert 0.8 < expected.contact.mean() < 0.97


@BY_NAME
def test_without_noise_a_peer_finds_the_truth(peer):
    setup = Setup(gain=5.0, noise=1e-9, offset=3.0, dtype="float32")
    normals = rotations.random_normals(40, seed=1)
    frames = rotations.expose(normals, setup, seed=1)
    found = peer.normals(frames, turn_of(setup, noise=0.01))
    assert np.degrees(rotations.between(found.vectors, normals)).max() < 0.01
    assert found.contact.all()


@BY_NAME
def test_level_and_equal_samples_have_an_answer(peer):
    setup = Setup()
    frames = np.full((8, 3, 5), 21, np.uint8)
    found = peer.normals(frames, turn_of(setup))
    np.testing.assert_allclose(found.vectors, np.broadcast_to([0.0, 0.0, 1.0], (3, 5, 3)), atol=1e-6)
    compare(found, frames, turn_of(setup))


@BY_NAME
def test_noise_that_tells_nothing_leaves_no_answer(peer):
    setup = SETUPS["uint8"]
    _, frames = picture(setup, (5, 9))
    turn = turn_of(setup, noise=2.0 * setup.slope)
    found = peer.normals(frames, turn)
    assert np.isnan(found.vectors).all()
    assert not found.contact.any()
    compare(found, frames, turn)


@BY_NAME
def test_tiles_join_without_a_seam(peer):
    setup = SETUPS["uint8"]
    _, few = picture(setup, (9, 131))
    frames = np.ascontiguousarray(np.tile(few, (1, 57, 1)))
    found, alone = peer.normals(frames, turn_of(setup)), peer.normals(few, turn_of(setup))
    for values, part in zip(found, alone, strict=True):
        expected = np.tile(part, (57, *(1,) * (part.ndim - 1)))
        np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
