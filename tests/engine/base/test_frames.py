"""The noise is estimated from two samples of each pixel, whatever else changes between them."""

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine.base.frames import SAMPLES, estimate_noise, thinned
from mirrorskin.io import InputError

RANDOM = np.random.default_rng(0)


def two_looks(noise, changed=0.0, count=60_000):
    first, second = (30 + RANDOM.normal(0, noise, count) for _ in range(2))
    second[: int(changed * count)] += 100 * noise
    return first, second


@pytest.mark.parametrize("changed", [0.0, 0.1, 0.45])
@pytest.mark.parametrize("noise", [0.01, 1.5, 20.0])
def test_the_noise_is_found_among_changes(noise, changed):
    assert estimate_noise(*two_looks(noise, changed), integer=False) == pytest.approx(noise, rel=0.05)


def test_rounding_is_the_least_noise_of_whole_numbers():
    still = np.full(100, 7.0)
    assert estimate_noise(still, still, integer=True) == pytest.approx(1 / np.sqrt(12))
    assert estimate_noise(still, still, integer=False) == 0


def test_samples_that_are_no_numbers_are_left_out():
    first, second = two_looks(1.5)
    first[::3], second[::5], first[::7], second[::7] = np.nan, np.inf, np.inf, np.inf
    assert estimate_noise(first, second, integer=False) == pytest.approx(1.5, rel=0.05)
    nothing = np.full(9, np.nan)
    assert estimate_noise(nothing, nothing, integer=False) == 0


def test_samples_are_taken_from_all_over_the_frame():
    frame = np.arange(10 * SAMPLES, dtype=np.float32).reshape(10, SAMPLES)
    [samples] = thinned(frame)
    assert SAMPLES <= len(samples) < 2 * SAMPLES
    assert samples[-1] > 0.99 * frame.max()
    assert len(thinned(frame[:1, :9])[0]) == 9


@pytest.mark.parametrize("dtype", ["?", "i1", "i2", ">u2", "i8", "f2", "f8"])
def test_frames_of_other_types_are_converted(dtype):
    frames = np.zeros((5, 1, 2), dtype)
    frames[3:, 0, 0] = 1
    onset = engine.find_onset(frames, [0.0, 0.1, 0.2, 0.3, 0.4], dark=0, bright=1, noise=0.01)
    np.testing.assert_allclose(onset.height, [[-0.25, np.nan]], rtol=1e-6)


def test_the_frame_that_cannot_be_converted_is_named_across_pushes():
    run = engine.Run(engine.Onset(dark=0, bright=100))
    run.push(np.zeros((3, 1, 2), np.int16), travel=[0.0, 0.1, 0.2])
    with pytest.raises(InputError, match="frames: frame 4 has a sample of -1; int16 is read as uint16"):
        run.push(np.array([[[0, 0]], [[0, -1]]], np.int16), travel=[0.3, 0.4])


def test_one_frame_is_not_a_stack():
    with pytest.raises(InputError, match=r"uint8 \(4, 5\): for a single frame, pass frame\[None\]"):
        engine.find_onset(np.zeros((4, 5), np.uint8), [0.0])


def test_frames_along_the_last_axis_have_a_remedy():
    frames, travel = np.zeros((20, 30, 5), np.uint8), 0.1 * np.arange(5)
    for call in (
        lambda: engine.find_onset(frames, travel),
        lambda: engine.reconstruct(frames, travel=travel),
    ):
        with pytest.raises(InputError, match=r"numpy\.moveaxis\(frames, -1, 0\)"):
            call()


@pytest.mark.parametrize("name", ["reference", "dark"])
def test_masked_counts_are_unknown(name):
    frames = np.zeros((5, 6, 8), np.uint8)
    frames[3:] = 200
    level = np.ma.masked_array(np.full((6, 8), 10, np.uint8), np.arange(48).reshape(6, 8) == 7)
    if name == "dark":
        onset = engine.find_onset(frames, 0.1 * np.arange(5), dark=level, bright=200)
        assert np.isnan(onset.height[0, 7])
        assert np.isfinite(onset.height).sum() == 47
    else:
        with pytest.raises(InputError, match="the reference has samples that are not finite"):
            engine.slip.find_displacement(level, frames.astype(np.float32), 0.1)
