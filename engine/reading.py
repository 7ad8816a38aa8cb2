"""How frames are read: where they are, into a staging buffer, or ahead of the device."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.device_arrays import on_host
from mirrorskin.engine.operation import Operation
from mirrorskin.engine.rotation.edited import DerivedSource
from mirrorskin.io import Block, Source
from mirrorskin.io.types import block_memory


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
    done = 0
    for block in _read_in_place(source, operation, chosen.start):
        done += len(block.frames)
        yield done, None
    for block in _read(source, operation, len(chosen)):
        done += len(block.frames)
        yield done, block


def _read(source: Source, operation: Operation, count: int) -> Iterator[Block]:
    """Read frames as it suits the operation, the device and the source."""
    if not operation.for_device:
        yield from _read_in_place(source, operation, count)
        return
    lend: Callable[[int], Block | None] = getattr(source, "lend", lambda most: None)
    frame_size = math.prod(source.shape[1:]) * source.dtype.itemsize
    most = max(1, operation.device.max_allocation // frame_size)
    if getattr(source, "on_device", None) is not None:
        most = count
    while count > 0 and (block := lend(min(count, most))) is not None:  # where they are, as many as possible
        yield block
        count -= len(block.frames)
    if count > 0:
        ahead = not operation.device.info.shares_memory or getattr(source, "read_ahead", False)
        yield from (_read_ahead if ahead else _read_in_place)(source, operation, count)


def _read_in_place(source: Source, operation: Operation, count: int) -> Iterator[Block]:
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
