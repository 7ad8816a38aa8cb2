"""Sources of frames in memory, for tests, reports and benchmarks."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from mirrorskin.engine import Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.sources import ArraySource
from mirrorskin.io import Block, Header, Result
from mirrorskin.io.base.types import Closing, Floats


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
