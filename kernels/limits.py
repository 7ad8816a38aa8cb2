"""What memory can give: what ``limits.cl`` computes, in plain NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def read_all(words: NDArray[np.uint32], each: int) -> NDArray[np.uint32]:
    """Read everything once, and add it up modulo 2^32 so that no read can be left out.

    Parameters
    ----------
    words : ndarray, (n, 16), uint32
    each : int
        Rows that one work-item reads.

    Returns
    -------
    ndarray, (ceil(n / each),), uint32
    """
    starts = np.arange(0, len(words), each)
    sums: NDArray[np.uint32] = np.add.reduceat(words.sum(axis=1, dtype=np.uint32), starts, dtype=np.uint32)
    return sums


def copy_all(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Read everything once and write it elsewhere."""
    return words.copy()
