"""The direct solver finds the heights of full rectangles of any shape to the precision of float32."""

from __future__ import annotations

import numpy as np
import pytest
from rectangles import put, scene, solve_by_cosines, source_of

from mirrorskin.engine.integration.rectangle import Rectangle, seems_full
from mirrorskin.engine.integration.validation import check_inputs


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (40, 30)])
def test_a_picture_without_slopes_is_flat(device, shape):
    height = Rectangle(shape, (1.0, 1.0), device).solve(put(device, np.zeros(shape))).read()
    np.testing.assert_array_equal(height, 0)


def test_what_a_source_sums_to_changes_nothing(device):
    source = source_of(scene((60, 45), 0.3))
    solver = Rectangle((60, 45), (1.0, 1.0), device)
    height = solver.solve(put(device, source)).read()
    lifted = solver.solve(put(device, source + 0.25)).read()
    np.testing.assert_allclose(lifted, height, atol=2e-5 * np.ptp(height))


def test_a_solver_serves_one_picture_and_screening_after_the_other(device):
    shape = (35, 20)
    solver = Rectangle(shape, (1.0, 1.0), device)
    for seed, screening in enumerate([0.0, 0.1, 0.1, 0.0]):
        surface = np.random.default_rng(seed).normal(size=shape).cumsum(0).cumsum(1)
        surface -= surface.mean()
        source = put(device, source_of(surface, screening=screening))
        height = solver.solve(source, screening).read()
        np.testing.assert_allclose(height, surface, atol=1e-5 * np.ptp(surface))


@pytest.mark.parametrize("size", [(1.0, 4.0), (4.0, 1.0), (1e-3, 1e-3), (1e3, 1e3)])
def test_the_height_of_cosines_follows_from_their_wave_numbers(device, size):
    shape, waves = (40, 35), (3, 2)
    y, x = (
        np.cos(np.pi * n * (np.arange(count) + 0.5) / count) for n, count in zip(waves, shape, strict=True)
    )
    wy, wx = (4 * np.sin(np.pi * n / (2 * count)) ** 2 for n, count in zip(waves, shape, strict=True))
    source = put(device, (wx / size[0] ** 2 + wy / size[1] ** 2) * np.outer(y, x))
    height = Rectangle(shape, size, device).solve(source).read()
    np.testing.assert_allclose(height, np.outer(y, x), atol=5e-6)


@pytest.mark.parametrize(("shape", "lean"), [((250, 256), 0.0), ((256, 251), 30.0)])
def test_errors_are_less_than_a_millionth_of_the_range(device, shape, lean):
    source = source_of(scene(shape, lean)).astype(np.float32)
    height = Rectangle(shape, (1.0, 1.0), device).solve(put(device, source)).read()
    expected = solve_by_cosines(source)
    assert np.abs(height - expected).max() < 5e-7 * np.ptp(expected)
    assert abs(height.mean(dtype=np.float64)) < 1e-7 * np.ptp(expected)


def test_a_long_slope_stays_straight(device):
    """The slowest modes add up what each line rounds: they carry twice the digits."""
    surface = scene((3000, 48), 1.0)
    height = Rectangle((3000, 48), (1.0, 1.0), device).solve(put(device, source_of(surface))).read()
    expected = solve_by_cosines(source_of(surface).astype(np.float32))
    assert np.abs(height - expected).max() < 5e-7 * np.ptp(expected)


@pytest.mark.parametrize("columns", [1531, 4800])
def test_a_long_strip_is_solved_by_a_convolution_or_outside_of_a_group_s_own_memory(device, columns):
    shape = (37, columns)
    source = source_of(scene(shape, 1.0, noise=0.0)).astype(np.float32)
    height = Rectangle(shape, (1.0, 1.0), device).solve(put(device, source)).read()
    expected = solve_by_cosines(source)
    assert np.abs(height - expected).max() < 1e-6 * np.ptp(expected)


@pytest.mark.parametrize("mask", [None, True])
@pytest.mark.parametrize(
    ("shape", "missing"), [((70, 90), (33, 17)), ((1, 9), (0, 4)), ((9, 1), (4, 0)), ((1, 1), (0, 0))]
)
def test_one_slope_that_is_missing_is_noticed_anywhere(device, shape, missing, mask):
    slopes = np.random.default_rng(0).normal(size=(2, *shape)).astype(np.float32)
    solver, mask = Rectangle(shape, (1.0, 1.0), device), None if mask is None else np.ones(shape, bool)

    def is_full():
        inputs = check_inputs(*slopes, 1.0, mask=mask)
        return seems_full(inputs) and solver.integrate(inputs, False) is not None

    assert is_full()
    for slope in slopes:
        slope[missing], kept = np.inf, slope[missing]
        assert not is_full()
        slope[missing] = kept
    if mask is not None:
        mask[missing] = False
        assert not is_full()
