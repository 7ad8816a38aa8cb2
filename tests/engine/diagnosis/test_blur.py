"""A blurring lens moves the heights of a curved surface; their standard deviations include that."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mirrorskin import engine

SHAPE, STEP, NOISE = (60, 70), 0.02, 1.5
TRAVEL = np.arange(0.1, 1.0, STEP)
LEVELS = {"dark": 20.0, "bright": 220.0}


def bowl(radius):
    """Heights of a paraboloid, mm, at pixels of 0.05 mm and 4 x 4 points in each."""
    fine = [(np.arange(4 * n) - (4 * n - 1) / 2) * 0.0125 for n in SHAPE]
    return -0.2 - (fine[0][:, np.newaxis] ** 2 + fine[1] ** 2) / (2 * radius)


def pressed(blur, radius=2.5, travel=TRAVEL):
    """Return frames of a press, and the heights in the middle of each pixel."""
    height = bowl(radius)
    frames = np.empty((len(travel), *SHAPE), np.float32)
    for number, lowered in enumerate(travel):
        touched = (lowered >= -height).astype(np.float32)
        blurred = gaussian_filter(touched, 4 * blur, mode="nearest") if blur else touched
        frames[number] = 20 + 200 * blurred.reshape(SHAPE[0], 4, SHAPE[1], 4).mean(axis=(1, 3))
    frames += np.random.default_rng(1).normal(0, NOISE, frames.shape)
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8), bowl(radius).reshape(
        SHAPE[0], 4, SHAPE[1], 4
    ).mean(axis=(1, 3))


def reconstruct(frames, travel=TRAVEL, **options):
    return engine.reconstruct(frames, travel=travel, pixel_size=0.05, fill=False, **LEVELS, **options)


def chi_square(result, truth):
    inner = (slice(6, -6),) * 2
    return np.nanmean(((result.height - truth) / result.height_sigma)[inner] ** 2)


@pytest.mark.parametrize("method", ["threshold", "change-point"])
@pytest.mark.parametrize("blur", [0.7, 1.5])
def test_the_standard_deviation_contains_what_a_lens_moved(blur, method):
    frames, truth = pressed(blur)
    assert chi_square(reconstruct(frames, method=method), truth) < 1.5


@pytest.mark.parametrize("blur", [0.7, 1.5])
def test_the_blur_is_estimated(blur):
    assert reconstruct(pressed(blur)[0]).process["blur"] == pytest.approx(blur, rel=0.15)


@pytest.mark.parametrize("method", ["threshold", "change-point"])
@pytest.mark.parametrize("size", [14, 60])
@pytest.mark.parametrize("every", [1, 2, 5])
def test_no_blur_is_found_in_a_sharp_picture(every, size, method):
    travel = TRAVEL[::every]
    frames = pressed(0.0, travel=travel)[0][:, :size, :size]
    assert "blur" not in reconstruct(frames, travel, method=method).process


def test_a_release_shows_the_same_blur_as_a_press():
    frames, _ = pressed(1.5)
    press, release = reconstruct(frames), reconstruct(frames[::-1], TRAVEL[::-1], event="release")
    assert release.process["blur"] == press.process["blur"]


def test_a_blur_that_is_given_is_used():
    frames, _ = pressed(0.0)
    sharp, blurred = (reconstruct(frames, blur=blur) for blur in (0, 1.5))
    assert np.nanmin(blurred.height_sigma / sharp.height_sigma) >= 1
    assert np.nanmedian(blurred.height_sigma) > np.nanmedian(sharp.height_sigma)


def test_undefined_heights_stay_undefined():
    frames, _ = pressed(1.5)
    frames[:, 20:30, 20:30] = 20
    result = reconstruct(frames)
    np.testing.assert_array_equal(np.isnan(result.height_sigma), np.isnan(result.height))
