"""Evenly spaced values of an array on a device: ``samples.cl`` in NumPy, and its use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mirrorskin.kernels.device import C_TYPES

if TYPE_CHECKING:
    from mirrorskin.kernels.array import Array


def samples_take(
    lines: int, count: int, values: NDArray[Any], first: int, apart: int, step: int
) -> NDArray[Any]:
    """Return values of an array, (lines, count): value j of line i has index first + i apart + j step."""
    flat = values.reshape(-1)[first:]
    strides = apart * flat.itemsize, step * flat.itemsize
    return as_strided(flat, (lines, count), strides, writeable=False).copy()


def take_samples(array: Array, first: int, apart: int, step: int, shape: tuple[int, int]) -> NDArray[Any]:
    """Return the result of `samples_take` for an array on a device; nothing else is copied to the host."""
    samples = array.device.array("samples", shape, array.dtype, zeroed=False)
    kernel = array.device.kernel("samples", "samples_take", VALUE=C_TYPES[array.dtype.name])
    kernel(
        shape[0] * shape[1], lines=shape[0], count=shape[1], values=array, first=first, apart=apart,
        step=step, samples=samples, moved=2 * samples.nbytes,
    )  # fmt: skip
    return samples.read()
