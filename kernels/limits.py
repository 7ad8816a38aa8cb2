"""What memory and arithmetic can give: what ``limits.cl`` computes, in plain NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def read_all(words: NDArray[np.uint32], each: int, stride: int) -> NDArray[np.uint32]:
    """Read everything once, and add it up modulo 2^32 so that no read can be left out.

    Parameters
    ----------
    words : ndarray, (n, lanes), uint32
        The kernel is told ``n`` after it.
    each : int
        Words that one work-item reads, every ``stride``-th of a block of ``stride * each``.
    stride : int

    Returns
    -------
    ndarray, (items, lanes), uint32
        One sum for each item of all blocks; ``items`` is a multiple of ``stride``.
    """
    missing = -len(words) % (stride * each)
    blocks = np.concatenate([words, np.zeros((missing, words.shape[1]), np.uint32)])
    sums = blocks.reshape(-1, each, stride, words.shape[1]).sum(axis=1, dtype=np.uint32)
    return np.asarray(sums.reshape(-1, words.shape[1]))


def copy_all(words: NDArray[np.uint32], count: int) -> None:
    """Copy the first ``count`` words over the next ones, in place."""
    words[count : 2 * count] = words[:count]


def triad_all(words: NDArray[np.uint32], count: int, scale: int) -> None:
    """Add two runs of ``count`` words, the second one scaled, into the run after them; modulo 2^32."""
    words[2 * count : 3 * count] = words[:count] + np.uint32(scale) * words[count : 2 * count]


def multiply_all(
    numbers: NDArray[np.float32], stride: int, steps: int, factor: float, summand: float
) -> None:
    """Multiply and add so many times, in place, as eight independent chains an item.

    Parameters
    ----------
    numbers : ndarray, (n, lanes), float32
        The kernel is told ``n`` after it, and no ``stride``. What does not fill an item's eight words, every
        ``stride``-th one, is left alone.
    stride, steps : int
    factor, summand : float
    """
    first = np.arange(len(numbers)) // (8 * stride) * 8 * stride + np.arange(len(numbers)) % stride
    whole = first + 7 * stride < len(numbers)
    for _ in range(steps):
        numbers[whole] = numbers[whole] * np.float32(factor) + np.float32(summand)
