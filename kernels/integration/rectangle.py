"""Heights of a full rectangle: ``rectangle.cl`` in plain NumPy with float64.

A u = b is solved for the heights u, with A the Laplacian of a graph that links each pixel to its neighbours,
with one weight along x, another one along y, and a screening on its diagonal. Its eigenvectors are cosines ::

    modes of b along rows, then down columns  ->  each divided by its eigenvalue  ->  back to points of u

The spectrum has the shape (strips, rows, 2 lanes). The slots of a strip contain some consecutive modes k of
rows, then length - k. Mode ``length`` is 0; slots with k beyond half the length are meaningless. Pictures are
stored one below the other.

Pictures from slopes have links with one weight along x and another along y: right-hand sides and residuals.

The kernels also take sizes, and use the tables of ``mirrorskin.engine.integration.rectangle`` for the Fourier
transforms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

from mirrorskin.kernels.integration.links import link_slopes

Floats = NDArray[np.floating[Any]]


def rectangle_modes(source: Floats, spectrum: Floats) -> None:
    """Write the cosine modes of rows, twice the sums of their points times cosines."""
    rows, length = source.shape
    modes = np.pad(dct(source.astype(np.float64), axis=1), ((0, 0), (0, 1)))
    low = np.minimum(np.arange(spectrum[:, 0].size // 2).reshape(len(spectrum), -1), length)
    slots = np.concatenate([low, length - low], axis=1)
    spectrum[:, :rows] = modes[:, slots].transpose(1, 0, 2)


def rectangle_divide(pictures: int, along: Floats, across: Floats, spectrum: Floats) -> None:
    """Divide cosine modes of the columns of each picture by ``along`` + ``across``, in place.

    ``along``, (strips, 2 lanes), is per slot, ``across``, (rows of a picture + 1), per mode of columns. The
    constant mode becomes 0.
    """
    rows = len(across) - 1
    for picture in range(pictures):
        part = spectrum[:, picture * rows : (picture + 1) * rows]
        modes = dct(part.astype(np.float64), axis=1)
        modes[0, 0, 0] = 0.0
        by = along[:, np.newaxis] + across[:rows, np.newaxis].astype(np.float64)
        by[0, 0, 0] = 1.0
        part[...] = 2 * rows * idct(modes / by, axis=1)


def rectangle_heights(spectrum: Floats, level: float, height: Floats) -> None:
    """Write ``level`` and the points of rows, times twice their length, from their cosine modes."""
    rows, length = height.shape
    low, high = (
        part.transpose(1, 0, 2).reshape(spectrum.shape[1], -1) for part in np.split(spectrum, 2, axis=2)
    )
    modes = np.concatenate([low[:, : length // 2 + 1], high[:, 1 : (length + 1) // 2][:, ::-1]], axis=1)
    height[...] = level + 2 * length * idct(modes[:rows].astype(np.float64), axis=1)


def rectangle_source(
    x: float,
    y: float,
    dz_dx: Floats,
    dz_dy: Floats,
    source: Floats,
    weight_z: float = 0.0,
    heights: Floats | None = None,
) -> None:
    """Write weights of links times their rise, of those that end in a pixel minus those that start there.

    ``x`` and ``y`` are the weight of links times the size of a pixel / 24. Known heights contribute their
    value times ``weight_z``.
    """
    source[...] = 0.0 if heights is None else weight_z * heights
    for factor, slope, part in ((x, dz_dx, source), (y, dz_dy.T, source.T)):
        part -= np.diff(np.pad(factor * _links(slope), ((0, 0), (1, 1))), axis=1)


def rectangle_misfit(
    weights: tuple[float, float],
    sizes: tuple[float, float],
    slopes: tuple[Floats, Floats],
    relief: Floats,
    weight_z: float = 0.0,
    heights: Floats | None = None,
) -> float:
    """Return the residual of links and known heights: the sum of squares times their weights."""
    misfit = 0.0 if heights is None else weight_z * float(((relief - heights.astype(np.float64)) ** 2).sum())
    ways = (1, slopes[0], relief.astype(np.float64)), (-1, slopes[1].T, relief.T.astype(np.float64))
    for weight, size, (sign, slope, points) in zip(weights, sizes, ways, strict=True):
        misfit += weight * float(((np.diff(points, axis=1) - sign * size / 24 * _links(slope)) ** 2).sum())
    return misfit


def _links(slope: Floats) -> NDArray[np.float64]:
    """Return 24 times the slopes of links along rows."""
    linked = np.ones(slope.shape, bool)
    linked[:, -1] = False
    return 24 * link_slopes(slope, linked)[:, :-1]
