"""Sources: frames in memory or from an iterator, sources that change others, and how a run reads them."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, as_any_array, on_host
from mirrorskin.engine.base.operation import Operation
from mirrorskin.io import Block, Header, InputError, Motion, Source
from mirrorskin.io.base.arguments import as_array, check_pixel_size
from mirrorskin.io.base.samples import COLOURED, convert_samples, frame_dtype, is_coloured_shape
from mirrorskin.io.base.types import Closing, Floats, block_memory
from mirrorskin.io.storage.layout import POSITIONS, as_series
from mirrorskin.kernels.array import Array


class DerivedSource:
    """Base of sources that read another source, and have its properties."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name, self.header, self.shape = source.name, source.header, source.shape
        self.dtype, self.motion, self.rewindable = source.dtype, source.motion, source.rewindable

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._source.rewind()

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._source.__exit__(kind, error, trace)


class EditedSource(DerivedSource):
    """A source whose blocks are edited after they are read."""

    def __init__(self, source: Source, edit: Callable[[Block], Block]) -> None:
        super().__init__(source)
        self._edit = edit

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames."""
        block = self._source.read(out)
        return block and self._edit(block)


_MOTIONS: Mapping[str, Motion] = {
    **{position: motion for motion, position in POSITIONS.items()},
    "pose": "axial",
    "tilt": "axial",
}
ENDLESS = sys.maxsize
"""Number of frames of a source that does not know it."""


class ArraySource(Closing):
    """Frames in an array, (T, H, W), on the host or on a device, with positions by name.

    Samples are converted to a type that the operation takes. The motion is that of the given position, or
    the operation's.
    """

    names_errors = False  # messages about arguments do not begin with the name of the source
    rewindable = True

    def __init__(
        self,
        frames: Any,
        operation: Operation,
        positions: Mapping[str, Any],
        *,
        name: str = "",
        pixel_size: Any = None,
    ) -> None:
        series = _series_of(positions)
        self.name, self._series = name or type(operation).__name__, series
        self._frames = _checked(as_frames(frames, operation, 0))
        self.on_device: Array | None = self._frames if isinstance(self._frames, Array) else None
        self.shape: tuple[int, int, int] = self._frames.shape
        self.dtype: np.dtype[Any] = np.dtype(self._frames.dtype)
        self._describe(operation, pixel_size)
        check_series(series, self.shape[0], self.shape[2])
        self.travel: Floats | None = series.get("travel")
        self.phase: Floats | None = series.get("phase")
        self.time: Floats | None = series.get("time")
        self._next = 0

    def _describe(self, operation: Operation, pixel_size: Any) -> None:
        """Set motion and header."""
        possible = [_MOTIONS[name] for name in self._series if name in _MOTIONS]
        fits = (
            [motion for motion in possible if motion in operation.motions] if operation.motions else possible
        )
        motions = cast("list[Motion]", [*fits, *operation.motions, *possible, "vertical"])
        self.motion: Motion = motions[0]
        size = None if pixel_size is None else check_pixel_size(pixel_size)
        self.header = Header(self.motion, pixel_size=size)

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Return the next frames, at most ``len(out)``, where they are."""
        return self.read_in_place(1 if out is None else len(out))

    def read_in_place(self, count: int) -> Block | None:
        """Return the next frames, at most ``count``, where they are; None at the end."""
        start, stop = self._next, min(self._next + count, self.shape[0])
        if start == stop:
            return None
        self._next = stop
        frames = self._frames if stop - start == self.shape[0] else self._frames[start:stop]
        part = {name: values[start:stop] for name, values in self._series.items()}
        return block_of(frames, start, part, stays_valid=True)

    def frame(self, number: int) -> NDArray[Any]:
        """Return one frame, (H, W), on the host."""
        return np.asarray(on_host(self._frames[number : number + 1])[0])


