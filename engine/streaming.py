"""The common loop: it pushes frames of a source into an operation."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.operation import Operation
from mirrorskin.engine.rotation.edited import DerivedSource
from mirrorskin.io import Block, InputError, Source
from mirrorskin.io.findings import Finding
from mirrorskin.io.types import block_memory
from mirrorskin.io.watch import Watch

Progress = Callable[[int], None]
Reader = Callable[[Source, Operation, int], Iterator[Block]]


class Receiver(Protocol):
    """A receiver of frames: an operation, offline or live."""

    @property
    def positions(self) -> Mapping[str, bool]:
        """Positions that ``push`` takes for each frame, and whether it needs them."""

    def push(self, *args: Any, **kwargs: Any) -> None:
        """Process the next frames."""


def feed(
    source: Source, operation: Operation, frames: range | None = None, progress: Progress | None = None
) -> tuple[Finding, ...]:
    """Push frames of a source into an operation, once or twice, and watch them.

    A device that shares the host's memory computes on frames where they are: in an array, or where they were
    read. Frames of files for a device with its own memory, and compressed ones in Zarr, are read and decoded
    while earlier ones are copied and processed.

    Parameters
    ----------
    source : Source
        It is rewound first, if it can be.
    operation : Operation
    frames : range, optional
        Frames to push, in steps of 1, by default all; earlier ones are read and dropped.
    progress : callable, optional
        Called with the number of frames read so far.

    Returns
    -------
    tuple of Finding
        What a user should know about the frames.

    Raises
    ------
    mirrorskin.io.InputError
        The operation needs all frames twice, and the source can only be read once.
    """
    if operation.passes == 2 and not source.rewindable:
        raise InputError(
            f"{source.name} can be read only once, but {type(operation).__name__} needs all frames twice"
        )
    operation.begin(source.shape[1:], source.dtype)
    chosen = range(source.shape[0]) if frames is None else frames
    watch = Watch(source, moved=bool(operation.motions), phased="phase" in operation.positions)
    with ThreadPoolExecutor(1, "mirrorskin-fingerprint") as worker:
        # The result needs it, and it takes about as long as the frames.
        fingerprint = worker.submit(source.fingerprint) if hasattr(source, "fingerprint") else None
        _feed_passes(source, operation, chosen, watch, progress)
        # Frames that a live run used give what they gave live.
        again = source.rewindable and not getattr(source, "used_live", False) and watch.samples.count
        if again and operation.reconsider(watch.samples):
            corrected = _Corrected(source, operation, chosen.start) if operation.corrects else source
            _feed_passes(corrected, operation, chosen, None, progress)
    if fingerprint is not None:
        fingerprint.result()
    return tuple(_as_corrected(one, operation.corrects) for one in watch.findings())


def _as_corrected(finding: Finding, corrects: Collection[str]) -> Finding:
    """Return a finding, as a note if it is of a kind that was corrected."""
    if finding.kind not in corrects:
        return finding
    return replace(finding, text=f"{finding.text.split(':')[0]}, which is corrected", warning=False)


class _Corrected(DerivedSource):
    """Frames of a source, corrected by an operation; they are numbered from ``start`` on."""

    def __init__(self, source: Source, operation: Operation, start: int) -> None:
        super().__init__(source)
        assert operation.dtype is not None
        self._operation, self._start, self._dtype = operation, start, source.dtype
        self.dtype = operation.dtype

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames and correct them; see ``Source.read``."""
        out = block_memory(out, self.shape, self.dtype)
        block = self._source.read(np.empty(out.shape, self._dtype))
        if block is None:
            return None
        count = len(block.frames)
        out[:count] = self._operation.corrected(block.frames, block.index - self._start)
        return replace(block, frames=out[:count], lent=False)


def _feed_passes(
    source: Source, operation: Operation, frames: range, watch: Watch | None, progress: Progress | None
) -> None:
    for number in range(operation.passes):
        if number:
            operation.next_pass()
        _feed_once(source, operation, frames, None if number else watch, progress)


def _feed_once(
    source: Source, operation: Operation, frames: range, watch: Watch | None, progress: Progress | None
) -> None:
    if source.rewindable:
        source.rewind()
    done = 0
    for block in _read_in_place(source, operation, frames.start):
        done += len(block.frames)
        if progress:
            progress(done)
    for block in _reader(source, operation)(source, operation, len(frames)):
        push_block(operation, block)
        if watch:
            watch.push(block)
        done += len(block.frames)
        if progress:
            progress(done)


def push_block(operation: Receiver, block: Block, part: slice = slice(None)) -> None:
    """Push a block of a source, or a part of it: frames and their required positions."""
    given = {}
    for name in operation.positions:
        values = getattr(block, name, None)
        if values is not None:
            given[name] = values[part]
    operation.push(block.frames[part], **given, lent=block.lent)


def _reader(source: Source, operation: Operation) -> Reader:
    """Return how frames are read for an operation."""
    if not operation.on_device:
        return _read_in_place
    ahead = not operation.device.info.shares_memory or getattr(source, "read_ahead", False)
    read = _read_ahead if ahead else _read_in_place
    return partial(_lent_or_read, read=read) if operation.long_blocks else read


def _read_in_place(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames into the operation's own array."""
    while count > 0:
        block = source.read(operation.room[:count])
        if block is None:
            return
        yield block
        count -= len(block.frames)


def _lent_or_read(source: Source, operation: Operation, count: int, *, read: Reader) -> Iterator[Block]:
    """Use frames in the memory of the source, as many at once as it allows."""
    lend: Callable[[int], Block | None] = getattr(source, "lend", lambda most: None)
    frame_size = math.prod(source.shape[1:]) * source.dtype.itemsize
    most = max(1, operation.device.max_allocation // frame_size)
    while count > 0 and (block := lend(min(count, most))) is not None:
        yield block
        count -= len(block.frames)
    if count > 0:
        yield from read(source, operation, count)


def _read_ahead(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames into two arrays in turn, one while the other is copied from."""
    length = max(1, len(operation.room) // 2)
    shape = max(1, min(length, count)), *operation.room.shape[1:]
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
