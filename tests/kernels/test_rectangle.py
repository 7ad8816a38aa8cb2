"""The rectangle's kernels do what their reference does, and that is what it says."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.rectangle import Rectangle, find_modes
from mirrorskin.kernels.rectangle import rectangle_divide, rectangle_heights, rectangle_modes

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


def refer(source, screening):
    """The whole way, in the reference."""
    rows, columns = source.shape
    modes = find_modes(columns), np.arange(rows + 1)
    spectrum = np.full((len(modes[0]), rows, 16), np.nan)
    rectangle_modes(source, spectrum)
    along, across = (
        4 * weight * np.sin(np.pi * mode / (2 * count)) ** 2
        for weight, mode, count in zip(WEIGHTS, modes, (columns, rows), strict=True)
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
    told = np.linalg.solve(matrix, source.ravel()).reshape(shape)
    np.testing.assert_allclose(height, told, atol=1e-9 * np.ptp(told) + 1e-12)


@pytest.mark.parametrize("screening", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(1, 1), (1, 31), (33, 2), (19, 60), (35, 90), (21, 37), (41, 37)])
def test_device_and_reference_find_the_same_heights(device, shape, screening):
    source = random_source(shape).astype(np.float32)
    along, across = WEIGHTS
    for picture, size in ((source, (along, across)), (source.T, (across, along))):
        given = device.array("source", picture.shape, np.float32)
        given.host[...] = picture
        given.upload()
        solver = Rectangle(picture.shape, (size[0] ** -0.5, size[1] ** -0.5), device)
        height = solver.solve(given, screening).download()
        told = refer(source, screening)
        told = told if picture is source else told.T
        np.testing.assert_allclose(height, told, atol=2e-6 * max(1e-3, np.ptp(told)))
