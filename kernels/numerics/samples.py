"""Evenly spaced values of an array on a device: ``samples.cl`` in NumPy, and its use."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mirrorskin.kernels.array import Array, fetch
from mirrorskin.kernels.device import C_TYPES

_TYPES = {**C_TYPES, "int32": "int"}


def samples_take(
    places: int, lines: int, rows: int, count: int, values: NDArray[Any], first: int, between: int,
    apart: int, down: int, step: int,
) -> NDArray[Any]:  # fmt: skip
    """Return values of an array, (places, lines, rows, count).

    Value k of row j of line i at place p has index first + p between + i apart + j down + k step.
    """
    flat = values.reshape(-1)[first:]
    strides = [elements * flat.itemsize for elements in (between, apart, down, step)]
    return as_strided(flat, (places, lines, rows, count), strides, writeable=False).copy()


class Grid(NamedTuple):
    """Evenly spaced values of an array on the host or on a device, at one place or several.

    See `samples_take`; the steps are ``apart``, ``down`` and ``step``, and the shape is that of one place.
    """

    array: NDArray[Any] | Array
    first: int
    steps: tuple[int, int, int]
    shape: tuple[int, int, int]
    places: int = 1
    between: int = 0


def take_samples(
    array: Array, first: int, steps: tuple[int, int, int], shape: tuple[int, int, int]
) -> NDArray[Any]:
    """Return the result of `samples_take` for an array on a device; nothing else is copied to the host."""
    samples: NDArray[Any] = take_grids(Grid(array, first, steps, shape))[0][0]
    return samples


def take_grids(*grids: Grid) -> list[NDArray[Any]]:
    """Return the values of several grids, (places, lines, rows, count) each.

    All arrays are on the host, or all on one device, which is waited for once.
    """
    parts = []
    for array, first, steps, shape, places, between in grids:
        if isinstance(array, np.ndarray):
            return [
                samples_take(
                    grid.places, *grid.shape, np.asarray(grid.array), grid.first, grid.between, *grid.steps
                )
                for grid in grids
            ]
        samples = array.device.array("samples", (places, *shape), array.dtype, zeroed=False)
        kernel = array.device.kernel("samples", "samples_take", VALUE=_TYPES[array.dtype.name])
        (lines, rows, count), (apart, down, step) = shape, steps
        kernel(
            places * lines * rows * count, places=places, lines=lines, rows=rows, count=count, values=array,
            first=first, between=between, apart=apart, down=down, step=step, samples=samples,
            moved=2 * samples.nbytes,
        )  # fmt: skip
        parts.append((samples, slice(None)))
    return fetch(parts)
