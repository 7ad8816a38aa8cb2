"""Host memory that is cached between calls, because pages that were used before need not be mapped again."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

KEPT = 2**29
"""Maximum number of unused bytes that are cached."""

PAGE = 4096
"""Size of the smallest pages, bytes."""

MIN_CACHED = 2**16
"""Number of bytes below which memory is not cached."""

_lock = threading.Lock()
_kept: list[NDArray[np.uint8]] = []  # least recently used first
# not yet in the cache, because a finalizer must not wait for a lock
_given_back: deque[NDArray[np.uint8]] = deque()


class _Block:
    """Page-aligned memory for NumPy; returned to the cache when its last array is deleted."""

    def __init__(self, raw: NDArray[np.uint8]) -> None:
        self._raw = raw
        start = -raw.ctypes.data % PAGE
        self.__array_interface__ = raw[start : len(raw) - PAGE + start].__array_interface__

    def __del__(self) -> None:
        _given_back.append(self._raw)
        _tidy()


def take(nbytes: int, zeroed: bool) -> NDArray[np.uint8]:
    """Return page-aligned memory, so that a device sharing it need not copy.

    It contains zeros, or is not initialised. MemoryError if there is none.
    """
    if nbytes < MIN_CACHED:
        small = np.zeros(nbytes + PAGE, np.uint8)
        start = -small.ctypes.data % PAGE
        return small[start : start + nbytes]
    with _lock:
        capacity = nbytes + nbytes // 8 + PAGE
        fitting = [place for place, raw in enumerate(_kept) if nbytes + PAGE <= len(raw) <= capacity]
        raw = _kept.pop(min(fitting, key=lambda place: (len(_kept[place]), -place))) if fitting else None
    _tidy()
    if raw is None:
        return np.asarray(_Block(np.zeros(nbytes + PAGE, np.uint8)))[:nbytes]
    array = np.asarray(_Block(raw))[:nbytes]
    if zeroed:
        array.fill(0)
    return array


def free() -> None:
    """Return unused memory to the system."""
    _tidy()
    with _lock:
        _kept.clear()


def _tidy() -> None:
    """Cache returned memory, and release the least recently used."""
    while _given_back and _lock.acquire(blocking=False):  # the holder of the lock comes here next
        try:
            while _given_back:
                _kept.append(_given_back.popleft())
            while sum(map(len, _kept)) > KEPT:
                _kept.pop(0)
        finally:
            _lock.release()
