"""One picture of a recording in which nothing moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Source

_MOVED = 1.5  # times as much between the first and the last frame as between neighbours
_TOGETHER = 16  # frames


def mean_of_still(source: Source) -> NDArray[Any]:
    """Return the mean of all frames.

    Parameters
    ----------
    source : Source
        Rewound first, if it can be.

    Returns
    -------
    ndarray, (H, W), uint16 or float32
        What was of 8 bits has 16, and so fractions of a count.

    Raises
    ------
    InputError
        There are no frames, or the picture changes from the first to the last.
    """
    if source.rewindable:
        source.rewind()
    count, *shape = source.shape
    buffer = np.empty((max(1, min(count, _TOGETHER)), *shape), source.dtype)
    total, number, steps = np.zeros(shape), 0, 0.0
    first = last = None
    while (block := source.read(buffer)) is not None:
        for frame in block.frames.astype(np.float64):
            steps += 0.0 if last is None else _change(last, frame)
            first, last = frame if first is None else first, frame
            total += frame
            number += 1
    if first is None or last is None:
        raise InputError(f"{source.name} has no frames: record the board again")
    if number > 2 and _change(first, last) > _MOVED * steps / (number - 1) + 1e-9 * np.abs(total).max():
        raise InputError(
            f"{source.name} is a sequence in which the picture changes: record the board while nothing moves"
        )
    mean = total / number
    if source.dtype.kind == "f":
        return np.asarray(mean, np.float32)
    return np.rint(mean * (257 if source.dtype.itemsize == 1 else 1)).astype(np.uint16)


def _change(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return by how much two frames differ, but for an offset and a factor of the light, counts RMS."""
    first, second = one - one.mean(), other - other.mean()
    factor = np.sum(first * second) / max(np.sum(first * first), 1e-300)
    return float(np.sqrt(np.mean((second - factor * first) ** 2)))
