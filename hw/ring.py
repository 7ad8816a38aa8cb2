"""A ring of frames from a camera's thread to a reader: no copies, and no waiting for a late reader."""

from __future__ import annotations

import math
import mmap
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.hw.camera import Frames
from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.errors import HardwareError

MEMORY = 64_000_000  # bytes that a ring takes, where nothing else is said
_SECONDS = 0.5
_LEAST, _MOST = 4, 1024  # frames
_BEYOND = 64  # bytes behind the frames, so that a kernel may load its last word whole


def usual_slots(shape: tuple[int, int], dtype: DTypeLike, rate: float | None = None) -> int:
    """Return how many frames a ring should hold: 64 MB, but 4 to 1024 frames; more where 0.5 s takes more."""
    room = MEMORY // max(1, math.prod(shape) * np.dtype(dtype).itemsize)
    return max(_LEAST, min(room, _MOST), math.ceil(_SECONDS * (rate or 0.0)))


class Ring:
    """Frames side by side in memory that a device can work on in place.

    One thread writes: it fills ``slot()`` and calls ``put``, again and again, and never waits. One other
    takes. When all places are full, the oldest frame that waits is lost, and counted. A place that was
    taken is not written to as long as anything refers to the array that ``take`` gave, or to a view of it.
    At most half of the places are lent so; a reader that keeps more than these is given copies, so it can
    never stop the camera.

    The memory begins on a page, and 64 bytes beyond each frame may be read. Frames that were put one after
    the other lie one after the other, up to the last place. `slots` frames, of `shape` (H, W), may wait.
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
        self.dropped: int = 0  # frames lost so far, here or before they came here
        self.error: HardwareError | None = None
        # Besides: one is being written to; and while one is lent and one copied, one can wait.
        places = max(slots + 2, 4)
        self._slots = slots
        self._most_lent = max(1, slots // 2)
        self._places = _pages((places, *shape), np.dtype(dtype))
        self._time = np.zeros(places)
        self._number = np.zeros(places, np.int64)
        self._lost = [0] * places  # before each frame
        self._free = [True] * places
        self._waiting: deque[int] = deque()
        self._missed = 0  # frames lost since the last that was taken
        self._lent = 0
        self._returned: deque[range] = deque()
        self._writing = 0
        self._free[0] = False
        self._clock = clock
        self._came = clock.condition()

    def slot(self) -> NDArray[Any]:
        """Return the place for the next frame, (H, W); it stays the same until ``put``."""
        place: NDArray[Any] = self._places[self._writing]
        return place

    def put(self, time: float, number: int, lost: int = 0) -> None:
        """Let readers have what is in the slot, which arrived at a time, after so many lost frames."""
        with self._came:
            here = self._writing
            self._time[here], self._number[here], self._lost[here] = time, number, lost
            self.dropped += lost
            self._waiting.append(here)
            self._reclaim()
            while len(self._waiting) > max(1, self._slots - self._lent):
                self._forget_oldest()
            self._writing = self._next(here)
            self._came.notify()

    def fail(self, error: HardwareError) -> None:
        """Tell readers, also one that waits, that no more frames will come; those that wait can be taken."""
        with self._came:
            if self.error is None:
                self.error = error
            self._came.notify_all()

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one; see ``mirrorskin.hw.camera.Camera.take``.

        Fewer are given than wait where frames were lost between them, at the last place, and where more
        would be half of the ring.
        """
        with self._came:
            self._wait(timeout)
            self._reclaim()
            room = self._most_lent - self._lent
            run = self._run(min(max(1, most), room if room > 0 else len(self._free) - 2 - self._lent))
            self._lent += len(run)
            missed, self._missed = self._missed + self._lost[run.start], 0
            part = slice(run.start, run.stop)
            number, time = self._number[part].copy(), self._time[part].copy()
        pixels = np.asarray(_Loan(self._places[part], self._returned, run))
        if room <= 0:
            copy = _pages(pixels.shape, pixels.dtype)
            copy[:] = pixels
            pixels = copy
        return Frames(pixels, number, time, missed)

    def flush(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""
        with self._came:
            for place in self._waiting:
                self._free[place] = True
            self._waiting.clear()
            self._missed = 0

    def _run(self, most: int) -> range:
        """Take places that wait, side by side and without a loss between them, from the queue."""
        first = self._waiting.popleft()
        stop = first + 1
        while self._waiting and stop - first < most and self._waiting[0] == stop and not self._lost[stop]:
            self._waiting.popleft()
            stop += 1
        return range(first, stop)

    def _wait(self, timeout: float) -> None:
        deadline = self._clock.now() + timeout
        while not self._waiting:
            if self.error is not None:
                raise self.error.with_traceback(None)  # it would keep what earlier takers held
            left = deadline - self._clock.now()
            if left <= 0:
                raise HardwareError(
                    f"{self.name} gave no frame for {timeout:.3g} s: see whether it runs, and its cable"
                )
            self._came.wait(left)

    def _reclaim(self) -> None:
        """Take back the places that nobody refers to any more."""
        while self._returned:
            run = self._returned.popleft()
            self._lent -= len(run)
            self._free[run.start : run.stop] = [True] * len(run)

    def _forget_oldest(self) -> None:
        place = self._waiting.popleft()
        self._free[place] = True
        self._missed += 1 + self._lost[place]
        self.dropped += 1

    def _next(self, here: int) -> int:
        """Choose the first free place behind this one, round the ring; there always is one."""
        count = len(self._free)
        place = next(p % count for p in range(here + 1, here + 1 + count) if self._free[p % count])
        self._free[place] = False
        return place


class _Loan:
    """What the arrays that were given refer to: when it goes, nobody sees its places any more."""

    def __init__(self, memory: NDArray[Any], returned: deque[range], run: range) -> None:
        interface = memory.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], True)}
        self._memory, self._returned, self._run = memory, returned, run

    def __del__(self) -> None:
        # This needs no lock: it may happen in the midst of anything, in any thread.
        self._returned.append(self._run)


def _pages(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Make room for frames that begins on a page, with bytes beyond that may be read."""
    nbytes = math.prod(shape) * dtype.itemsize
    memory = mmap.mmap(-1, nbytes + _BEYOND, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, np.uint8, nbytes).view(dtype).reshape(shape)
