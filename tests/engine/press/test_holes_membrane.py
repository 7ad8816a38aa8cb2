"""Laplace's equation, held against solutions of its five-point form and against a dense solver."""

import numpy as np
import pytest

from mirrorskin.engine.press.holes import stretch


def a_hole(shape, radius):
    """A disc of unknown pixels amid known ones."""
    row, column = np.indices(shape, dtype=float)
    return np.hypot(row - shape[0] / 2, column - shape[1] / 2) < radius


# Above 10 000 unknown pixels the solver is another one.
@pytest.mark.parametrize(("shape", "radius"), [((31, 28), 12), ((170, 151), 70)])
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.1, 0.05)])
def test_planes_and_saddles_are_repeated(shape, radius, spacing):
    row, column = np.indices(shape, dtype=float)
    y, x = row * spacing[0], column * spacing[1]
    unknown = a_hole(shape, radius)
    for exact in (3 + 0.2 * x - 0.7 * y, x**2 - y**2 + x * y):
        given = np.where(unknown, np.nan, exact)
        found = stretch(given, ~unknown, unknown, spacing)
        assert np.max(np.abs(found - exact)) <= 2e-4 * np.ptp(exact)
        np.testing.assert_array_equal(found[~unknown], exact[~unknown])


def test_any_rim_is_met_as_a_dense_solver_meets_it():
    generator = np.random.default_rng(3)
    unknown = generator.random((14, 17)) < 0.4
    unknown[[0, -1]] = unknown[:, [0, -1]] = False
    height = generator.normal(size=unknown.shape)
    matrix, right = np.eye(unknown.size), np.where(unknown, 0.0, height).ravel()
    for row, column in np.argwhere(unknown):
        here = row * 17 + column
        for there in (here - 17, here + 17, here - 1, here + 1):
            matrix[here, there] -= 0.25
    exact = np.linalg.solve(matrix, right).reshape(unknown.shape)
    found = stretch(np.where(unknown, np.nan, height), ~unknown, unknown, (0.3, 0.3))
    np.testing.assert_allclose(found, exact, atol=1e-12)


def test_what_is_neither_known_nor_wanted_leaves_it_free():
    # A strip that is known at its left end only lies level, whatever stands beside it.
    height = np.full((3, 6), np.nan)
    height[1, 0] = 2.0
    unknown = np.zeros((3, 6), bool)
    unknown[1, 1:] = True
    found = stretch(height, np.isfinite(height), unknown, (1.0, 1.0))
    np.testing.assert_allclose(found[1], 2.0)
    assert np.isnan(found[0]).all()


def test_nothing_unknown_is_nothing_to_do():
    height = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(stretch(height, height >= 0, height < 0, (1.0, 1.0)), height)
