"""The interface of a camera: frames with numbers and times, and the number of lost frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.errors import HardwareError


@dataclass(frozen=True, slots=True)
class Frames:
    """Consecutive frames of a camera.

    The pixels are raw counts in C order. Their memory is shared: it is not written to while this array or a
    view of it is referenced, and the 64 bytes after it may be read (``mirrorskin.io.Block.stays_valid``).
    """

    pixels: NDArray[Any]  # (n, H, W), uint8, uint16 or float32
    # (n,), counted since the camera was opened, from 0 in steps of 1; lost frames are counted
    number: NDArray[np.int64]
    time: NDArray[np.float64]  # (n,), time of arrival, seconds of time.monotonic; never decreasing
    dropped: int = 0  # frames lost between the previous ones taken (or flushed) and these


@dataclass(frozen=True, slots=True)
class Counts:
    """Statistics of a camera since it was opened."""

    frames: int = 0  # number of frames that arrived
    dropped: int = 0  # frames overwritten before they were taken, or missing on arrival
    late: int = 0  # frames that arrived more than 1.5 periods after the previous one
    rate: float = math.nan  # measured number of recent frames per second; NaN before the second frame
    reconnects: int = 0  # number of times the camera was lost and came back


class Camera(Protocol):
    """A running camera: frames arrive continuously and are buffered until they are taken.

    It runs from construction until ``close``. All methods are thread-safe, but only one thread may take
    frames. A camera may also have ``set_exposure(seconds) -> float``, which changes the exposure while it
    runs, and returns the one that it has then; InputError if that is not possible.
    """

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample: uint8, uint16 or float32."""

    @property
    def counts(self) -> Counts:
        """Statistics so far."""

    @property
    def latest(self) -> float:
        """Arrival of the newest frame, seconds of ``time.monotonic``; -inf before the first."""

    @property
    def error(self) -> HardwareError | None:
        """Reason why no more frames will arrive; None while the camera works."""

    def take(self, limit: int, timeout: float) -> Frames:
        """Take the oldest waiting frames, or wait for one.

        At least one and at most `limit` frames are returned, without a gap between them. HardwareError if
        none arrives within `timeout` seconds, or none will arrive any more.
        """

    def flush(self) -> None:
        """Discard the waiting frames; they do not count as dropped."""

    def close(self) -> None:
        """Close the camera, whatever its state; a second call does nothing."""
