"""What a camera is to the rest of the program: frames with numbers and times, and how many were lost."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.errors import HardwareError

_WINDOW = 128  # frames that the rate is measured over
_REVIEW = 16  # frames from one look at the rate to the next, to tell late ones
_PAUSE = 16  # usual frames; what is longer is a pause
_LATE = 1.5  # periods


@dataclass(frozen=True, slots=True)
class Frames:
    """Some consecutive frames of a camera.

    Attributes
    ----------
    pixels : ndarray, (n, H, W), uint8, uint16 or float32
        Raw counts in C order. The memory is lent: nobody writes to it as long as this array or a view of
        it is referred to, and 64 bytes beyond it may be read (``mirrorskin.io.Block.lent``).
    number : ndarray, (n,), int64
        Numbers of the frames since the camera was opened, from 0 in steps of 1; those lost are counted.
    time : ndarray, (n,), float64
        Seconds on ``time.monotonic``'s scale at which each frame arrived; never decreasing.
    dropped : int
        Frames lost between those taken before (or forgotten by ``flush``) and these.
    """

    pixels: NDArray[Any]
    number: NDArray[np.int64]
    time: NDArray[np.float64]
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Counts:
    """What a camera did since it was opened.

    Attributes
    ----------
    frames : int
        Frames that arrived.
    dropped : int
        Frames lost: overwritten before anyone took them, or missing already when they arrived.
    late : int
        Frames that came more than 1.5 periods after the one before.
    rate : float
        Frames a second that arrived of late, as measured; NaN before the second.
    reconnects : int
        Times that the camera was lost and came back.
    """

    frames: int = 0
    dropped: int = 0
    late: int = 0
    rate: float = math.nan
    reconnects: int = 0


class Camera(Protocol):
    """A camera that runs: its frames arrive by themselves and wait to be taken. See ``docs/camera.md``.

    It runs from its making until ``close``. All of it may be used from any thread, but one thread takes.
    """

    @property
    def name(self) -> str:
        """What to call it in messages."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample: uint8, uint16 or float32."""

    @property
    def counts(self) -> Counts:
        """What it did so far."""

    @property
    def latest(self) -> float:
        """When the newest frame arrived, seconds on ``time.monotonic``'s scale; -inf before the first."""

    @property
    def error(self) -> HardwareError | None:
        """Why no more frames will come; None while they may."""

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one.

        Parameters
        ----------
        most : int
            How many at most; at least 1.
        timeout : float
            Seconds to wait for the first.

        Returns
        -------
        Frames
            At least one, without a gap between them.

        Raises
        ------
        HardwareError
            None came in time, or none will come any more.
        """

    def flush(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""

    def close(self) -> None:
        """Let the camera go, whatever its state; a second time does nothing."""


class Tally:
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
        """Tell what was counted, with what others counted."""
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
