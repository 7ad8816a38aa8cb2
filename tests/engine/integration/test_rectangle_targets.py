"""Heights of large rectangles are as exact as float32 holds them."""

from __future__ import annotations

import numpy as np
import pytest
from rectangles import put, scene, solve_by_cosines, source_of

from mirrorskin.engine.integration.rectangle import Rectangle, are_rows_easier


@pytest.mark.parametrize("lean", [0.0, 0.5, 30.0])
@pytest.mark.parametrize("shape", [(250, 256), (256, 251), (193, 211)])
def test_errors_are_less_than_a_millionth_of_the_range(device, shape, lean):
    source = source_of(scene(shape, lean)).astype(np.float32)
    height = Rectangle(shape, (1.0, 1.0), device).solve(put(device, source)).download()
    told = solve_by_cosines(source)
    assert np.abs(height - told).max() < 5e-7 * np.ptp(told)
    assert abs(height.mean(dtype=np.float64)) < 1e-7 * np.ptp(told)


def test_a_long_slope_stays_straight(device):
    """Slowest modes add up what each line rounds: they carry twice the digits."""
    surface = scene((3000, 48), 1.0)
    height = Rectangle((3000, 48), (1.0, 1.0), device).solve(put(device, source_of(surface))).download()
    told = solve_by_cosines(source_of(surface).astype(np.float32))
    assert np.abs(height - told).max() < 5e-7 * np.ptp(told)


@pytest.mark.parametrize("columns", [1531, 4800])
def test_a_long_strip_is_solved_whether_its_columns_or_its_long_rows_are_transformed(device, columns):
    shape = (37, columns)  # 4800 is more than an item's own memory holds
    assert are_rows_easier(shape, side_by_side=False) == (columns == 4800)
    source = source_of(scene(shape, 0.01, noise=0.0)).astype(np.float32)
    height = Rectangle(shape, (1.0, 1.0), device).solve(put(device, source)).download()
    told = solve_by_cosines(source)
    assert np.abs(height - told).max() < 1e-6 * np.ptp(told)
