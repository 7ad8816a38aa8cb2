"""Intervals as likelihoods of heights, checked by derivatives; paraboloids through heights."""

import numpy as np
import pytest
from scipy.stats import norm

from mirrorskin.engine.press.intervals import (
    IntervalScatter,
    estimate_interval_scatter,
    fit_paraboloids,
    heights_as_intervals,
    interval_evidence,
    normal_distribution,
)


def log_likelihood(height, middle, half, blur):
    upper, lower = norm.logcdf((middle + half - height) / blur), norm.logcdf((middle - half - height) / blur)
    return upper + np.log1p(-np.exp(lower - upper))


@pytest.mark.parametrize("blur", [0.004, 0.1, 1.0])
def test_an_interval_pulls_as_its_likelihood_does(blur):
    middle, half = np.full(41, -0.3), np.full(41, 0.05)
    height = np.linspace(-0.3 - 0.05 - 2 * blur, -0.3 + 0.05 + 2 * blur, 41)
    evidence = interval_evidence(height, middle, half, IntervalScatter(blur, 0.0))
    step = 1e-4 * blur
    below, here, above = (log_likelihood(height + sign * step, middle, half, blur) for sign in (-1, 0, 1))
    slope, curvature = (above - below) / (2 * step), -(above - 2 * here + below) / step**2
    assert evidence.weight * (evidence.height - height) == pytest.approx(slope, rel=1e-4, abs=1e-4 / blur)
    firm = curvature * blur**2 > 1e-3
    assert firm.any()
    assert evidence.weight[firm] == pytest.approx(curvature[firm], rel=2e-2)


def test_sharp_ends_leave_what_is_inside_alone():
    height = np.array([-0.34, -0.3, -0.26])
    evidence = interval_evidence(height, np.full(3, -0.3), np.full(3, 0.05), IntervalScatter(1e-3, 0.0))
    assert evidence.height == pytest.approx(height, abs=1e-9)
    assert (evidence.weight < 1e-3 * 1e6).all()


def test_wide_blurs_make_a_plain_known_height():
    evidence = interval_evidence(
        np.array([0.7]), np.array([0.2]), np.array([0.3]), IntervalScatter(10.0, 0.0)
    )
    assert evidence.height == pytest.approx(0.2, abs=1e-3)
    assert evidence.weight == pytest.approx(1 / (10.0**2 + 0.3**2 / 3), rel=1e-3)


def test_what_is_far_outside_is_a_mistake():
    far = interval_evidence(np.zeros(2), np.array([2.9, -2.9]), np.full(2, 0.05), IntervalScatter(0.01, 0.0))
    assert (far.weight == 0).all()
    assert np.isfinite(far.height).all()


def test_heights_count_by_the_chance_that_they_are_no_mistakes():
    height, middle, half = np.linspace(-0.07, 0.07, 15), np.zeros(15), np.full(15, 0.05)
    sure, unsure = (
        interval_evidence(height, middle, half, IntervalScatter(0.01, mistakes)) for mistakes in (0.0, 0.3)
    )
    good = (norm.cdf((0.05 - height) / 0.01) - norm.cdf((-0.05 - height) / 0.01)) / 0.1
    assert unsure.weight == pytest.approx(sure.weight * good / (good + 0.3))
    assert (np.diff(unsure.weight / sure.weight)[8:] < 0).all()


@pytest.mark.parametrize("blur", [0.002, 0.01, 0.05, 0.2])
def test_the_blur_is_found(blur):
    random = np.random.default_rng(3)
    half = np.full(200_000, 0.05)
    error = random.uniform(-1, 1, half.size) * half + random.normal(0, blur, half.size)
    assert estimate_interval_scatter(error, half).blur == pytest.approx(blur, rel=0.1)


def test_mistakes_on_one_side_do_not_blur():
    random = np.random.default_rng(4)
    half = np.full(20_000, 0.05)
    error = random.uniform(-1, 1, half.size) * half + random.normal(0, 0.005, half.size)
    error[::25] = random.uniform(-1.5, 0, 800)
    errors = estimate_interval_scatter(error, half)
    assert errors.blur == pytest.approx(0.005, rel=0.25)
    assert errors.outlier_density == pytest.approx(0.04 / 0.96 / np.ptp(error), rel=0.15)


