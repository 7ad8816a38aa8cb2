"""What cameras share that a thread drains: frames are counted and wait in a ring."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.hw.camera import Counts, Frames
from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.ring import Ring, usual_slots
from mirrorskin.io.types import Closing

_WINDOW = 128  # frames that the rate is measured over
_REVIEW = 16  # frames from one look at the rate to the next, to tell late ones
_PAUSE = 16  # usual frames; what is longer is a pause
_LATE = 1.5  # periods


class ThreadedCamera(Closing):
    """A ``mirrorskin.hw.camera.Camera`` but for the thread that brings the frames, and ``close``.

    That thread fills ``_slot()`` and calls ``_put``, again and again, and ``_fail`` when it gives up.

    Parameters
    ----------
    name : str
        What messages call it.
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        uint8, uint16 or float32.
    rate : float, optional
        Frames a second, if it is known.
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.
    clock : Clock
        What frames' times are on, and readers wait by.
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
        """What it did so far."""
        return self._counter.counts(self._ring.dropped, self._reconnects)

    @property
    def latest(self) -> float:
        """When the newest frame arrived, monotonic seconds; -inf before the first."""
        return self._counter.latest

    @property
    def error(self) -> HardwareError | None:
        """Why no more frames will come; None while they may."""
        return self._ring.error

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one; see ``Camera.take``."""
        return self._ring.take(most, timeout)

    def flush(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""
        self._ring.flush()

    def _slot(self) -> NDArray[Any]:
        """Return the place for the next frame, (H, W); see ``Ring.slot``."""
        return self._ring.slot()

    def _put(self, time: float, lost: int = 0) -> None:
        """Let readers have what is in the slot, which arrived at a time, after so many lost frames."""
        self._counter.add(time)
        self._ring.put(time, self._number + lost, lost)
        self._number += lost + 1

    def _fail(self, message: str) -> None:
        """Tell readers that no more frames will come, and why."""
        self._ring.fail(HardwareError(message))


class FrameCounter:
    """Counts frames as they arrive, and measures how many a second do. Any thread may ask.

    The rate is that of the last 128 frames without the pauses between them: intervals that are longer
    than 16 frames usually take. Neither jitter nor bursts of frames move it much.
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
        """When the newest frame arrived; -inf before the first."""
        return self._last

    def add(self, time: float) -> None:
        """Count a frame that arrived at a time, seconds."""
        with self._lock:
            if time - self._last > self._longest:
                self._late += 1
            self._times[self._frames % _WINDOW] = self._last = time
            self._frames += 1
            if self._frames % _REVIEW == 0:
                self._longest = _LATE / self._rate()

    def counts(self, dropped: int = 0, reconnects: int = 0) -> Counts:
        """Return what was counted, with what others counted."""
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
        # A clock need not tell two frames of a burst apart.
        return float(len(counted) / max(counted.sum(), 1e-9))
