"""A ring buffer of frames from a camera's thread to a reader, without copies, whose writer never waits."""

from __future__ import annotations

import math
import mmap
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.hw.base.camera import Frames
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError

MEMORY = 64_000_000  # default size of a ring, bytes
_SECONDS = 0.5
_SLOTS_MIN, _SLOTS_MAX = 4, 1024  # frames
_BEYOND = 64  # readable bytes after the frames, so that a kernel may load its last word as a whole


def usual_slots(shape: tuple[int, int], dtype: DTypeLike, rate: float | None = None) -> int:
    """Return the number of frames in a ring: 64 MB or 0.5 s, whichever is more, from 4 to 1024."""
    count = MEMORY // max(1, math.prod(shape) * np.dtype(dtype).itemsize)
    return max(_SLOTS_MIN, min(count, _SLOTS_MAX), math.ceil(_SECONDS * (rate or 0.0)))


class Ring:
    """A contiguous ring buffer of frames that a device can use in place.

    One thread writes: it repeatedly fills ``slot()`` and calls ``put``, and never waits. Another thread
    takes. When all slots are full, the oldest waiting frame is lost and counted. A slot is not overwritten
    while the array that ``take`` returned, or a view of it, is referenced. At most half of the slots are
    shared in this way; a reader that keeps more gets copies, so it can never block the camera.

    The memory is page-aligned, and the 64 bytes after each frame may be read. Consecutive frames are
    contiguous, up to the last slot. `slots` frames of `shape` (H, W) can wait.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        slots: int,
        name: str = "the camera",
        clock: Clock = SYSTEM,
    ) -> None:
        if slots < 1:
            raise ValueError(f"a ring has at least 1 slot, not {slots}")
        self.name = name
        self.dropped: int = 0  # frames lost so far, here or before they arrived here
        self.error: HardwareError | None = None
        # One more for writing; and while one is shared and one copied, one can wait.
        places = max(slots + 2, 4)
        self._slots = slots
        self._shared_max = max(1, slots // 2)
        self._places = _pages((places, *shape), np.dtype(dtype))
        self._time = np.zeros(places)
        self._number = np.zeros(places, np.int64)
        self._lost = [0] * places  # number of lost frames before each frame
        self._free = [True] * places
        self._waiting: deque[int] = deque()
        self._missed = 0  # frames lost since the last one taken
        self._shared = 0
        self._returned: deque[range] = deque()
        self._writing = 0
        self._free[0] = False
        self._clock = clock
        self._came = clock.condition()

    def slot(self) -> NDArray[Any]:
        """Return the buffer for the next frame, (H, W); it is the same until ``put``."""
        place: NDArray[Any] = self._places[self._writing]
        return place

    def put(self, time: float, number: int, lost: int = 0) -> None:
        """Publish the frame in the slot, with its time of arrival and the number of frames lost before it."""
        with self._came:
            here = self._writing
            self._time[here], self._number[here], self._lost[here] = time, number, lost
            self.dropped += lost
            self._waiting.append(here)
            self._reclaim()
            while len(self._waiting) > max(1, self._slots - self._shared):
                self._forget_oldest()
            self._writing = self._next(here)
            self._came.notify()

    def fail(self, error: HardwareError) -> None:
        """Report to readers that no more frames will arrive; waiting frames can still be taken."""
        with self._came:
            if self.error is None:
                self.error = error
            self._came.notify_all()

    def take(self, limit: int, timeout: float) -> Frames:
        """Take the oldest waiting frames, or wait for one; see ``mirrorskin.hw.Camera.take``.

        The result ends before lost frames, at the last slot, and at half of the ring.
        """
        with self._came:
            self._wait(timeout)
            self._reclaim()
            free = self._shared_max - self._shared
            run = self._run(min(max(1, limit), free if free > 0 else len(self._free) - 2 - self._shared))
            self._shared += len(run)
            missed, self._missed = self._missed + self._lost[run.start], 0
            part = slice(run.start, run.stop)
            number, time = self._number[part].copy(), self._time[part].copy()
        pixels = np.asarray(_Loan(self._places[part], self._returned, run))
        if free <= 0:
            copy = _pages(pixels.shape, pixels.dtype)
            copy[:] = pixels
            pixels = copy
        return Frames(pixels, number, time, missed)

    def flush(self) -> None:
        """Discard the waiting frames; they do not count as dropped."""
        with self._came:
            for place in self._waiting:
                self._free[place] = True
            self._waiting.clear()
            self._missed = 0

    def _run(self, limit: int) -> range:
        """Remove contiguous waiting slots without a loss between them from the queue."""
        first = self._waiting.popleft()
        stop = first + 1
        while self._waiting and stop - first < limit and self._waiting[0] == stop and not self._lost[stop]:
            self._waiting.popleft()
            stop += 1
        return range(first, stop)

    def _wait(self, timeout: float) -> None:
        deadline = self._clock.now() + timeout
        while not self._waiting:
            if self.error is not None:
                # a traceback would keep arrays of earlier callers alive
                raise self.error.with_traceback(None)
            remaining = deadline - self._clock.now()
            if remaining <= 0:
                raise HardwareError(
                    f"{self.name} delivered no frame for {timeout:.3g} s: check whether it runs, "
                    "and its cable"
                )
            self._came.wait(remaining)

    def _reclaim(self) -> None:
        """Recover the slots that are no longer referenced."""
        while self._returned:
            run = self._returned.popleft()
            self._shared -= len(run)
            self._free[run.start : run.stop] = [True] * len(run)

    def _forget_oldest(self) -> None:
        place = self._waiting.popleft()
        self._free[place] = True
        self._missed += 1 + self._lost[place]
        self.dropped += 1

    def _next(self, here: int) -> int:
        """Return the first free slot after this one, cyclically; there always is one."""
        count = len(self._free)
        place = next(p % count for p in range(here + 1, here + 1 + count) if self._free[p % count])
        self._free[place] = False
        return place


class _Loan:
    """Owner of returned arrays: its deletion shows that their slots are no longer referenced."""

    def __init__(self, memory: NDArray[Any], returned: deque[range], run: range) -> None:
        interface = memory.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], True)}
        self._memory, self._returned, self._run = memory, returned, run

    def __del__(self) -> None:
        # No lock is needed: it may run at any time, in any thread.
        self._returned.append(self._run)


def _pages(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return page-aligned memory for frames, with readable bytes after it."""
    nbytes = math.prod(shape) * dtype.itemsize
    memory = mmap.mmap(-1, nbytes + _BEYOND, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, np.uint8, nbytes).view(dtype).reshape(shape)