class IteratorSource(ArraySource):
    """Frames, (H, W), that an iterator yields one by one; they can be read once."""

    rewindable = False

    def __init__(  # it does not know all frames
        self,
        frames: Iterable[Any],
        operation: Operation,
        positions: Mapping[str, Any],
        pixel_size: Any = None,
    ) -> None:
        self.name, self._series = type(operation).__name__, _series_of(positions)
        self._operation, self.on_device = operation, None
        rest = iter(frames)
        first = next(rest, None)
        if first is None:
            raise InputError("there are no frames: give at least one")
        array = _checked(self._frame(first, 0))
        self.shape, self.dtype = (ENDLESS, array.shape[1], array.shape[2]), array.dtype
        self._describe(operation, pixel_size)
        self._rest: Iterator[Any] = itertools.chain([first], rest)
        self._next = 0

    def _frame(self, frame: Any, number: int) -> NDArray[Any]:
        array = as_array("frames", frame)[np.newaxis]
        if array.ndim != 3:
            raise InputError(
                f"frames are {array.dtype} {array.shape[1:]}: numbers (H, W) of one size are needed"
            )
        return cast("NDArray[Any]", as_frames(array, self._operation, number))

    def rewind(self) -> None:
        """Refuse to go back."""
        raise RuntimeError("an iterator cannot be rewound")

    def read_in_place(self, count: int) -> Block | None:
        """Return the next frame; None at the end."""
        frame = next(self._rest, None)
        if frame is None:
            for name, values in self._series.items():
                if len(values) > self._next:
                    raise InputError(
                        f"{name} has shape {values.shape} for {self._next} frames: give one of each frame"
                    )
            return None
        array, number = self._frame(frame, self._next), self._next
        if (array.shape[1:], array.dtype) != (self.shape[1:], self.dtype):
            expected = f"{self.dtype} (n, {self.shape[1]}, {self.shape[2]})"
            raise InputError(f"frames are {array.dtype} {array.shape}: {expected} is needed")
        for name, values in self._series.items():
            if values.ndim == 0 or len(values) <= number:
                text = f"{name} has shape {values.shape} for {number + 1} frames or more"
                raise InputError(f"{text}: give one of each frame")
        self._next += 1
        part = {name: values[number : number + 1] for name, values in self._series.items()}
        return block_of(array, number, part, stays_valid=False)  # it may yield the same memory again


class PushedSource(ArraySource):
    """Frames that are pushed by a loop of the user's own: shape and type at the first push."""

    rewindable = False

    def __init__(self, frames: AnyArray, operation: Operation, positions: Mapping[str, Any]) -> None:
        self.name, self._series = type(operation).__name__, dict(positions)
        _checked(frames)
        self.on_device = frames if isinstance(frames, Array) else None
        self.shape, self.dtype = (ENDLESS, frames.shape[1], frames.shape[2]), np.dtype(frames.dtype)
        self._describe(operation, None)

    def read_in_place(self, count: int) -> Block | None:
        """Refuse to read: frames are pushed."""
        raise InputError("frames were pushed into this run, which has no others. Call result()")


def block_of(frames: AnyArray, first: int, series: Mapping[str, Any], stays_valid: bool) -> Block:
    """Return frames with the positions of each; InputError unless there is one of each of them."""
    check_series(series, len(frames), frames.shape[2])
    positions = dict(series)
    positions["axes"] = positions.pop("pose", None)
    return Block(frames, first, stays_valid=stays_valid, **cast(Any, positions))


