"""Frames from memory that come when they are due, as from a camera that does not wait."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Block, Header
from mirrorskin.io.types import Closing, Floats

_SLOTS = 256  # frames that wait for a late reader, as in the ring of a camera
_PAGE, _SLACK = 4096, 64  # bytes: frames begin on a page, and may be read beyond their end


class Paced(Closing):
    """A live source of frames from memory, from the first read on.

    A read waits for the next frame, and takes those with it that have come since the read before. They are
    copied to a ring, as a camera does it, and lent. A reader that is late by more than the ring holds loses
    the oldest of them, and is told how many.

    Parameters
    ----------
    frames : ndarray, (n, H, W)
    order : callable
        Returns which of them frames of the source show: of numbers, (k,), numbers from 0 to n - 1.
    header : Header
    places : callable
        Returns where the body is in frames, (k,) float64: travel, or phase.
    rate : float
        Frames a second.
    count : int
    slots : int
        Of the ring.
    clock, sleep : callable
        Tell the seconds, and let some pass.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        As for every source.
    """

    name, rewindable = "memory", False

    def __init__(
        self,
        frames: NDArray[Any],
        order: Callable[[NDArray[np.int64]], NDArray[np.int64]],
        header: Header,
        places: Callable[[NDArray[np.int64]], NDArray[np.floating]],
        rate: float,
        count: int,
        *,
        slots: int = _SLOTS,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = (count, *frames.shape[1:]), frames.dtype
        self._frames, self._order, self._places = frames, order, places
        self._rate, self._clock, self._sleep = rate, clock, sleep
        self._ring = _room((slots, *frames.shape[1:]), frames.dtype)
        self._start: float | None = None
        self._given = 0
        self._read: list[Floats] = []

    def now(self) -> float:
        """Return the seconds since the first frame was due."""
        return 0.0 if self._start is None else self._clock() - self._start

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames read so far."""
        return {self._what: np.concatenate([np.empty(0), *self._read])}

    def rewind(self) -> None:
        """Refuse: time does not run back."""
        raise RuntimeError("a live source cannot be rewound")

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Wait for the next frame; see ``Source.read``."""
        if self._given == self.shape[0]:
            return None
        due, slots = self._wait(), len(self._ring)
        dropped = max(0, due - self._given - slots)
        first = self._given + dropped
        slot = first % slots
        length = min(due - first, 1 if out is None else len(out), slots - slot)
        number = np.arange(first, first + length)
        frames = self._ring[slot : slot + length]
        np.take(self._frames, self._order(number), axis=0, out=frames, mode="clip")  # without a copy between
        self._given = first + length
        place = np.asarray(self._places(number), np.float64)
        self._read.append(place)
        block = Block(frames, first, time=number / self._rate, dropped=dropped, lent=True)
        return replace(block, phase=place) if self._what == "phase" else replace(block, travel=place)

    @property
    def _what(self) -> str:
        return "phase" if self.motion == "axial" else "travel"

    def _wait(self) -> int:
        """Wait until the next frame is due, and return how many are by then."""
        if self._start is None:
            self._start = self._clock()
        early = self._given / self._rate - self.now()
        if early > 0:
            self._sleep(early)
        due = max(self._given + 1, int(self.now() * self._rate) + 1)
        return due if due < self.shape[0] else int(self.shape[0])


def _room(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return memory that a device can work in."""
    size = int(np.prod(shape)) * dtype.itemsize
    raw = np.full(size + _PAGE + _SLACK, 1, np.uint8)  # touched, or its pages would be made while frames wait
    start = -raw.ctypes.data % _PAGE
    return raw[start : start + size].view(dtype).reshape(shape)
