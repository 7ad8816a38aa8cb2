"""Paraboloids fitted to heights: exact where heights are some, honest where they are noisy."""

import numpy as np
import pytest

from mirrorskin.engine.press.intervals import find_trend

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
    found = find_trend(height, weight, places, width)
    at = ROWS[places], COLUMNS[places]
    assert found.height == pytest.approx(paraboloid(*at), abs=1e-8)
    assert found.along == pytest.approx(slopes(*at), abs=1e-8)
    # In a corner a narrow window has too few pixels to tell whether it fits.
    assert np.isnan(found.misfit[[0, 3]]).all() == (width == 2.0)
    assert np.nanmax(found.misfit) < 1e-6


def test_errors_are_no_larger_than_told_and_misfits_about_one():
    random = np.random.default_rng(1)
    places = np.zeros(ROWS.shape, bool)
    places[10:20, 10:30] = True
    true, square, misfit = slopes(ROWS[places], COLUMNS[places]), 0.0, 0.0
    for _ in range(20):
        noisy = paraboloid(ROWS, COLUMNS) + random.normal(0, 0.02, ROWS.shape)
        found = find_trend(noisy, np.full(ROWS.shape, 0.02**-2), places, 2.0)
        square += np.mean((found.along - true) ** 2 / found.variance, axis=1) / 20
        misfit += np.mean(found.misfit) / 20
    assert (square < 1).all()
    assert (square > 0.2).all()
    assert 0.8 < misfit < 1.2


def test_a_step_is_no_paraboloid():
    height = np.where(COLUMNS < 20, 0.0, -0.5)
    places = np.zeros(ROWS.shape, bool)
    places[15, 18:22] = True
    assert (find_trend(height, np.full(ROWS.shape, 0.03**-2), places, 3.0).misfit > 3).all()


@pytest.mark.parametrize("known", [0, 1, 5])
def test_too_little_tells_nothing(known):
    weight = np.zeros(ROWS.shape)
    weight[15, 15 : 15 + known] = 1.0
    places = np.zeros(ROWS.shape, bool)
    places[15, 15] = True
    found = find_trend(paraboloid(ROWS, COLUMNS), weight, places, 2.0)
    assert np.isnan(found.misfit).all()
    assert np.isfinite(found.along).all()
    assert found.pixels[0] <= known
