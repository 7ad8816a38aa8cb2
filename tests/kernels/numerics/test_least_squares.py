"""Fits, compared with SciPy's and with theory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import (
    Prior,
    cauchy,
    fit,
    geman_mcclure,
    huber,
    inverse,
    mad_sigma,
    median,
    soft_l1,
)

TIMES = np.linspace(0, 3, 200)
NOISE = 0.02
LOSSES = {"soft_l1": soft_l1, "huber": huber, "cauchy": cauchy}


def samples(seed=0, outliers=0.0):
    """A decay with noise, and a share of gross errors on one side."""
    random = np.random.default_rng(seed)
    values = 2 * np.exp(-1.3 * TIMES) + 0.3 + random.normal(0, NOISE, TIMES.size)
    return values + (random.random(TIMES.size) < outliers)


def decay(values):
    return lambda p: p[0] * np.exp(-p[1] * TIMES) + p[2] - values


@pytest.mark.parametrize("name", LOSSES)
def test_minima_are_those_of_scipy(name):
    residuals, limit = decay(samples(outliers=0.1)), 2.5
    expected = optimize.least_squares(
        residuals, [1, 1, 0], loss=name, f_scale=limit * NOISE, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    result = fit(residuals, [1.0, 1.0, 0.0], noise=NOISE, loss=LOSSES[name](limit), tolerance=1e-12)
    assert result.parameters == pytest.approx(expected.x, abs=1e-6)
    assert result.cost == pytest.approx(2 * expected.cost / NOISE**2)


def test_covariance_of_a_convex_loss_is_that_of_scipy():
    residuals = decay(samples())
    expected = optimize.least_squares(residuals, [1, 1, 0], loss="soft_l1", f_scale=3 * NOISE, xtol=1e-14)
    result = fit(residuals, [1.0, 1.0, 0.0], noise=NOISE, loss=soft_l1(3.0))
    inverted = np.linalg.inv(expected.jac.T @ expected.jac) * NOISE**2
    np.testing.assert_allclose(result.covariance(), inverted, rtol=1e-4)
    np.testing.assert_allclose(result.covariance(4.0), 4 * inverted, rtol=1e-4)


@pytest.mark.parametrize("loss", [soft_l1(3.0), huber(3.0), cauchy(3.0), geman_mcclure(4.0)])
def test_standard_errors_are_those_of_repeated_fits(loss):
    fits = [fit(decay(samples(seed)), [1.5, 1.0, 0.2], noise=NOISE, loss=loss) for seed in range(150)]
    scatter = np.std([result.parameters for result in fits], axis=0)
    sigma = np.sqrt(np.diag(fits[0].covariance()))
    assert scatter / sigma == pytest.approx(1, abs=0.2)


def test_noise_is_estimated_from_most_residuals():
    result = fit(
        decay(samples(outliers=0.1)), [1.5, 1.0, 0.2], noise=1.0, rescale=mad_sigma, loss=geman_mcclure(4.0)
    )
    assert result.noise == pytest.approx(NOISE, rel=0.2)
    assert result.parameters == pytest.approx([2, 1.3, 0.3], abs=0.03)
    normal = np.random.default_rng(1).normal(0, 3, 10**5)
    assert mad_sigma(normal) == pytest.approx(3, rel=0.01)
    assert mad_sigma(np.empty(0)) == 0


def test_bounds_hold_and_may_be_active():
    def residuals(p):
        assert p[0] <= 0.5
        return np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]])

    result = fit(residuals, [-1.2, 1.0], bounds=(np.array([-5.0, -5.0]), np.array([0.5, 5.0])))
    assert result.parameters == pytest.approx([0.5, 0.25], abs=1e-5)


def test_curved_valleys_are_followed():
    result = fit(lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]), [-1.2, 1.0])
    assert result.parameters == pytest.approx([1, 1])


def test_a_prior_counts_as_a_measurement_without_outliers():
    prior = Prior(np.array([[1.0]]), np.array([10.0]))  # 10 with a standard deviation of 1
    result = fit(lambda p: p[0] - np.zeros(4), [0.0], prior=prior, loss=huber(1.0), tolerance=1e-14)
    assert result.parameters == pytest.approx([6.0])  # of four samples at the limit, against 10 - p
    assert fit(lambda p: p - np.zeros(1), [0.0], prior=prior).parameters == pytest.approx([5.0])


def test_a_function_of_derivatives_replaces_differences():
    values = samples()

    def jacobian(p):
        decayed = np.exp(-p[1] * TIMES)
        return np.stack([decayed, -p[0] * TIMES * decayed, np.ones_like(TIMES)], axis=1)

    analytic, numerical = (fit(decay(values), [1.0, 1.0, 0.0], jacobian=slope) for slope in (jacobian, None))
    assert analytic.parameters == pytest.approx(numerical.parameters, abs=1e-6)
    np.testing.assert_allclose(analytic.covariance(), numerical.covariance(), rtol=1e-5)


class Parabola:
    def __init__(self, parameters):
        self.parameters = parameters
        self.cost = float(np.sum((parameters - 3) ** 2))

    def equations(self):
        return np.eye(2), 3 - self.parameters


def test_steps_can_be_limited_in_length_and_number():
    lengths = []

    def shorten(step):
        lengths.append(float(np.abs(step).max()))
        return step * min(1.0, 0.1 / lengths[-1])

    result = least_squares.descend(Parabola, np.zeros(2), shorten=shorten, steps=3)
    assert result.parameters == pytest.approx([0.3, 0.3])


def test_parameters_without_influence_stay():
    result = fit(lambda p: p[:1] - 1.0, [0.0, 7.0])
    assert result.parameters == pytest.approx([1.0, 7.0])


def test_inverse_depends_neither_on_units_nor_on_empty_directions():
    matrix = np.array([[2.0, 1.0], [1.0, 3.0]])
    units = np.outer([1e-6, 1e6], [1e-6, 1e6])
    np.testing.assert_allclose(inverse(matrix / units), np.linalg.inv(matrix) * units)
    np.testing.assert_allclose(inverse(np.diag([4.0, 0.0])), np.diag([0.25, 0.0]))


def test_a_model_that_becomes_undefined_is_not_entered():
    def residuals(p):
        with np.errstate(invalid="ignore"):
            return np.array([np.sqrt(p[0]) - 0.1])  # the first undamped step leads to a negative value

    assert fit(residuals, [4.0]).parameters == pytest.approx([0.01], rel=1e-3)


def test_a_model_without_arrays_needs_only_its_cost_and_equations():
    assert least_squares.descend(Parabola, np.zeros(2)).parameters == pytest.approx([3, 3])


@pytest.mark.parametrize("size", [1, 2, 5, 4095, 100_000, 100_001])
@pytest.mark.parametrize("spread", ["even", "equal", "sorted", "two values"])
def test_a_median_is_that_of_numpy(size, spread):
    values = np.random.default_rng(size).random(size).astype(np.float32)
    values = {
        "even": values, "equal": 0 * values, "sorted": np.sort(values), "two values": np.rint(values)
    }[spread]  # fmt: skip
    assert median(values) == np.median(values)


def straight_line(count=400, noise=1.0, seed=0):
    """Return columns, values of the line 2 + 3 x with noise, and the generator."""
    random = np.random.default_rng(seed)
    columns = np.stack([np.ones(count), np.linspace(-1, 1, count)], axis=1)
    return columns, columns @ [2.0, 3.0] + random.normal(0, noise, count), random


def test_a_clipped_fit_without_outliers_is_a_linear_fit():
    columns, values, _ = straight_line(noise=0.0)
    result = least_squares.fit_clipped(columns, values + 0.1 * np.cos(np.arange(400)))
    expected = np.linalg.lstsq(columns, values + 0.1 * np.cos(np.arange(400)), rcond=None)[0]
    np.testing.assert_allclose(result.parameters, expected, rtol=1e-12)


def test_a_clipped_fit_leaves_outliers_out():
    columns, values, random = straight_line()
    stray = random.choice(400, 40, replace=False)
    values[stray] += 50
    result = least_squares.fit_clipped(columns, values)
    assert not result.kept[stray].any()
    assert np.count_nonzero(result.kept) == 360


def test_errors_of_a_clipped_fit_are_those_of_repeated_fits():
    noise = np.linspace(0.5, 2, 400)
    fits = []
    for seed in range(300):
        columns, line, random = straight_line(noise=0.0, seed=seed)
        fits.append(least_squares.fit_clipped(columns, line + noise * random.normal(size=400), noise))
    spread = np.std([result.parameters for result in fits], axis=0)
    np.testing.assert_allclose(spread, np.sqrt(np.diag(fits[0].inverse)), rtol=0.15)


def test_columns_that_are_alike_have_no_clipped_fit():
    _, values, _ = straight_line()
    assert least_squares.fit_clipped(np.ones((400, 2)), values) is None
