"""Frames from memory that come at a set pace, as from a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.io import Block, Header
from mirrorskin.io.base.types import Closing, Floats

_PAGE, _PADDING = 4096, 64  # frames start on a page, and a kernel may load the last word as a whole
_SLOTS = 256  # frames of the ring buffer, as in a camera


def shared_memory(shape: tuple[int, ...], dtype: Any = np.uint8) -> NDArray[Any]:
    """Allocate memory that a device can use in place; its pages are mapped before anything is timed."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.full(size + _PAGE + _PADDING, 1, np.uint8)
    start = -raw.ctypes.data % _PAGE
    frames: NDArray[Any] = raw[start : start + size].view(dtype).reshape(shape)
    return frames


class Pace:
    """When frames are due: frame n at n / ``rate`` seconds after the first wait."""

    def __init__(self, rate: float, count: int, clock: Clock = SYSTEM) -> None:
        self.rate, self.count = rate, count
        self._clock = clock
        self._start: float | None = None

    def now(self) -> float:
        """Return the seconds since the first frame was due."""
        return 0.0 if self._start is None else self._clock.now() - self._start

    def wait(self, number: int) -> int:
        """Wait until a frame is due, and return the number of frames due by then."""
        if self._start is None:
            self._start = self._clock.now()
        early = number / self.rate - self.now()
        if early > 0:
            self._clock.sleep(early)
        return min(self.count, max(number + 1, int(self.now() * self.rate) + 1))


class Paced(Closing):
    """A live source of frames from memory, which like a camera does not wait for its reader.

    A read waits for the next frame, and returns it with all frames since the last read, in place in a ring
    buffer. If the reader is late by more than the length of the ring buffer, the oldest frames are lost;
    `Block.dropped` is their number.
    """

    name, rewindable = "memory", False

    def __init__(
        self,
        frames: NDArray[Any],
        order: Callable[[NDArray[np.int64]], NDArray[np.int64]],
        header: Header,
        places: Callable[[NDArray[np.int64]], NDArray[np.floating]],
        pace: Pace,
        *,
        slots: int = _SLOTS,
    ) -> None:
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = (pace.count, *frames.shape[1:]), frames.dtype
        self.now = pace.now
        self._frames, self._order, self._places, self._pace = frames, order, places, pace
        self._ring = shared_memory((slots, *frames.shape[1:]), frames.dtype)
        self._given = 0
        self._read: list[Floats] = []
        self._position = "phase" if self.motion == "axial" else "travel"

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames read so far."""
        return {self._position: np.concatenate([np.empty(0), *self._read])}

    def rewind(self) -> None:
        """Raise an error: time cannot be repeated."""
        raise RuntimeError("a live source cannot be rewound")

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Wait for the next frame; see ``Source.read``."""
        if self._given == self._pace.count:
            return None
        due, slots = self._pace.wait(self._given), len(self._ring)
        dropped = max(0, due - self._given - slots)
        first = self._given + dropped
        slot = first % slots
        length = min(due - first, 1 if out is None else len(out), slots - slot)
        number = np.arange(first, first + length)
        order = self._order(number)
        if length == 1:  # a camera writes to memory without the processor
            frames = self._frames[order[0] : order[0] + 1]
        else:
            frames = self._ring[slot : slot + length]
            np.take(self._frames, order, axis=0, out=frames, mode="clip")  # without an intermediate copy
        self._given = first + length
        place = np.asarray(self._places(number), np.float64)
        self._read.append(place)
        where: dict[str, Any] = {self._position: place}
        return Block(frames, first, time=number / self._pace.rate, dropped=dropped, stays_valid=True, **where)
