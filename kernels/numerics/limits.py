"""Limits of memory and arithmetic: ``limits.cl`` in plain NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def read_all(words: Array, each: int, stride: int) -> Array:
    """Read all words, (n, lanes), once; return a sum modulo 2^32 per item, so that no load is optimised away.

    An item reads ``each`` words, every ``stride``-th of a block of ``stride * each``.
    """
    missing = -len(words) % (stride * each)
    blocks = np.concatenate([words, np.zeros((missing, words.shape[1]), np.uint32)])
    sums = blocks.reshape(-1, each, stride, words.shape[1]).sum(axis=1, dtype=np.uint32)
    return np.asarray(sums.reshape(-1, words.shape[1]))


def copy_all(words: Array, count: int) -> None:
    """Copy the first ``count`` words over the next ones, in place."""
    words[count : 2 * count] = words[:count]


def triad_all(words: Array, count: int, scale: int) -> None:
    """Add two runs of ``count`` words, the second one scaled, into the run after them; modulo 2^32."""
    words[2 * count : 3 * count] = words[:count] + np.uint32(scale) * words[count : 2 * count]


def multiply_all(numbers: Array, stride: int, steps: int, factor: float, summand: float) -> None:
    """Multiply and add a number of times, in place, as eight independent chains per item.

    Words that do not fill an item's eight, every ``stride``-th one, are unchanged.
    """
    first = np.arange(len(numbers)) // (8 * stride) * 8 * stride + np.arange(len(numbers)) % stride
    whole = first + 7 * stride < len(numbers)
    for _ in range(steps):
        numbers[whole] = numbers[whole] * np.float32(factor) + np.float32(summand)
