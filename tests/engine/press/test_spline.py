"""Smooth surfaces within intervals, compared with polynomials and NumPy's least squares."""

import numpy as np
import pytest

from mirrorskin.engine.press.spline import Spline, fit_within

SHAPE, SPACING, CELLS = (23, 31), (0.1, 0.07), (5, 7)


def powers(degree):
    """The products of powers of x and y up to a degree, one a plane."""
    row, column = np.indices(SHAPE, dtype=float)
    y, x = row * SPACING[0] - 1, column * SPACING[1] - 1
    return np.array([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])


def polynomial(degree, seed=1):
    """A polynomial of a degree with random factors."""
    planes = powers(degree)
    return np.tensordot(np.random.default_rng(seed).normal(size=len(planes)), planes, 1)


def fit(low, high, stiffness):
    return fit_within(Spline(SHAPE, SPACING, CELLS), low, high, stiffness)


def test_a_cubic_is_one_of_its_surfaces():
    exact = polynomial(3)
    surface = fit(exact - 1e-4, exact + 1e-4, 1e-14)
    assert np.max(np.abs(surface.height - exact)) < 2e-6
    assert surface.misfit == 0


def test_a_quadratic_goes_on_where_nothing_is_known():
    exact = polynomial(2)
    row, column = np.indices(SHAPE)
    hole = np.hypot(row - 11, column - 15) < 8
    low, high = np.where(hole, np.nan, exact - 1e-4), np.where(hole, np.inf, exact + 1e-4)
    assert np.max(np.abs(fit(low, high, 1e-2).height - exact)) < 1e-5


def test_the_stiffest_surface_is_the_least_squares_quadratic():
    # Wide intervals draw to their middles, and third derivatives of any direction cost.
    data = polynomial(2) + np.random.default_rng(2).normal(0, 0.1, SHAPE)
    planes = powers(2)
    factors = np.linalg.lstsq(planes.reshape(len(planes), -1).T, data.ravel(), rcond=None)[0]
    exact = np.tensordot(factors, planes, 1)
    surface = fit(data - 10, data + 10, 1.0)
    assert np.max(np.abs(surface.height - exact)) < 1e-3


def test_third_derivatives_cost_their_square_in_every_direction():
    # Splines hold cubics, so the form of one is its integral: of x^3 36, of x^2 y 3 x 4, over the area.
    spline = Spline(SHAPE, SPACING, CELLS)
    area = (SHAPE[0] - 1) * SPACING[0] * (SHAPE[1] - 1) * SPACING[1]
    row, column = np.indices(SHAPE, dtype=float)
    y, x = row * SPACING[0], column * SPACING[1]
    squares, rough, tiny = spline.squares(np.ones(SHAPE)), spline.roughness(), 1e-7
    for cubic, cost in ((x**3, 36), (y**3, 36), (x**2 * y, 12), (y**2 * x, 12)):
        # Where squares and cost are weighed, the data's surface u gives way by v: squares v = -tiny rough u,
        # and the sum of v times the data is -tiny times the cost.
        factors = spline.lowest(squares + tiny * rough, cubic)
        gives_way = spline.at_samples(factors) - cubic
        assert -np.sum(gives_way * cubic) / tiny == pytest.approx(cost * area, rel=1e-3)


def test_terraces_are_no_steps():
    exact = polynomial(2)
    low = np.floor(exact / 0.3) * 0.3
    surface = fit(low, low + 0.3, 1e-3)
    assert surface.misfit < 0.05
    assert np.max(np.abs(surface.height - exact)) < 0.03  # a tenth of a step


def test_a_lower_end_alone_lifts_and_never_lowers():
    exact = polynomial(2)
    low, high = exact - 0.01, exact + 0.01
    low[8:14, 10:20], high[8:14, 10:20] = -50.0, np.inf
    np.testing.assert_allclose(fit(low, high, 1e-3).height, exact, atol=1e-2)
    low[8:14, 10:20] = exact[8:14, 10:20] + 0.5
    assert np.mean(fit(low, high, 1e-8).height[8:14, 10:20] - exact[8:14, 10:20]) > 0.3
