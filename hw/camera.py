"""What a camera is to the rest of the program: frames with numbers and times, and how many were lost."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.errors import HardwareError


@dataclass(frozen=True, slots=True)
class Frames:
    """Some consecutive frames of a camera.

    The pixels are raw counts in C order. Their memory is lent: nobody writes to it as long as this array or a
    view of it is referred to, and 64 bytes beyond it may be read (``mirrorskin.io.Block.lent``).
    """

    pixels: NDArray[Any]  # (n, H, W), uint8, uint16 or float32
    number: NDArray[np.int64]  # (n,), since the camera was opened, from 0 in steps of 1; lost ones count
    time: NDArray[np.float64]  # (n,), arrival, seconds on time.monotonic's scale; never decreasing
    dropped: int = 0  # frames lost between those taken before (or forgotten by flush) and these


@dataclass(frozen=True, slots=True)
class Counts:
    """What a camera did since it was opened."""

    frames: int = 0  # that arrived
    dropped: int = 0  # overwritten before anyone took them, or missing already when they arrived
    late: int = 0  # that came more than 1.5 periods after the one before
    rate: float = math.nan  # frames a second that arrived of late, as measured; NaN before the second
    reconnects: int = 0  # times that the camera was lost and came back


class Camera(Protocol):
    """A camera that runs: its frames arrive by themselves and wait to be taken.

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

        At least one is returned and at most `most`, without a gap between them. HardwareError if none came
        within `timeout` seconds, or none will come any more.
        """

    def flush(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""

    def close(self) -> None:
        """Let the camera go, whatever its state; a second time does nothing."""
