"""Levels of noisy, rounded and clipped samples, compared with exact sums and known truths."""

import numpy as np
import pytest
from reference_frames import expose, rolled
from scipy.special import ndtr

from mirrorskin.engine.calibration.levels import (
    Moments,
    find_plateau,
    level_above,
    level_below,
    pool_variance,
    rounding_error,
)

SHAPE = (61, 83)


def moments_of(frames, parts=1):
    taken = Moments(frames.shape[1:], frames.dtype)
    for part in np.array_split(frames, parts):
        taken.push(part)
    return taken


def honesty(level, truth):
    """Mean square of the errors in units of what they are said to be."""
    return float(np.mean(((level.value - truth) / level.sigma) ** 2))


def levels_about(middle, spread, seed=5):
    return middle + spread * np.random.default_rng(seed).standard_normal(SHAPE)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_moments_of_parts_are_those_of_the_whole(dtype):
    frames = expose(levels_about(90, 20), 9.0, 7, dtype)
    taken = moments_of(frames, 3)
    exact = frames.astype(np.float64)
    np.testing.assert_allclose(taken.mean, exact.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(taken.variance, exact.var(axis=0, ddof=1), rtol=1e-9)
    np.testing.assert_array_equal(taken.highest, exact.max(axis=0))
    np.testing.assert_array_equal(taken.at_highest, (exact == exact.max(axis=0)).sum(axis=0))
    np.testing.assert_array_equal(taken.at_lowest, (exact == exact.min(axis=0)).sum(axis=0))


def test_samples_that_are_not_finite_do_not_count():
    frames = expose(levels_about(90, 20), 9.0, 6, "float32")
    frames[0, 0, 0] = frames[3, 0, 0] = np.nan
    frames[:, 1, 1] = np.inf
    taken = moments_of(frames, 2)
    remaining = frames[[1, 2, 4, 5], 0, 0].astype(np.float64)
    assert taken.count[0, 0] == 4
    assert taken.mean[0, 0] == pytest.approx(remaining.mean(), rel=1e-12)
    assert taken.variance[0, 0] == pytest.approx(remaining.var(ddof=1), rel=1e-9)
    level = level_above(taken, None)
    assert np.isfinite(level.sigma[0, 0])
    assert np.isnan(level.value[1, 1])


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.6])
def test_the_error_of_rounding_is_the_exact_sum(noise):
    level = np.linspace(0, 1, 201)[:-1, np.newaxis]
    whole = np.arange(-12, 14)
    if noise:
        probability = ndtr((whole + 0.5 - level) / noise) - ndtr((whole - 0.5 - level) / noise)
    else:
        probability = (np.floor(level + 0.5) == whole).astype(float)
    mean = probability @ whole
    variance = float(np.mean(probability @ whole**2 - mean**2))
    expected = float(np.mean((mean - level[:, 0]) ** 2))
    assert float(rounding_error(np.array(variance))) == pytest.approx(expected, rel=0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("dtype", "noise", "count"), [("uint8", 1.5, 2), ("uint8", 0.2, 16), ("float32", 1.5, 8)]
)
def test_standard_errors_are_true(dtype, noise, count):
    truth = levels_about(40, 3)
    level = level_above(moments_of(expose(truth, noise, count, dtype)), 0.0)
    assert honesty(level, truth) == pytest.approx(1, abs=0.11)


def test_standard_errors_are_true_where_noise_grows_with_the_level():
    truth = levels_about(100, 40).clip(20, 220)
    noise = np.sqrt(2 + 0.2 * truth)
    level = level_above(moments_of(expose(truth, noise, 16)), 0.0)
    assert honesty(level, truth) == pytest.approx(1, abs=0.06)
    for half in (truth < np.median(truth), truth >= np.median(truth)):
        assert np.median(level.sigma[half]) == pytest.approx(np.median(noise[half]) / 4, rel=0.05)


def test_a_pixel_that_flickers_has_an_error_of_its_own():
    noise = np.full(SHAPE, 1.5)
    noise[7, 9] = 30.0
    level = level_above(moments_of(expose(np.full(SHAPE, 100.0), noise, 64)), None)
    assert level.sigma[7, 9] == pytest.approx(30 / 8, rel=0.3)
    assert level.excess[7, 9] > 200
    assert np.median(level.sigma) == pytest.approx(1.53 / 8, rel=0.03)


