"""The peers that are installed: each against a general solver, and against sums over the window."""

import numpy as np
import pytest
from rotations import UNEVEN

from mirrorskin.bench.peers.correlation import find_peers

FOUND, _ = find_peers()
BY_NAME = pytest.mark.parametrize("peer", FOUND, ids=lambda peer: peer.name)


def swings(phase, shape, seed=0):
    """Waves with noise; uint8."""
    generator = np.random.default_rng(seed)
    mean, azimuth = generator.uniform(60, 180, shape), generator.uniform(-np.pi, np.pi, shape)
    counts = mean + 40 * np.cos(phase[:, np.newaxis, np.newaxis] - azimuth)
    return np.rint(counts + generator.normal(0, 2, counts.shape)).astype(np.uint8)


def least_squares(frames, phase):
    """Return mean, cosine, sine and residual, (4, H, W)."""
    model = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
    values = frames.reshape(len(frames), -1).astype(float)
    wave, *_ = np.linalg.lstsq(model, values, rcond=None)
    residual = np.sqrt(np.sum((values - model @ wave) ** 2, axis=0) / (len(frames) - 3))
    return np.vstack([wave, residual]).reshape(4, *frames.shape[1:])


def compare(found, expected):
    np.testing.assert_allclose(found[:3], expected[:3], atol=1e-3)
    np.testing.assert_allclose(np.square(found.residual), np.square(expected[3]), rtol=1e-3, atol=3e-3)


def test_what_is_always_installed_is_found():
    assert "NumPy" in {peer.name for peer in FOUND}


@BY_NAME
@pytest.mark.parametrize("count", [6, 8, 30, 64])
def test_a_peer_fits_by_least_squares(peer, count):
    phase = np.resize(UNEVEN, count) + 0.01 * np.arange(count)
    frames = swings(phase, (7, 9), seed=count)
    compare(peer.correlate(frames, phase), least_squares(frames, phase))


@BY_NAME
def test_tiles_join_without_a_seam(peer):
    phase = np.array(UNEVEN)
    few = swings(phase, (9, 131))
    frames = np.ascontiguousarray(np.tile(few, (1, 231, 1)))
    expected = np.tile(least_squares(few, phase), (1, 231, 1))
    compare(peer.correlate(frames, phase), expected)


@BY_NAME
def test_a_window_holds_the_sums_of_its_frames(peer):
    generator = np.random.default_rng(0)
    frames = generator.integers(0, 256, (11, 130, 257), np.uint8)
    rows = generator.integers(-(2**17), 2**17, (11, 3), np.int32)
    rows[:, 0] = 1
    sums = np.zeros((4, *frames.shape[1:]), np.int32)
    nothing = np.zeros_like(frames[0])
    for number, frame in enumerate(frames):
        gone, old = (frames[number - 8], rows[number - 8]) if number >= 8 else (nothing, rows[0])
        peer.slide(sums, frame, gone, np.concatenate([rows[number], old]))
    inside = frames[-8:].astype(np.int64)
    expected = [*np.tensordot(rows[-8:].T.astype(np.int64), inside, 1), np.sum(inside**2, axis=0)]
    np.testing.assert_array_equal(sums, expected)
