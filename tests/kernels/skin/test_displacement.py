"""Displacement of a texture: the reference compared with closed forms, and the kernels with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import spline_filter
from speckle import Speckle

from mirrorskin.kernels.skin.displacement import (
    MARGIN,
    PACKED,
    PARAMETERS,
    basis,
    cubic,
    displacement_pixels,
    displacement_solve,
    displacement_spline,
    interpolate_nodes,
    noise_gain,
    pack,
    windows,
)

SHAPE, STEP, WINDOW = (34, 45), 4, 11
FIRST = (STEP - WINDOW) // 2
START = FIRST + (WINDOW - 1) / 2
HALO = 2 * WINDOW + 8
GRID = (9, 12)
CORE = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
SPECKLE = Speckle(3)


def spline(frame):
    """Coefficients of a frame, as the reference makes them."""
    coefficients = np.empty((frame.shape[0] + 2 * MARGIN, frame.shape[1] + 2 * MARGIN), np.float32)
    displacement_spline(0, len(coefficients), 0, coefficients.shape[1], frame, coefficients)
    return coefficients


def planes_of(reference):
    """Counts, derivatives and texture of a reference in the middle of which a pixel is no measurement."""
    down, right = np.gradient(reference.astype(float))
    counts = reference.astype(float)
    counts[20, 20] = np.nan
    rest = [np.where(np.isnan(counts), 0, part) for part in (right, down, reference - reference.mean())]
    rest = [np.pad(part, HALO) for part in rest]
    return np.stack([np.pad(counts, HALO, constant_values=np.nan), *rest]).astype(np.float32)


def test_coefficients_are_those_of_a_cubic_spline():
    frame = SPECKLE.frame(SHAPE, 0, 0)
    expected = spline_filter(frame.astype(float), 3, mode="mirror")
    np.testing.assert_allclose(spline(frame)[CORE], expected, atol=0.02)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.5])
def test_a_sample_keeps_its_noise_and_one_between_two_has_less(part):
    noise = np.random.default_rng(1).normal(0, 1, (1, 40000))
    c = spline_filter(np.repeat(noise, 1, axis=0)[0], 3)
    between = np.tensordot(cubic(np.array(part)), np.stack([c[k : k - 4] for k in range(4)]), 1)
    assert float(noise_gain(cubic(np.array(part)))) == pytest.approx(between.var(), rel=0.03)


def test_nodes_are_joined_by_straight_lines():
    y, x = np.mgrid[: GRID[0], : GRID[1]] * STEP + START
    inside = np.s_[:, 2:33, 2:44]
    interpolated = interpolate_nodes(np.stack([x + 2 * y, y]), START, STEP, SHAPE)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    np.testing.assert_allclose(interpolated[inside], np.stack([column + 2 * row, row])[inside])


def test_a_displacement_is_found_from_the_columns_of_its_window():
    planes = planes_of(SPECKLE.frame(SHAPE, 0, 0))
    columns = basis(windows(planes, 4, STEP, FIRST + HALO, WINDOW, GRID[1]), WINDOW)
    matrices = np.full((*GRID, PARAMETERS, PARAMETERS), np.nan)
    matrices[4] = np.linalg.inv(columns.transpose(0, 2, 1) @ columns)
    inverse = np.full((math.prod(GRID), PACKED, 1), np.nan)
    pack(matrices, inverse)
    difference, answer = np.zeros((2, *planes.shape[1:])), np.empty((9, math.prod(GRID)))
    difference[0] = 0.7 * planes[1] - 0.2 * planes[2] + np.where(np.isnan(planes[0]), 0, 3) + 0.1 * planes[3]
    field = np.zeros((2, *GRID))
    displacement_solve(STEP, FIRST + HALO, WINDOW, planes, difference, field, inverse, answer)
    displacement = answer.reshape(9, *GRID)[:, 4, 2:-2]
    np.testing.assert_allclose(displacement[0], 0.7, atol=1e-5)
    np.testing.assert_allclose(displacement[1], -0.2, atol=1e-5)
    np.testing.assert_allclose(displacement[2:6], 0, atol=1e-5)
    np.testing.assert_allclose(displacement[6], 0.9, atol=1e-5)


def test_cubics_through_nodes_keep_parabolas():
    y, x = np.mgrid[: GRID[0], : GRID[1]] * STEP + START
    pixels = np.empty((1, *SHAPE, 1))
    displacement_pixels(STEP, START, False, ((x - 20) ** 2 + x * y)[None, None], pixels)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = np.s_[2 + STEP : 33 - STEP, 2 + STEP : 44 - STEP]
    np.testing.assert_allclose(pixels[0, ..., 0][inside], ((column - 20) ** 2 + column * row)[inside])
