"""Base class of cameras that a thread reads: frames are counted and wait in a ring buffer."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.hw.base.camera import Counts, Frames
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.cameras.ring import Ring, usual_slots
from mirrorskin.io.base.types import Closing

_WINDOW = 128  # number of frames from which the rate is measured
_REVIEW = 16  # the median period is recomputed after this many frames
_PAUSE = 16  # median periods; a longer interval is a pause
_LATE = 1.5  # periods after which a frame is late


class ThreadedCamera(Closing):
    """A ``mirrorskin.hw.Camera`` without the thread that reads frames, and without ``close``.

    A subclass starts a thread that fills ``_slot()`` and calls ``_put`` repeatedly, and ``_fail`` when it
    gives up.

    Parameters
    ----------
    name : str
        Name in messages.
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        uint8, uint16 or float32.
    rate : float, optional
        Frames per second, if known.
    slots : int, optional
        Number of frames that can wait; see ``mirrorskin.hw.cameras.ring.usual_slots``.
    clock : Clock
        Clock of the frames' times and of waiting readers.
    """

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    def __init__(
        self,
        name: str,
        shape: tuple[int, int],
        dtype: DTypeLike,
        rate: float | None = None,
        slots: int | None = None,
        clock: Clock = SYSTEM,
    ) -> None:
        self.name = name
        self.shape, self.dtype = shape, np.dtype(dtype)
        slots = usual_slots(shape, dtype, rate) if slots is None else slots
        self.clock = clock
        self._ring = Ring(shape, dtype, slots, name, clock)
        self._counter = FrameCounter()
        self._number = 0
        self._reconnects = 0

    @property
    def counts(self) -> Counts:
        """Statistics so far."""
        return self._counter.counts(self._ring.dropped, self._reconnects)

    @property
    def latest(self) -> float:
        """Arrival of the newest frame, seconds of ``time.monotonic``; -inf before the first."""
        return self._counter.latest

    @property
    def error(self) -> HardwareError | None:
        """Reason why no more frames will arrive; None while the camera works."""
        return self._ring.error

    def take(self, limit: int, timeout: float) -> Frames:
        """Take the oldest waiting frames, or wait for one; see ``Camera.take``."""
        return self._ring.take(limit, timeout)

    def flush(self) -> None:
        """Discard the waiting frames; they do not count as dropped."""
        self._ring.flush()

    def _slot(self) -> NDArray[Any]:
        """Return the buffer for the next frame, (H, W); see ``Ring.slot``."""
        return self._ring.slot()

    def _put(self, time: float, lost: int = 0) -> None:
        """Publish the frame in the slot, with its time of arrival and the number of frames lost before it."""
        self._counter.add(time)
        self._ring.put(time, self._number + lost, lost)
        self._number += lost + 1

    def _fail(self, message: str) -> None:
        """Report to readers that no more frames will arrive, with the reason."""
        self._ring.fail(HardwareError(message))


class FrameCounter:
    """Counts frames and measures their rate. All methods are thread-safe.

    The rate is computed from the last 128 frames without pauses, which are intervals longer than 16 usual
    periods. Jitter and bursts of frames hardly affect it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._times = np.full(_WINDOW, math.nan)
        self._frames = 0
        self._late = 0
        self._last = -math.inf
        self._longest = math.inf

    @property
    def latest(self) -> float:
        """Arrival of the newest frame; -inf before the first."""
        return self._last

    def add(self, time: float) -> None:
        """Count a frame with its time of arrival, seconds."""
        with self._lock:
            if time - self._last > self._longest:
                self._late += 1
            self._times[self._frames % _WINDOW] = self._last = time
            self._frames += 1
            if self._frames % _REVIEW == 0:
                self._longest = _LATE / self._rate()

    def counts(self, dropped: int = 0, reconnects: int = 0) -> Counts:
        """Return the statistics, with the numbers of drops and reconnects given."""
        with self._lock:
            return Counts(self._frames, dropped, self._late, self._rate(), reconnects)

    def _rate(self) -> float:
        held = min(self._frames, _WINDOW)
        if held < 2:
            return math.nan
        times = np.roll(self._times, -self._frames)[-held:] if held == _WINDOW else self._times[:held]
        step = min(_PAUSE, held // 2)
        intervals = np.diff(times)
        counted = intervals[intervals <= np.median(times[step:] - times[:-step])]
        # Two frames of a burst may have the same time.
        return float(len(counted) / max(counted.sum(), 1e-9))
