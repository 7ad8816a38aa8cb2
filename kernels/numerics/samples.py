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
    lines: int, rows: int, count: int, values: NDArray[Any], first: int, apart: int, down: int, step: int
) -> NDArray[Any]:
    """Return values of an array, (lines, rows, count).

    Value k of row j of line i has index first + i apart + j down + k step.
    """
    flat = values.reshape(-1)[first:]
    strides = [elements * flat.itemsize for elements in (apart, down, step)]
    return as_strided(flat, (lines, rows, count), strides, writeable=False).copy()


class Grid(NamedTuple):
    """Evenly spaced values of an array on the host or on a device; see `samples_take`."""

    array: NDArray[Any] | Array
    first: int
    steps: tuple[int, int, int]
    shape: tuple[int, int, int]


def take_samples(
    array: Array, first: int, steps: tuple[int, int, int], shape: tuple[int, int, int]
) -> NDArray[Any]:
    """Return the result of `samples_take` for an array on a device; nothing else is copied to the host."""
    return take_grids(Grid(array, first, steps, shape))[0]


def take_grids(*grids: Grid) -> list[NDArray[Any]]:
    """Return the values of several grids, all on the host or all on one device, which is waited for once."""
    parts = []
    for array, first, steps, shape in grids:
        if isinstance(array, np.ndarray):
            return [
                samples_take(*grid.shape, np.asarray(grid.array), grid.first, *grid.steps) for grid in grids
            ]
        samples = array.device.array("samples", shape, array.dtype, zeroed=False)
        kernel = array.device.kernel("samples", "samples_take", VALUE=_TYPES[array.dtype.name])
        (lines, rows, count), (apart, down, step) = shape, steps
        kernel(
            lines * rows * count, lines=lines, rows=rows, count=count, values=array, first=first, apart=apart,
            down=down, step=step, samples=samples, moved=2 * samples.nbytes,
        )  # fmt: skip
        parts.append((samples, slice(None)))
    return fetch(parts)
