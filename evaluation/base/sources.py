"""Sources of frames in memory, for tests, reports and benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine import Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.sources import ArraySource
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.io import Block, Header, Result
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


class Frames(Closing):
    """Frames in memory, (T, H, W), as a source, with a series of each position, such as ``travel`` in mm."""

    rewindable, truth = True, None

    def __init__(
        self, frames: NDArray[Any], header: Header, name: str = "frames in memory", **series: Floats
    ) -> None:
        self.header, self.motion, self.name = header, header.motion, name
        self.shape = (len(frames), frames.shape[1], frames.shape[2])
        self.dtype = frames.dtype
        self.frames, self.series = frames, series
        self._next = 0

    @property
    def block(self) -> Block:
        """All frames as one block, which a device can use in place."""
        return self._part(0, len(self.frames))

    def first(self, count: int) -> Frames:
        """Return a source of the first frames."""
        series = {name: values[:count] for name, values in self.series.items()}
        return Frames(self.frames[:count], self.header, self.name, **series)

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Return the next frames in place; see ``Source.read``."""
        start = self._next
        self._next = min(start + (1 if out is None else len(out)), len(self.frames))
        return self._part(start, self._next) if start < self._next else None

    def _part(self, start: int, stop: int) -> Block:
        series: dict[str, Any] = {name: values[start:stop] for name, values in self.series.items()}
        return Block(self.frames[start:stop], start, stays_valid=True, **series)


def run_unchecked(operation: Any, frames: NDArray[Any], **positions: Floats) -> Result:
    """Return the result of an operation on frames that show no surface: their neighbours are independent.

    Checks of a recording would take differences of neighbours for errors, such as those of a lens that blurs.
    """
    source = ArraySource(frames, operation, positions)
    return Run(Plan(operation, checked=False), source).complete()


class Paced(Closing):
    """A live source of frames from memory, which like a camera does not wait for its reader.

    It starts with the first read. A read waits for the next frame, and returns it with all frames since the
    last read, in place in a ring buffer. If the reader is late by more than the length of the ring buffer,
    the oldest frames are lost; `Block.dropped` is their number.
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
        clock: Clock = SYSTEM,
    ) -> None:
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = (count, *frames.shape[1:]), frames.dtype
        self._frames, self._order, self._places = frames, order, places
        self._rate, self._clock = rate, clock
        self._ring = shared_memory((slots, *frames.shape[1:]), frames.dtype)
        self._start: float | None = None
        self._given = 0
        self._read: list[Floats] = []
        self._position = "phase" if self.motion == "axial" else "travel"

    def now(self) -> float:
        """Return the seconds since the first frame was due."""
        return 0.0 if self._start is None else self._clock.now() - self._start

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames read so far."""
        return {self._position: np.concatenate([np.empty(0), *self._read])}

    def rewind(self) -> None:
        """Raise an error: time cannot be repeated."""
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
        np.take(
            self._frames, self._order(number), axis=0, out=frames, mode="clip"
        )  # without an intermediate copy
        self._given = first + length
        place = np.asarray(self._places(number), np.float64)
        self._read.append(place)
        where: dict[str, Any] = {self._position: place}
        return Block(frames, first, time=number / self._rate, dropped=dropped, stays_valid=True, **where)

    def _wait(self) -> int:
        """Wait until the next frame is due, and return the number of frames due by then."""
        if self._start is None:
            self._start = self._clock.now()
        early = self._given / self._rate - self.now()
        if early > 0:
            self._clock.sleep(early)
        due = max(self._given + 1, int(self.now() * self._rate) + 1)
        return min(int(self.shape[0]), due)
