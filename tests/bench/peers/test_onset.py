"""The peers that are installed: each against a loop over pixels and against the kernels' references."""

import numpy as np
import pytest
from presses import SPEC, first_run, numpy_onset, random_press

from mirrorskin.bench.peers.onset import References, find_peers
from mirrorskin.engine.frames import reference_maps
from mirrorskin.kernels.onset import onset_levels

FOUND, ABSENT = find_peers()
BY_NAME = pytest.mark.parametrize("peer", FOUND, ids=lambda peer: peer.name)
DTYPES = pytest.mark.parametrize("dtype", sorted(SPEC))


def slow_first_light(frames, light, hold):
    """Follow each pixel by itself."""
    light = np.broadcast_to(light, frames.shape[1:])
    onset = np.empty(frames.shape[1:], np.int32)
    for place in np.ndindex(onset.shape):
        series = frames[(slice(None), *place)]
        onset[place] = first_run(series >= light[place], hold)
        decided = onset[place] + hold if onset[place] >= 0 else len(series)
        if not np.isfinite(series[:decided]).all():
            onset[place] = -2
    return onset


def test_what_is_always_installed_is_found():
    assert {peer.name for peer in FOUND} >= {"NumPy", "NumPy argmax", "OpenCV"}
    assert set(ABSENT.values()) <= {"not installed"}


@BY_NAME
@DTYPES
@pytest.mark.parametrize("hold", [1, 2])
@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("count", [2, 30, 600])
def test_a_peer_finds_the_first_run(peer, dtype, hold, each, count):
    frames = random_press(dtype, count, (7, 9), seed=count, noise=0.2)
    frames[-1, 0, 0], frames[:-1, 0, 0] = SPEC[dtype][1], 0  # light in the last frame alone
    if dtype == "float32":
        frames[count // 2, 1] = np.nan
        frames[-1, 2, ::2] = np.inf
        frames[0, 2, 1] = -np.inf
    light = np.asarray(np.mean(SPEC[dtype])).astype(dtype)
    if each:
        light = (light * np.random.default_rng(0).uniform(0.9, 1.1, (7, 9))).astype(dtype)
    found = peer.first_light(frames, light, hold)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, slow_first_light(frames, light, hold))


@BY_NAME
def test_tiles_and_stripes_join_without_a_seam(peer):
    frames = np.zeros((3, 450, 1000), np.uint8)
    onset = np.arange(450 * 1000).reshape(450, 1000) % 4
    for number, frame in enumerate(frames):
        frame[onset <= number] = 200
    expected = np.where(onset == 3, -1, onset)
    np.testing.assert_array_equal(peer.first_light(frames, np.asarray(np.uint8(120)), 1), expected)


@BY_NAME
@DTYPES
def test_a_peer_answers_as_the_references_do(peer, dtype):
    if peer.heights is None:
        assert peer.name == "NumPy argmax"
        return
    frames = random_press(dtype, 40, (33, 61), seed=3)
    generator = np.random.default_rng(6)
    dark, bright = (level * generator.uniform(0.8, 1.2, (33, 61)) for level in SPEC[dtype])
    bright[3, 4] = np.nan
    if dtype == "float32":
        frames[::7, 5, ::3] = np.nan
    noise = 0.008 * (SPEC[dtype][1] - SPEC[dtype][0])
    travel = np.cumsum(generator.uniform(0.001, 0.2, 40)) - 1.7
    low, high = reference_maps(dark, bright, (33, 61), np.dtype(dtype))
    level, plateau, light = onset_levels(high, low, 0.5, np.dtype(dtype))
    known = References(level, light, plateau)

    found = peer.heights(frames, travel, known, noise)
    expected = numpy_onset(frames, travel, dark, bright, noise)
    np.testing.assert_array_equal(found.status, expected.status)
    assert {0, 1, 2, 3} == set(found.status.flat)
    np.testing.assert_allclose(found.height, expected.height, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-5)
