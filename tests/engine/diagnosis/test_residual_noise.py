"""Read noise and shot noise, from the residuals of a fit of two harmonics."""

import numpy as np
import pytest

from mirrorskin.engine.diagnosis.residual_noise import residual_noise
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, UNEVEN
from mirrorskin.io import InputError

PIXELS = 10_000
LEVELS = np.array([40.0, 120.0, 200.0])
FOUR, SIXTEEN = EIGHTHS[::2], tuple(np.arange(16) * np.pi / 8)


def line(read, slope):
    """The standard deviation at some levels."""
    return np.sqrt(read**2 + slope * LEVELS)


def samples_of(read, slope, *, phase=EIGHTHS, weights=None, second=0.0, dtype="float32", pixels=PIXELS):
    """Waves of all brightnesses and directions, with noise whose variance grows with the light."""
    random = np.random.default_rng(len(phase))
    alpha = np.array(phase)[:, np.newaxis]
    mean, azimuth = random.uniform([[25], [0]], [[220], [7]], (2, pixels))
    light = mean + 10 * np.cos(alpha - azimuth) + second * np.cos(2 * alpha - azimuth)
    weight = np.ones(len(phase)) if weights is None else np.array(weights)
    noise = random.normal(size=light.shape) * np.sqrt((read**2 + slope * light) / weight[:, np.newaxis])
    counts = light + noise
    counts = counts if dtype == "float32" else np.clip(np.rint(counts), 0, np.iinfo(dtype).max)
    return counts.astype(dtype), np.array(phase), weight


@pytest.mark.parametrize("phase", [FOUR, EIGHTHS[:5], UNEVEN, SIXTEEN])
@pytest.mark.parametrize(("read", "slope"), [(1.5, 0.0), (1.0, 0.05), (0.0, 0.02)])
def test_read_and_shot_noise_are_separated(read, slope, phase):
    noise = residual_noise(*samples_of(read, slope, phase=phase))
    np.testing.assert_allclose(noise.at(LEVELS), line(read, slope), rtol=0.03)
    assert noise.slope == pytest.approx(slope, rel=0.1, abs=1e-3 * read)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_rounding_is_noise(dtype):
    noise = residual_noise(*samples_of(1.0, 0.02, dtype=dtype))
    np.testing.assert_allclose(noise.at(LEVELS), np.hypot(line(1.0, 0.02), 1 / np.sqrt(12)), rtol=0.03)


def test_weights_are_inverse_variances_and_the_second_wave_of_a_level_surface_is_no_noise():
    noise = residual_noise(*samples_of(1.0, 0.05, weights=[1, 2, 0.5, 4, 1, 0.1, 1, 3]))
    np.testing.assert_allclose(noise.at(LEVELS), line(1.0, 0.05), rtol=0.03)
    noise = residual_noise(*samples_of(1.0, 0.0, second=5.0))
    np.testing.assert_allclose(noise.at(LEVELS), 1.0, rtol=0.03)


@pytest.mark.parametrize("phase", [FOUR, EIGHTHS, SIXTEEN])
@pytest.mark.parametrize(("read", "slope"), [(1.5, 0.0), (1.0, 0.05)])
def test_pixels_that_lose_contact_are_no_noise(read, slope, phase):
    samples, *series = samples_of(read, slope, phase=phase)
    samples[len(phase) // 2, ::10] = 12.0
    np.testing.assert_allclose(residual_noise(samples, *series).at(LEVELS), line(read, slope), rtol=0.05)


def test_a_bin_that_is_quite_wrong_does_not_bend_the_line_which_does_not_fall():
    samples, *series = samples_of(1.0, 0.05)
    mean = samples.mean(axis=0)
    dark = mean < 40
    samples[3, dark] += np.random.default_rng(1).uniform(-100, 100, dark.sum()).astype(np.float32)
    assert 0.05 < dark.mean() < 0.1
    np.testing.assert_allclose(residual_noise(samples, *series).at(LEVELS), line(1.0, 0.05), rtol=0.1)
    samples, *series = samples_of(1.0, 0.0)
    samples[:, mean > 150] *= 0.5
    samples[:, mean > 150] += 0.5 * mean[mean > 150]
    assert residual_noise(samples, *series).slope == 0.0


@pytest.mark.parametrize(
    ("dtype", "frames", "pixels", "values"),
    [
        ("uint8", slice(0, 8, 2), slice(0, None, 5), 255),
        ("uint8", slice(0, 8, 2), slice(1, None, 5), 0),
        ("float32", slice(2, 3), slice(0, None, 5), np.nan),
        ("float32", slice(2, 3), slice(None), np.nan),
        ("uint8", slice(5, 6), slice(None), 255),
    ],
)
def test_clipped_and_missing_samples_and_frames_are_left_out(dtype, frames, pixels, values):
    samples, *series = samples_of(1.0, 0.0, dtype=dtype)
    samples[frames, pixels] = values
    expected = 1.0 if dtype == "float32" else np.sqrt(13 / 12)
    np.testing.assert_allclose(residual_noise(samples, *series).at(LEVELS), expected, rtol=0.03)


@pytest.mark.parametrize(("dtype", "floor"), [("uint8", 12**-0.5), ("uint16", 12**-0.5), ("float32", 77e-6)])
def test_frames_that_are_all_the_same_have_the_least_noise(dtype, floor):
    for pixels in (1, 1000):
        noise = residual_noise(np.full((8, pixels), 77, dtype), np.array(EIGHTHS), np.ones(8))
        np.testing.assert_allclose(noise.at([0, 77, 1e5]), floor, rtol=1e-6)
        assert noise.slope == 0


@pytest.mark.parametrize(
    "samples", [np.zeros((8, 5), np.uint8), np.full((8, 5), np.nan, np.float32), np.zeros((8, 0), np.uint16)]
)
def test_where_nothing_will_be_answered_any_noise_is_accepted(samples):
    noise = residual_noise(samples, np.array(EIGHTHS), np.ones(8))
    assert noise.slope == 0
    assert 0 < noise.at(100.0) < 0.3


@pytest.mark.parametrize("pixels", [1, 300])
def test_few_pixels_give_rough_estimates(pixels):
    noise = residual_noise(*samples_of(1.0, 0.0, phase=SIXTEEN, pixels=pixels))
    assert 0.5 < noise.at(100.0) < 1.6


def test_without_a_valid_pixel_or_a_residual_noise_is_not_made_up():
    samples, phase, weights = samples_of(1.0, 0.0, dtype="uint8")
    with pytest.raises(InputError, match=r"3 frames a turn leave no residual .*: give its"):
        residual_noise(samples[:3], phase[:3], weights[:3])
    samples[np.arange(PIXELS) % 8, np.arange(PIXELS)] = 255
    with pytest.raises(InputError, match="too few samples are valid to estimate the noise"):
        residual_noise(samples, phase, weights)
