"""The rectangle's kernels equal their reference, and the reference is correct."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.height_variance import expected_misfit
from mirrorskin.engine.integration.rectangle import Rectangle, find_modes
from mirrorskin.engine.integration.validation import check_inputs
from mirrorskin.kernels.integration.rectangle import (
    rectangle_divide,
    rectangle_heights,
    rectangle_misfit,
    rectangle_modes,
    rectangle_source,
)

WEIGHTS = 1.0, 0.6


def chain(count):
    """The Laplacian of so many pixels in a line."""
    links = np.diff(np.eye(count), axis=0)
    return links.T @ links


def laplacian(lines, length, along, across, screening):
    """The matrix of all pixels, line after line."""
    return (
        along * np.kron(np.eye(lines), chain(length))
        + across * np.kron(chain(lines), np.eye(length))
        + screening * np.eye(lines * length)
    )


def refer(source, screening, weights=WEIGHTS):
    """The whole way, in the reference."""
    rows, columns = source.shape
    modes = find_modes(columns, 4), np.arange(rows + 1)
    spectrum = np.full((len(modes[0]), rows, 8), np.nan)
    rectangle_modes(source, spectrum)
    along, across = (
        4 * weight * np.sin(np.pi * mode / (2 * count)) ** 2
        for weight, mode, count in zip(weights, modes, (columns, rows), strict=True)
    )
    scale = 4 * source.size
    rectangle_divide(1, scale * along, scale * (across + screening), spectrum)
    height = np.full(source.shape, np.nan)
    rectangle_heights(spectrum, 0.0, height)
    return height


def random_source(shape, seed=0):
    source = np.random.default_rng(seed).normal(size=shape)
    return source - source.mean()


@pytest.mark.parametrize("screening", [0.0, 1e-7, 0.3, 50.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 19), (19, 1), (9, 14), (14, 9)])
def test_the_reference_solves_the_equations(shape, screening):
    source = random_source(shape)
    height = refer(source, screening)
    matrix = laplacian(*shape, *WEIGHTS, screening)
    matrix += (screening == 0) / source.size  # in the direction that is not asked for
    expected = np.linalg.solve(matrix, source.ravel()).reshape(shape)
    np.testing.assert_allclose(height, expected, atol=1e-9 * np.ptp(expected) + 1e-12)


@pytest.mark.parametrize("screening", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(1, 1), (1, 31), (33, 2), (19, 60), (35, 90), (21, 37), (41, 37)])
def test_device_and_reference_find_the_same_heights(device, shape, screening):
    source = random_source(shape).astype(np.float32)
    along, across = WEIGHTS
    for picture, size in ((source, (along, across)), (source.T, (across, along))):
        source_array = device.array("source", picture.shape, np.float32)
        source_array.write(picture)
        solver = Rectangle(picture.shape, (size[0] ** -0.5, size[1] ** -0.5), device)
        height = solver.solve(source_array, screening).read()
        expected = refer(source, screening)
        expected = expected if picture is source else expected.T
        np.testing.assert_allclose(height, expected, atol=2e-6 * max(1e-3, np.ptp(expected)))


@pytest.mark.parametrize("with_heights", [False, True])
@pytest.mark.parametrize("shape", [(1, 5), (3, 2), (4, 4), (37, 41), (3, 300)])
def test_device_and_reference_make_the_same_of_slopes(device, shape, with_heights):
    slopes = np.random.default_rng(1).normal(size=(2, 3, *shape)).astype(np.float32)
    heights = np.random.default_rng(2).normal(size=shape).astype(np.float32)
    size, area, weights = (0.3, 0.4), 0.12, (0.4 / 0.3, 0.3 / 0.4)
    options = {"known_heights": heights, "known_height_weights": 5.0} if with_heights else {}
    inputs = check_inputs(*slopes, size, **options, several=True)
    solver = Rectangle(slopes[0].shape, size, device, area)
    height, sigma = solver.integrate(inputs, True)
    extra = (5.0 * area, inputs.known_heights) if with_heights else (0.0, None)
    links, misfit = shape[0] * (shape[1] - 1) + (shape[0] - 1) * shape[1], 0.0
    for dz_dx, dz_dy, solved in zip(*slopes, height, strict=True):
        source = np.empty(shape)
        rectangle_source(weights[0] * 0.3 / 24, -weights[1] * 0.4 / 24, dz_dx, dz_dy, source, *extra)
        expected = refer(source, extra[0], weights)
        np.testing.assert_allclose(solved, expected + inputs.datum, atol=2e-5 * np.ptp(expected))
        misfit += rectangle_misfit(weights, size, (dz_dx, dz_dy), expected, *extra) / len(height)
    unit = expected_misfit(links, sigma.size, sigma.size * with_heights, 1 - with_heights, weights)
    expected = solver.deviation(extra[0]) * np.sqrt(misfit / unit) if unit > 0 else np.full(shape, np.nan)
    np.testing.assert_allclose(sigma, expected, rtol=1e-4)
