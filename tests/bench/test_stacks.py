"""The stacks are what they are said to be."""

import numpy as np
import pytest

from mirrorskin.bench.stacks import LEVELS, fill, noise_of, references

SHAPE = (40, 90, 120)
DTYPES = pytest.mark.parametrize("dtype", sorted(LEVELS))


def light(stack, dtype):
    """Return where a stack is light, and the stack."""
    frames = np.zeros(SHAPE, dtype)
    fill(frames, stack)
    dark, bright = references(SHAPE[1:], frames.dtype)
    return frames >= (dark + bright) / 2, frames


@DTYPES
@pytest.mark.parametrize("stack", ["press", "random"])
def test_a_stack_is_the_same_every_time(stack, dtype):
    np.testing.assert_array_equal(light(stack, dtype)[1], light(stack, dtype)[1])


@DTYPES
def test_a_press_leaves_a_hole_and_the_corners_dark_and_runs_outwards(dtype):
    is_light, _ = light("press", dtype)
    first = np.where(is_light.any(axis=0), is_light.argmax(axis=0), -1)
    assert first[45, 60] == -1
    assert first[0, 0] == first[-1, -1] == -1
    assert 0.5 < np.mean(first > 0) < 0.9
    assert np.all(np.diff(first[45, 90:112]) >= 0)


@DTYPES
def test_a_press_takes_some_frames_to_turn_a_pixel_light(dtype):
    _, frames = light("press", dtype)
    dark, bright = references(SHAPE[1:], frames.dtype)
    with np.errstate(invalid="ignore"):
        share = (frames - dark) / (bright - dark)
    between = ((share > 0.1) & (share < 0.9)).sum(axis=0)
    assert {1, 2, 3} <= set(between.flat)


@DTYPES
def test_in_the_worst_case_neighbours_differ_and_an_eighth_stays_dark(dtype):
    is_light, _ = light("random", dtype)
    first = np.where(is_light.any(axis=0), is_light.argmax(axis=0), -1)
    assert np.mean(first == -1) == pytest.approx(0.13, abs=0.02)
    assert np.mean(first[:, 1:] == first[:, :-1]) < 0.06
    assert first.max() == SHAPE[0] - 1


@DTYPES
def test_the_noise_is_as_said(dtype):
    _, frames = light("press", dtype)
    corner = frames[:, :4, :4].astype(float)
    if dtype == "float32":
        assert np.isnan(frames).any()
    assert np.nanstd(corner, axis=0).mean() == pytest.approx(noise_of(np.dtype(dtype)), rel=0.1)


@DTYPES
def test_references_are_a_mean_of_eight_and_some_pixels_are_dead(dtype):
    dark, bright = references(SHAPE[1:], np.dtype(dtype))
    assert np.array_equal(8 * dark, np.rint(8 * dark))
    assert 0 < np.isnan(bright).sum() <= 2
    assert np.all(np.nan_to_num(bright, nan=1e9) > dark)
