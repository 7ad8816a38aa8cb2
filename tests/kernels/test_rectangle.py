"""The rectangle's kernels do what their reference does, and that is what it says."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.rectangle import Rectangle, find_rates, make_plan
from mirrorskin.kernels.rectangle import rectangle_columns, rectangle_heights, rectangle_modes

# Lengths by their factors: none, 2 to 5, others that have a step of their own, and too large ones.
LENGTHS = [1, 2, 3, 4, 5, 8, 15, 16, 60, 7, 22, 37, 74]
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


def refer(source, screening, padded=0):
    """The whole way, in the reference."""
    lines, length = source.shape
    plan = make_plan(length)
    spectrum = np.full((len(plan.place) // 8, lines + padded, 16), np.nan)
    rectangle_modes(source, plan.turns, spectrum)
    rates = find_rates(length, lines, *WEIGHTS, screening)
    rectangle_columns(screening == 0, *rates, spectrum[:, :lines])
    height = np.full(source.shape, np.nan)
    rectangle_heights(spectrum, plan.turns / (2 * length * WEIGHTS[1]), height)
    return height


def random_source(shape, seed=0):
    source = np.random.default_rng(seed).normal(size=shape)
    return source - source.mean()


@pytest.mark.parametrize("length", LENGTHS)
def test_modes_are_sums_of_cosines(length):
    source = random_source((3, length))
    mode, point = np.ogrid[: length + 1, :length]
    told = source @ (2 * np.cos(np.pi * mode * (point + 0.5) / length)).T
    plan = make_plan(length)
    spectrum = np.full((len(plan.place) // 8, 3, 16), np.nan)
    rectangle_modes(source, plan.turns, spectrum)
    for k in range(length // 2 + 1):
        low, high = spectrum[k // 8, :, k % 8], spectrum[k // 8, :, 8 + k % 8]
        np.testing.assert_allclose(low, told[:, k], atol=1e-12 * length)
        np.testing.assert_allclose(high, told[:, length - k], atol=1e-12 * length)


@pytest.mark.parametrize("screening", [0.0, 1e-7, 0.3, 50.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 19), (19, 1), (9, 14), (14, 9)])
def test_the_reference_solves_the_equations(shape, screening):
    source = random_source(shape)
    height = refer(source, screening, padded=3)
    matrix = laplacian(*shape, *WEIGHTS, screening)
    matrix += (screening == 0) / source.size  # in the direction that is not asked for
    told = np.linalg.solve(matrix, source.ravel()).reshape(shape)
    np.testing.assert_allclose(height, told, atol=1e-7 * np.ptp(told) + 1e-9)  # rates settle to 2^-26


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
