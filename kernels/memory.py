"""Host memory that is kept from call to call, since pages that were used before cost nothing to use again."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

KEPT = 2**29
"""Bytes that are kept at most while nobody uses them."""

PAGE = 4096
"""Bytes of the smallest pages that there are."""

_LEAST = 2**16  # bytes, below which memory is not worth keeping

_lock = threading.Lock()
_kept: list[NDArray[np.uint8]] = []  # what was given back the longest ago comes first
_given_back: deque[NDArray[np.uint8]] = deque()  # and not yet among those kept: a finalizer waits for no lock


class _Block:
    """Memory from its first page on, as NumPy takes it; given back when the last array in it dies."""

    def __init__(self, raw: NDArray[np.uint8]) -> None:
        self._raw = raw
        start = -raw.ctypes.data % PAGE
        self.__array_interface__ = raw[start : len(raw) - PAGE + start].__array_interface__

    def __del__(self) -> None:
        _given_back.append(self._raw)
        _tidy()


def take(nbytes: int, zeroed: bool) -> NDArray[np.uint8]:
    """Return memory that starts on a page, so that a device sharing it need not copy.

    It holds zeros, or anything. MemoryError: there is none.
    """
    if nbytes < _LEAST:
        small = np.zeros(nbytes + PAGE, np.uint8)
        start = -small.ctypes.data % PAGE
        return small[start : start + nbytes]
    with _lock:
        most = nbytes + nbytes // 8 + PAGE
        fitting = [place for place, raw in enumerate(_kept) if nbytes + PAGE <= len(raw) <= most]
        raw = _kept.pop(min(fitting, key=lambda place: (len(_kept[place]), -place))) if fitting else None
    _tidy()
    if raw is None:
        return np.asarray(_Block(np.zeros(nbytes + PAGE, np.uint8)))[:nbytes]
    found = np.asarray(_Block(raw))[:nbytes]
    if zeroed:
        found.fill(0)
    return found


def free() -> None:
    """Give the memory that nobody uses back to the system."""
    _tidy()
    with _lock:
        _kept.clear()


def _tidy() -> None:
    """Keep what was given back, and let go of what was not used for the longest time."""
    while _given_back and _lock.acquire(blocking=False):  # who holds the lock comes here next
        try:
            while _given_back:
                _kept.append(_given_back.popleft())
            while sum(map(len, _kept)) > KEPT:
                _kept.pop(0)
        finally:
            _lock.release()
