"""A device's memory that is cached between calls, because a new buffer costs more than its first kernel."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress

import pyopencl as cl

from mirrorskin.kernels.waiting import waiting

SHARE = 8
"""Ratio of a device's memory to the maximum of unused bytes that are cached."""

_Kept = tuple[cl.Buffer, cl.Event | None]


class BufferPool:
    """Unused buffers, each with the last command that used it.

    A buffer is reused only for the same number of bytes, so that tools which detect accesses beyond the end
    of a buffer work.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._lock = limit, threading.Lock()
        self._kept: list[_Kept] = []  # least recently used first
        # not yet in the cache, because a finalizer must not wait for a lock
        self._given_back: deque[_Kept] = deque()

    def give(self, buffer: cl.Buffer, last_use: cl.Event | None) -> None:
        """Cache an unreferenced buffer, with the last command that uses it."""
        self._given_back.append((buffer, last_use))

    def take(self, nbytes: int) -> _Kept | None:
        """Return a buffer of that size with the last command that uses it; None if there is none."""
        with self._lock:
            self._tidy()
            for place in range(len(self._kept) - 1, -1, -1):
                if self._kept[place][0].size == nbytes:
                    return self._kept.pop(place)
        return None

    def free(self) -> None:
        """Return all unused buffers to the driver."""
        with self._lock:
            self._tidy(limit=0)

    def _tidy(self, limit: int | None = None) -> None:
        """Cache returned buffers, and release the least recently used."""
        while self._given_back:
            self._kept.append(self._given_back.popleft())
        excess = sum(buffer.size for buffer, _ in self._kept) - (self._limit if limit is None else limit)
        while self._kept and excess > 0:
            buffer, last_use = self._kept.pop(0)
            excess -= buffer.size
            if last_use is not None:  # drivers differ in how they treat buffers that commands still use
                with waiting, suppress(cl.Error):
                    last_use.wait()
            buffer.release()