@pytest.mark.parametrize(("dtype", "middle", "noise"), [("uint8", 0.0, 1.5), ("float32", 1.0, 1.5)])
def test_a_dark_level_near_zero_is_that_of_the_samples_before_clipping(dtype, middle, noise):
    truth = levels_about(middle, 0.3 * noise)
    frames = np.maximum(expose(truth, noise, 64, dtype), 0)
    level = level_above(moments_of(frames), 0.0)
    naive = float(np.mean(frames.mean(axis=0, dtype=np.float64) - truth))
    bias = float(np.mean(level.value - truth))
    assert naive > 0
    assert abs(bias) < max(0.12 * naive, 0.004 * noise)
    assert 0.8 < honesty(level, truth) < 1.15
    assert level.clipped.mean() > 0.02


def test_a_level_near_the_top_is_corrected_the_same_way():
    truth = levels_about(254, 0.5)
    frames = expose(truth, 1.5, 64)
    level = level_below(moments_of(frames), 255.0)
    assert np.mean(frames.mean(axis=0, dtype=np.float64) - truth) < -0.15
    assert abs(np.mean(level.value - truth)) < 0.02
    assert 0.85 < honesty(level, truth) < 1.15


def test_pixels_that_are_always_black_have_the_error_of_one_sample():
    truth = np.where(np.arange(SHAPE[1]) < 40, -30.0, 10.0) + np.zeros(SHAPE)
    level = level_above(moments_of(np.maximum(expose(truth, 1.5, 32), 0)), 0.0)
    black = truth < 0
    assert np.all(level.clipped[black] == 1)
    assert np.all(np.abs(level.value[black]) < 2 * 1.6)
    np.testing.assert_allclose(level.sigma[black], 1.5, rtol=0.1)
    level = level_above(moments_of(np.zeros((4, 5, 7), np.uint8)), 0.0)
    np.testing.assert_allclose(level.value, 0, atol=1e-9)
    np.testing.assert_allclose(level.sigma, 12**-0.5, rtol=1e-9)


def test_pixels_share_their_noise_as_far_as_they_are_alike():
    generator = np.random.default_rng(3)
    variance = generator.chisquare(7, SHAPE) / 7
    usual, best = pool_variance(np.full(SHAPE, 50.0), variance, np.full(SHAPE, 7))
    np.testing.assert_allclose(usual, variance.mean())
    assert np.std(best) < 0.1 * np.std(variance)
    gains = np.exp(0.8 * generator.standard_normal(SHAPE))
    _, best = pool_variance(
        np.full(SHAPE, 50.0), gains * generator.chisquare(63, SHAPE) / 63, np.full(SHAPE, 63)
    )
    assert np.corrcoef(best.ravel(), gains.ravel())[0, 1] > 0.95


# --- full light under a rolled ball -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "full", "half", "dtype"), [(150, 0.3, 0.1, "uint8"), (100, 0.3, 0.3, "float32")]
)
def test_full_light_has_no_bias_and_a_true_error(count, full, half, dtype):
    generator = np.random.default_rng(2)
    dark = 16 + 3 * generator.standard_normal((1, 4000))
    light = 180 * (1 + 0.05 * generator.standard_normal(dark.shape))
    frames = rolled(dark, light, count, full, half, 2.0, dtype, 2).reshape(count, -1)
    plateau = find_plateau(frames.astype(np.float64), dark.ravel(), np.dtype(dtype).kind == "u")
    valid = np.isfinite(plateau.value)
    error, sigma = (plateau.value - (dark + light).ravel())[valid], plateau.sigma[valid]
    assert valid.mean() > 0.99
    assert abs(error.mean()) < 0.1 * np.median(sigma)
    assert np.mean((error / sigma) ** 2) == pytest.approx(1, abs=0.08)
    assert np.median(sigma) < 1.3 * 2.0 / np.sqrt(count * full)


def test_a_glint_is_no_full_light_and_a_few_samples_are_no_level():
    generator = np.random.default_rng(4)
    samples = 200 + 2 * generator.standard_normal((40, 300))
    samples[3, :20] = 250
    samples[9, :20] = 240
    plateau = find_plateau(samples, np.full(300, 16.0), False)
    assert abs(np.mean(plateau.value[:20]) - 200) < 0.25
    assert np.all(plateau.count[:20] <= 38)
    samples = 16 + generator.standard_normal((40, 300))
    samples[:20, :200] += 180
    samples[:3, 200:] += 180
    samples[:, 299] = np.nan
    plateau = find_plateau(samples, np.full(300, 16.0), False)
    assert np.isfinite(plateau.value[:200]).all()
    assert np.isnan(plateau.value[200:]).all()


def test_a_sharp_plateau_of_integers_is_known_within_its_rounding():
    samples = np.where(np.arange(30)[:, np.newaxis] % 3 == 0, 200.0, 16.0) + np.zeros((30, 50))
    plateau = find_plateau(samples, np.full(50, 16.0), True)
    np.testing.assert_array_equal(plateau.value, 200)
    np.testing.assert_allclose(plateau.sigma, 12**-0.5)
