"""Full light found among half light and none: pixels whose truth is known."""

import numpy as np
import pytest
from reference_frames import rolled

from mirrorskin.engine.calibration.levels import find_plateau

PIXELS = (1, 4000)


def found_and_true(count, full, half, noise=2.0, dtype="uint8", level=200.0, seed=2):
    generator = np.random.default_rng(seed)
    dark = 16 + 3 * generator.standard_normal(PIXELS)
    light = level * (1 + 0.05 * generator.standard_normal(PIXELS))
    frames = rolled(dark, light, count, full, half, noise, dtype, seed)
    samples = frames.reshape(count, -1).astype(np.float64)
    found = find_plateau(samples, dark.ravel(), np.dtype(dtype).kind == "u")
    return found, (dark + light).ravel()


@pytest.mark.parametrize(
    ("count", "full", "half", "dtype"),
    [(150, 0.3, 0.1, "uint8"), (60, 0.3, 0.2, "uint8"), (100, 0.3, 0.3, "float32")],
)
def test_full_light_is_free_of_bias_and_its_error_honest(count, full, half, dtype):
    found, truth = found_and_true(count, full, half, dtype=dtype, level=180.0)
    error = found.value - truth
    assert np.isfinite(error).mean() > 0.99
    error, sigma = error[np.isfinite(error)], found.sigma[np.isfinite(error)]
    assert abs(error.mean()) < 0.1 * np.median(sigma)
    assert np.mean((error / sigma) ** 2) == pytest.approx(1, abs=0.08)
    assert np.median(sigma) < 1.3 * 2.0 / np.sqrt(count * full)


def test_the_brightest_samples_would_be_biased():
    found, truth = found_and_true(150, 0.3, 0.1, level=180.0)
    assert np.mean(found.value - truth) < 0.05
    assert np.nanmedian(found.noise) == pytest.approx(2.02, rel=0.05)
    assert np.median(found.count) == pytest.approx(45, abs=3)


def test_a_glint_is_no_full_light():
    generator = np.random.default_rng(4)
    samples = 200 + 2 * generator.standard_normal((40, 300))
    samples[3, :20] = 250
    samples[9, :20] = 240
    found = find_plateau(samples, np.full(300, 16.0), False)
    assert abs(np.mean(found.value[:20]) - 200) < 0.25
    assert np.all(found.count[:20] <= 38)


def test_a_pixel_that_was_never_in_full_light_often_enough_has_none():
    generator = np.random.default_rng(4)
    samples = 16 + generator.standard_normal((40, 300))
    samples[:20, :200] += 180
    samples[:3, 200:] += 180
    samples[:, 299] = np.nan
    found = find_plateau(samples, np.full(300, 16.0), False)
    assert np.isfinite(found.value[:200]).all()
    assert np.isnan(found.value[200:]).all()


def test_a_sharp_plateau_of_whole_numbers_is_told_within_its_rounding():
    samples = np.where(np.arange(30)[:, np.newaxis] % 3 == 0, 200.0, 16.0) + np.zeros((30, 50))
    found = find_plateau(samples, np.full(50, 16.0), True)
    np.testing.assert_array_equal(found.value, 200)
    np.testing.assert_allclose(found.sigma, 12**-0.5)
