"""The turns are what they are said to be."""

import numpy as np
import pytest
import rotations

from mirrorskin.bench.turns import SCALES, STEPS, TILT, fill, lost, noise_of, phases

SHAPE = (60, 80)
DTYPES = pytest.mark.parametrize("dtype", sorted(SCALES))


def stack(dtype, count=STEPS):
    frames = np.zeros((count, *SHAPE), dtype)
    fill(frames)
    return frames


@DTYPES
def test_a_stack_is_the_same_every_time(dtype):
    np.testing.assert_array_equal(stack(dtype), stack(dtype))


@DTYPES
def test_the_noise_is_as_said_and_turns_repeat_but_for_it(dtype):
    frames = stack(dtype, 16 * STEPS).astype(float).reshape(16, STEPS, *SHAPE)
    spread = frames.std(axis=0, ddof=1)
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(noise_of(np.dtype(dtype)), rel=0.03)
    assert np.abs(frames.mean(axis=(2, 3)) - frames.mean(axis=(0, 2, 3))).max() < 0.1 * spread.mean()


@DTYPES
def test_no_sample_is_clipped_and_zeniths_go_up_to_sixty_degrees(dtype):
    frames, (offset, gain, noise) = stack(dtype), SCALES[dtype]
    assert np.all(frames > offset - 5 * noise)
    if dtype != "float32":
        assert frames.max() < np.iinfo(dtype).max
    zenith = np.degrees((frames.astype(float).mean(axis=0) - offset) / gain)
    assert zenith.max() > 55
    assert zenith.max() < 62


def test_samples_are_those_of_equation_10_where_contact_lasts():
    offset, gain, noise = SCALES["float32"]
    frames = stack("float32", 40 * STEPS).reshape(40, STEPS, *SHAPE)
    frames = np.nanmean(frames, axis=0, dtype=np.float64)
    y, x = np.meshgrid(*((np.arange(n) + 0.5) / 10 % 1 * 2 - 1 for n in SHAPE), indexing="ij")
    radius = np.hypot(x, y)
    zenith = np.arcsin(np.sin(np.radians(60)) * np.where(radius <= 1, radius, 0))
    normals = rotations.direction(zenith, np.arctan2(-y, x))
    angle = np.stack([rotations.between(normals, axis) for axis in rotations.axes(phases(STEPS), TILT)])
    error = np.abs(frames - offset - gain * angle)
    assert error[:, ~lost(SHAPE)].max() < 6 * noise / np.sqrt(40)
    assert np.all(error[:, lost(SHAPE)].max(axis=0) > 10)


def test_some_pixels_lose_contact_and_most_do_not():
    assert 0.02 < lost((540, 960)).mean() < 0.08
    assert lost(SHAPE).any()


def test_large_float_stacks_have_samples_that_are_no_numbers():
    frames = np.zeros((STEPS, 360, 400), np.float32)
    fill(frames)
    assert np.isnan(frames).sum() == 1
