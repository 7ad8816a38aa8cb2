"""The noise of a press is estimated from all frames: the first two may be equal, or unsettled."""

import warnings

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.io.files.arrays import ArrayRecording

NOISE = float(np.hypot(1.5, 1 / np.sqrt(12)))
TRAVEL = 0.02 * np.arange(60)


def press(first):
    """Return a press whose first frames are equal, or settle; pixels are under way in some frames."""
    generator = np.random.default_rng(7)
    onset = generator.uniform(0.2, 1.0, (60, 80))
    light = np.clip((TRAVEL[:, None, None] - onset) / 0.03 + 0.5, 0, 1)
    lamp = np.ones(60)
    if first == "settling":
        lamp[:2] = 1.6, 1.3
    counts = 30 + 150 * light * lamp[:, None, None] + generator.normal(0, 1.5, light.shape)
    if first == "settling":
        counts[:2] += np.array([9.0, 0.0])[:, None, None] * generator.normal(0, 1, (2, 60, 80))
    frames = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    if first == "twice":
        frames[1] = frames[0]
    return frames


@pytest.mark.parametrize("method", ["threshold", "change-point"])
@pytest.mark.parametrize("first", ["as it should be", "twice", "settling"])
def test_it_is_that_of_the_camera(first, method):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        source = ArrayRecording(press(first), {"travel": TRAVEL}, {"dark": 30.0, "bright": 180.0})
        result = engine.reconstruct(source, method=method)
    assert result.process["noise"] == pytest.approx(NOISE, rel=0.08)


@pytest.mark.parametrize("first", ["as it should be", "twice"])
def test_a_function_of_arrays_gives_what_a_recording_gives(first):
    frames = press(first)
    source = ArrayRecording(frames, {"travel": TRAVEL}, {"dark": 30.0, "bright": 180.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.MirrorskinWarning)
        recorded = engine.reconstruct(source)
        onset = engine.find_onset(frames, TRAVEL, dark=30.0, bright=180.0)
    np.testing.assert_array_equal(onset.height_sigma, recorded.height_sigma)


def test_what_was_given_stays():
    source = ArrayRecording(press("as it should be"), {"travel": TRAVEL}, {"dark": 30.0, "bright": 180.0})
    assert engine.reconstruct(source, noise=5.0).process["noise"] == 5.0
