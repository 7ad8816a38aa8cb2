"""Heights of a full rectangle: what ``rectangle.cl`` computes, in plain NumPy with float64 inside.

A u = b is solved for the heights u, with A the Laplacian of a graph that links each pixel to its neighbours:
by a weight along x, by another one along y, and with a screening on its diagonal. Its eigenvectors are
cosines ::

    modes of b along rows, then down columns  ->  each divided by its eigenvalue  ->  back to points of u

The spectrum, (strips, rows, 16), has in the slots of strip s modes k = 8 s ... 8 s + 7 of rows of a length,
then length - k. Mode ``length`` is 0; what slots with k beyond half the length hold means nothing. Pictures
lie one below the other.

The kernels take sizes besides, and go about the Fourier transforms by the tables of
``mirrorskin.engine.integration.rectangle``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

Floats = NDArray[np.floating[Any]]

_HALF = 8


def rectangle_modes(source: Floats, spectrum: Floats) -> None:
    """Write the cosine modes of rows, twice the sums of their points times cosines."""
    rows, length = source.shape
    found = np.pad(dct(source.astype(np.float64), axis=1), ((0, 0), (0, 1)))
    low = np.minimum(np.arange(len(spectrum) * _HALF).reshape(-1, _HALF), length)
    slots = np.concatenate([low, length - low], axis=1)
    spectrum[:, :rows] = found[:, slots].transpose(1, 0, 2)


def rectangle_divide(pictures: int, along: Floats, across: Floats, spectrum: Floats) -> None:
    """Divide cosine modes of the columns of each picture by ``along`` + ``across``, in place.

    ``along``, (strips, 16), is of a slot, ``across``, (rows of a picture + 1), of a mode of columns. The mode
    that is the same everywhere becomes 0.
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
    """Write ``level`` and the points of rows, times twice their length, given their cosine modes."""
    rows, length = height.shape
    low, high = (
        part.transpose(1, 0, 2).reshape(spectrum.shape[1], -1) for part in np.split(spectrum, 2, axis=2)
    )
    modes = np.concatenate([low[:, : length // 2 + 1], high[:, 1 : (length + 1) // 2][:, ::-1]], axis=1)
    height[...] = level + 2 * length * idct(modes[:rows].astype(np.float64), axis=1)