def test_the_least_blur_is_a_fiftieth_of_half_an_interval():
    half = np.full(100, 0.05)
    assert estimate_interval_scatter(np.linspace(-0.049, 0.049, 100), half).blur == pytest.approx(0.001)
    assert estimate_interval_scatter(np.zeros(1), half[:1]).blur == pytest.approx(0.001)
    assert np.isfinite(estimate_interval_scatter(np.full(100, 9.0), half)).all()


ROWS, COLUMNS = np.mgrid[:30, :40].astype(float)


def paraboloid(rows, columns):
    return -3 + 0.02 * columns - 0.01 * rows + 2e-3 * columns**2 - 1e-3 * rows * columns + 3e-3 * rows**2


def slopes(rows, columns):
    return np.array([0.02 + 4e-3 * columns - 1e-3 * rows, -0.01 - 1e-3 * columns + 6e-3 * rows])


@pytest.mark.parametrize("width", [2.0, 3.5])
def test_a_paraboloid_is_found_as_it_is_up_to_the_border(width):
    places = np.zeros(ROWS.shape, bool)
    places[[0, 0, 14, 29], [0, 20, 21, 39]] = True
    height, weight = paraboloid(ROWS, COLUMNS), np.full(ROWS.shape, 1e4)
    weight[:, 25] = 0
    height[:, 25] = np.nan
    fit = fit_paraboloids(height, weight, places, width)
    at = ROWS[places], COLUMNS[places]
    assert fit.height == pytest.approx(paraboloid(*at), abs=1e-8)
    assert fit.along == pytest.approx(slopes(*at), abs=1e-8)
    # In a corner a narrow window has too few pixels to tell whether it fits.
    assert np.isnan(fit.misfit[[0, 3]]).all() == (width == 2.0)
    assert np.nanmax(fit.misfit) < 1e-6


def test_errors_are_no_larger_than_stated_and_misfits_about_one():
    random = np.random.default_rng(1)
    places = np.zeros(ROWS.shape, bool)
    places[10:20, 10:30] = True
    true, square, misfit = slopes(ROWS[places], COLUMNS[places]), 0.0, 0.0
    for _ in range(20):
        noisy = paraboloid(ROWS, COLUMNS) + random.normal(0, 0.02, ROWS.shape)
        fit = fit_paraboloids(noisy, np.full(ROWS.shape, 0.02**-2), places, 2.0)
        square += np.mean((fit.along - true) ** 2 / fit.variance, axis=1) / 20
        misfit += np.mean(fit.misfit) / 20
    assert (square < 1).all()
    assert (square > 0.2).all()
    assert 0.8 < misfit < 1.2


def test_a_step_is_not_a_paraboloid():
    height = np.where(COLUMNS < 20, 0.0, -0.5)
    places = np.zeros(ROWS.shape, bool)
    places[15, 18:22] = True
    assert (fit_paraboloids(height, np.full(ROWS.shape, 0.03**-2), places, 3.0).misfit > 3).all()


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_little_contains_no_information(count):
    weight = np.zeros(ROWS.shape)
    weight[15, 15 : 15 + count] = 1.0
    places = np.zeros(ROWS.shape, bool)
    places[15, 15] = True
    fit = fit_paraboloids(paraboloid(ROWS, COLUMNS), weight, places, 2.0)
    assert np.isnan(fit.misfit).all()
    assert np.isfinite(fit.along).all()
    assert fit.pixels[0] <= count


def test_the_normal_distribution_is_scipys():
    x = np.linspace(-12, 12, 4001)
    np.testing.assert_allclose(normal_distribution(x), norm.cdf(x), rtol=2e-7, atol=1e-16)
    near = np.linspace(-3, 3, 4001)
    np.testing.assert_allclose(normal_distribution(near), norm.cdf(near), rtol=1e-13)


def test_a_height_of_a_pixel_lit_by_its_neighbours_goes_to_the_middle_of_its_frames():
    travel, usual = np.array([0.2, 0.3, 0.5]), 0.1 / np.sqrt(12)
    height = np.array([-0.22, -0.3 + 1e-9, -0.41, -0.22, -0.22, np.nan])
    sigma = np.array([usual, usual, 2.1 * usual, usual / 9, 4 * usual, np.nan])
    result = heights_as_intervals(height, sigma, travel)
    assert result.middle == pytest.approx([-0.25, -0.25, -0.4, -0.22, -0.22, np.nan], nan_ok=True)
    assert result.sigma == pytest.approx([usual, usual, 2 * usual, usual / 9, 4 * usual, np.nan], nan_ok=True)