def _series_of(positions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the positions, and weights, that are given."""
    return {name: as_series(name, values) for name, values in positions.items() if values is not None}


def as_frames(frames: Any, operation: Operation, first: int) -> AnyArray:
    """Return frames in a type, and where, an operation takes them; ``first``: number of the first."""
    array = as_any_array("frames", frames)
    if not operation.for_device:
        array = on_host(array)
    if operation.dtypes is not None and array.dtype not in operation.dtypes and isinstance(array, np.ndarray):
        array = convert_samples(array, frame_dtype(array.dtype, "frames"), "frames", first)
    return array


def _checked(array: AnyArray) -> AnyArray:
    """Return frames; raise InputError unless they are numbers, (n, H, W)."""
    if array.ndim == 2 and 0 not in array.shape:
        raise InputError(f"frames are {array.dtype} {array.shape}: for a single frame, pass frame[None]")
    if array.ndim != 3 or 0 in array.shape or array.dtype.kind not in "uif":
        needed = COLOURED if is_coloured_shape(array.shape) else "numbers (n, H, W) are needed"
        raise InputError(f"frames are {array.dtype} {array.shape}: {needed}")
    return array


def check_series(series: Mapping[str, Any], count: int, columns: int) -> None:
    """Raise InputError unless there is one of each of some frames."""
    for name, values in series.items():
        if np.shape(values)[:1] != (count,):
            frames = "1 frame" if count == 1 else f"{count} frames"
            last = np.shape(values)[:1] == (columns,)
            axes = "; if the frames are the last axis, use numpy.moveaxis(frames, -1, 0)" if last else ""
            raise InputError(
                f"{name} has shape {np.shape(values)} for {frames}: give one of each frame{axes}"
            )


class CorrectedSource(DerivedSource):
    """Frames of a source, corrected by an operation; they are numbered from ``start`` on."""

    def __init__(self, source: Source, operation: Operation, start: int) -> None:
        super().__init__(source)
        self._operation, self._start, self._dtype = operation, start, source.dtype
        self.dtype = np.dtype(np.float32)

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames and correct them; see ``Source.read``."""
        out = block_memory(out, self.shape, self.dtype)
        block = self._source.read(np.empty(out.shape, self._dtype))
        if block is None:
            return None
        count, first = len(block.frames), block.index - self._start
        out[:count] = self._operation.apply_correction(on_host(block.frames), first)
        return replace(block, frames=out[:count], stays_valid=False)


def blocks_of(
    source: Source, operation: Operation, frames: range | None
) -> Iterator[tuple[int, Block | None]]:
    """Yield the number of frames read so far with each block; None for frames before those that are used.

    A device that shares the host's memory computes on frames where they are: in an array, or where they were
    read. Frames of files for a device with its own memory, and compressed ones in Zarr, are read and decoded
    while earlier ones are copied and processed.
    """
    chosen = range(source.shape[0]) if frames is None else frames
    processed = 0
    for block in _read_into_buffer(source, operation, chosen.start):
        processed += len(block.frames)
        yield processed, None
    for block in _read(source, operation, len(chosen)):
        processed += len(block.frames)
        yield processed, block


def _read(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames as it suits the operation, the device and the source."""
    if not operation.for_device:
        yield from _read_into_buffer(source, operation, count)
        return
    read_in_place: Callable[[int], Block | None] = getattr(source, "read_in_place", lambda count: None)
    frame_size = math.prod(source.shape[1:]) * source.dtype.itemsize
    limit = max(1, operation.device.max_allocation // frame_size)
    if getattr(source, "on_device", None) is not None:
        limit = count
    while (
        count > 0 and (block := read_in_place(min(count, limit))) is not None
    ):  # where they are, as many as possible
        yield block
        count -= len(block.frames)
    if count > 0:
        ahead = not operation.device.info.shares_memory or getattr(source, "read_ahead", False)
        yield from (_read_ahead if ahead else _read_into_buffer)(source, operation, count)


def _read_into_buffer(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames into the operation's own array."""
    while count > 0:
        block = source.read(operation.staging_buffer[:count])
        if block is None:
            return
        yield block
        count -= len(block.frames)


def _read_ahead(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames into two arrays in turn, one while the other is copied from."""
    length = max(1, len(operation.staging_buffer) // 2)
    shape = max(1, min(length, count)), *source.shape[1:]
    buffers = [np.empty(shape, source.dtype) for _ in range(2)]
    with ThreadPoolExecutor(1, "mirrorskin-read") as reader:
        coming = reader.submit(source.read, buffers[0][:count])
        while (block := coming.result()) is not None:
            buffers.reverse()
            count -= len(block.frames)
            if count > 0:
                coming = reader.submit(source.read, buffers[0][:count])
            yield block
            if count <= 0:
                return
