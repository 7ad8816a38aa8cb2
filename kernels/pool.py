"""A device's memory that is kept from call to call, since a new buffer costs more than its first kernel."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress

import pyopencl as cl

from mirrorskin.kernels.waiting import waiting

SHARE = 8
"""The memory of a device over the bytes that are kept at most while nobody uses them."""

_Kept = tuple[cl.Buffer, cl.Event | None]


class BufferPool:
    """Buffers that nobody uses, each with the last command that used it.

    A buffer is taken again for the same number of bytes only, so that tools which find accesses beyond the
    end of a buffer find them.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._lock = limit, threading.Lock()
        self._kept: list[_Kept] = []  # what was given back the longest ago comes first
        self._given_back: deque[_Kept] = deque()  # and not yet kept: a finalizer waits for no lock

    def give(self, buffer: cl.Buffer, last_use: cl.Event | None) -> None:
        """Keep a buffer that nobody refers to any more, with the last command that uses it."""
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
        """Give all buffers that nobody uses back to the driver."""
        with self._lock:
            self._tidy(limit=0)

    def _tidy(self, limit: int | None = None) -> None:
        """Keep what was given back, and release what was not used for the longest time."""
        while self._given_back:
            self._kept.append(self._given_back.popleft())
        excess = sum(buffer.size for buffer, _ in self._kept) - (self._limit if limit is None else limit)
        while self._kept and excess > 0:
            buffer, last_use = self._kept.pop(0)
            excess -= buffer.size
            if last_use is not None:  # drivers differ in what they do with buffers that commands still use
                with waiting, suppress(cl.Error):
                    last_use.wait()
            buffer.release()
