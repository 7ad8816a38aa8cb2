"""Displacement of a texture: the reference against closed forms, and the kernels against it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from launches import launch
from scipy.ndimage import spline_filter
from speckle import Speckle

from mirrorskin.kernels.device import C_TYPES
from mirrorskin.kernels.displacement import (
    MARGIN,
    PARAMETERS,
    basis,
    cubic,
    displacement_across,
    displacement_filter,
    displacement_normals,
    displacement_pad,
    displacement_pixels,
    displacement_planes,
    displacement_solve,
    interpolate_nodes,
    noise_gain,
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
    padded = np.empty((frame.shape[0] + 2 * MARGIN, frame.shape[1] + 2 * MARGIN), np.float32)
    displacement_pad(frame, padded)
    half, found = padded.copy(), padded.copy()
    displacement_filter(1, padded, half)
    displacement_filter(padded.shape[1], half, found)
    return padded, half, found


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
    np.testing.assert_allclose(spline(frame)[-1][CORE], expected, atol=0.02)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.5])
def test_a_sample_keeps_its_noise_and_one_between_two_has_less(part):
    noise = np.random.default_rng(1).normal(0, 1, (1, 40000))
    c = spline_filter(np.repeat(noise, 1, axis=0)[0], 3)
    between = np.tensordot(cubic(np.array(part)), np.stack([c[k : k - 4] for k in range(4)]), 1)
    assert float(noise_gain(cubic(np.array(part)))) == pytest.approx(between.var(), rel=0.03)


def test_nodes_are_joined_by_straight_lines():
    y, x = np.mgrid[: GRID[0], : GRID[1]] * STEP + START
    inside = np.s_[:, 2:33, 2:44]
    found = interpolate_nodes(np.stack([x + 2 * y, y]), START, STEP, SHAPE)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    np.testing.assert_allclose(found[inside], np.stack([column + 2 * row, row])[inside])


def test_a_displacement_is_found_from_the_columns_of_its_window():
    planes = planes_of(SPECKLE.frame(SHAPE, 0, 0))
    columns = basis(windows(planes, 4, STEP, FIRST + HALO, WINDOW, GRID[1]), WINDOW)
    inverse = np.full((PARAMETERS, PARAMETERS, math.prod(GRID)), np.nan)
    inverse[:, :, 4 * GRID[1] : 5 * GRID[1]] = np.linalg.inv(columns.transpose(0, 2, 1) @ columns).transpose(
        1, 2, 0
    )
    difference, answer = np.zeros((2, *planes.shape[1:])), np.empty((9, math.prod(GRID)))
    difference[0] = 0.7 * planes[1] - 0.2 * planes[2] + np.where(np.isnan(planes[0]), 0, 3) + 0.1 * planes[3]
    field = np.zeros((2, *GRID))
    displacement_solve(STEP, FIRST + HALO, WINDOW, planes, difference, field, inverse, answer)
    found = answer.reshape(9, *GRID)[:, 4, 2:-2]
    np.testing.assert_allclose(found[0], 0.7, atol=1e-5)
    np.testing.assert_allclose(found[1], -0.2, atol=1e-5)
    np.testing.assert_allclose(found[2:6], 0, atol=1e-5)
    np.testing.assert_allclose(found[6], 0.9, atol=1e-5)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_kernels_measure_a_reference_as_theirs(device, dtype):
    reference = SPECKLE.frame(SHAPE, 0, 0)
    reference = (reference * (200 / reference.max())).astype(dtype)
    reference[20:, 20:] = 7  # no texture
    top = {} if dtype == "float32" else {"TOP": np.iinfo(dtype).max}
    reference[3, 5] = top.get("TOP", 90)
    coefficients = spline(reference)[-1]
    padded = SHAPE[0] + 2 * HALO, SHAPE[1] + 2 * HALO
    shapes = {"sums": SHAPE, "counts": SHAPE, "planes": (4, *padded), "difference": (2, *padded)}
    shapes |= {"inverse": (PARAMETERS, PARAMETERS, *GRID), "summary": (4, *GRID)}
    expected = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
    displacement_across(WINDOW, reference, expected["sums"], expected["counts"])
    planes = [expected[name] for name in ("sums", "counts", "planes", "difference")]
    displacement_planes(HALO, WINDOW, reference, coefficients, *planes)
    solved = [expected[name] for name in ("planes", "inverse", "summary")]
    displacement_normals(STEP, FIRST + HALO, WINDOW, *solved)

    tile = device.layout.tile
    macros = {"FRAME": C_TYPES[dtype], "WINDOW": WINDOW, "TILE": tile, **top}
    across, planes, normals = (
        device.kernel("displacement", f"displacement_{name}", **macros)
        for name in ("across", "planes", "normals")
    )
    maps = {name: device.given(name, np.zeros(shape)) for name, shape in shapes.items()}
    maps |= {"frame": device.given("frame", reference, dtype)}
    maps |= {"coefficients": device.given("coefficients", coefficients)}
    rows, columns = SHAPE
    sums = [maps[name] for name in ("sums", "counts")]
    launch(across, rows * -(-columns // tile), rows, columns, maps["frame"], *sums)
    launch(
        planes, padded[0] * -(-padded[1] // tile), rows, columns, HALO, maps["frame"], maps["coefficients"],
        *sums, maps["planes"], maps["difference"],
    )  # fmt: skip
    found = [maps[name] for name in ("planes", "inverse", "summary")]
    launch(normals, math.prod(GRID), rows, columns, *GRID, STEP, FIRST + HALO, HALO, *found)
    for name, values in expected.items():
        scale = np.maximum(np.nanmax(np.abs(values), axis=(-2, -1), keepdims=True), 1e-9)
        if name == "inverse":  # correlations; those of windows with hardly any texture lose digits in float32
            diagonal = np.sqrt(values[range(PARAMETERS), range(PARAMETERS)])
            scale = diagonal * diagonal[:, np.newaxis]
        np.testing.assert_allclose(
            maps[name].download() / scale,
            values / scale,
            rtol=2e-3,
            atol=3e-4 if name == "inverse" else 2e-5,
            err_msg=name,
        )
    lost = np.isnan(expected["summary"][0])
    assert lost.any()
    assert not lost.all()


@pytest.mark.parametrize("grid", [GRID, (1, 12), (9, 2)])
@pytest.mark.parametrize("logarithms", [False, True])
def test_nodes_are_joined_by_cubics_and_by_lines_where_some_are_missing(device, grid, logarithms):
    nodes = np.random.default_rng(3).normal(0, 1, (3, 2, *grid)).astype(np.float32)
    nodes[1, :, 0, 1] = np.nan
    expected = np.empty((3, *SHAPE, 2), np.float32)
    displacement_pixels(STEP, START, logarithms, nodes, expected)
    tile = device.layout.tile
    kernel = device.kernel("displacement", "displacement_pixels", FRAME="uchar", WINDOW=WINDOW, TILE=tile)
    found = device.array("pixels", expected.shape, np.float32)
    items = 3 * SHAPE[0] * -(-SHAPE[1] // tile)
    launch(kernel, items, *SHAPE, *grid, STEP, START, 3, 2, logarithms, device.given("nodes", nodes), found)
    np.testing.assert_allclose(found.download(), expected, rtol=2e-5, atol=1e-5)


def test_cubics_through_nodes_keep_parabolas():
    y, x = np.mgrid[: GRID[0], : GRID[1]] * STEP + START
    pixels = np.empty((1, *SHAPE, 1))
    displacement_pixels(STEP, START, False, ((x - 20) ** 2 + x * y)[None, None], pixels)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = np.s_[2 + STEP : 33 - STEP, 2 + STEP : 44 - STEP]
    np.testing.assert_allclose(pixels[0, ..., 0][inside], ((column - 20) ** 2 + column * row)[inside])
