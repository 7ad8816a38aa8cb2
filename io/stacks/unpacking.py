"""Chunks in the order of the frames, each unpacked once, however many frames are asked for at a time."""

from __future__ import annotations

import logging
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.plain import plainly
from mirrorskin.io.region import Region
from mirrorskin.io.stacks.mapped import SPARE, Mapped
from mirrorskin.io.stacks.stack import Chunks, Cut, Place

# What was unpacked is worked on next. For less than so many frames, each of them costs more.
_CACHE, _AT_ONCE = 32 << 20, 32

_log = logging.getLogger("mirrorskin.io")


class Ordered:
    """A cut of a dataset in chunks, read in order.

    Chunks that hold more frames than are asked for at a time are unpacked into memory, and their frames are
    lent from there. If there is no room for all chunks of some frames, the whole cut is unpacked into a
    temporary file instead, and that is mapped.

    Parameters
    ----------
    chunks : Chunks
    place : Place
    cut : Cut
    memory_limit : int
        Bytes that unpacked frames may take which are kept for later reads.
    """

    def __init__(self, chunks: Chunks, place: Place, cut: Cut, memory_limit: int) -> None:
        self.shape, self.dtype = cut.shape, chunks.dtype
        self._chunks, self._place, self._cut, self._limit = chunks, place, cut, memory_limit
        self._held: tuple[int, int] | None = None
        self._frames: NDArray[Any] | None = None
        self._memory: mmap.mmap | None = None
        self._disk: Mapped | None = None

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""
        if self._disk is not None:
            return self._disk.how
        return self._chunks.how if self._held is None else "unpacked into memory"

    def end(self, start: int, stop: int) -> int:
        """End a read where chunks end, so that none is unpacked twice, and while all is in the cache."""
        first, length = self._cut.frames[0], self._chunks.chunk[0]
        size = math.prod(self.shape[1:]) * self.dtype.itemsize
        stop = min(stop, start + max(length, _AT_ONCE, _CACHE // size))
        if (first + start) % length and start:
            return min(stop, self._slab(start)[1] - first)
        aligned = stop if stop == self.shape[0] else (first + stop) // length * length - first
        return aligned if start < aligned else stop

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames in ``out``, or lend those that are kept; see ``Stack.read``."""
        first, last = self._cut.frames[0] + start, self._cut.frames[0] + stop
        slab = self._slab(start)
        if self._disk is None and slab[0] == first and self._slab(stop - 1)[1] == last:
            self._chunks.fetch(Cut((first, last), self._cut.region), out[: stop - start])
            return out[: stop - start]
        if self._disk is None and self._held != slab:
            self._keep(*slab)
        if self._disk is not None:
            return self._disk.read(start, stop, out)
        assert self._frames is not None  # what was not unpacked to disk is kept
        return self._frames[first - slab[0] : last - slab[0]]

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""
        self._chunks.close()
        if self._disk is not None:
            self._disk.close()
        self._frames = self._memory = self._held = None

    def _slab(self, frame: int) -> tuple[int, int]:
        """Return which frames of the stack share their chunks with one of the cut."""
        first, end = self._cut.frames
        length = self._chunks.chunk[0]
        start = (first + frame) // length * length
        return max(start, first), min(start + length, end)

    def _keep(self, start: int, stop: int) -> None:
        """Unpack all chunks of some frames into memory; if there is no room, those of all frames to disk."""
        pixels = math.prod(self._cut.region.shape)
        size = min(self._chunks.chunk[0], self.shape[0]) * pixels * self.dtype.itemsize + SPARE
        # While the next are unpacked, someone may still work on those before.
        alive = 1 if stop - start == self.shape[0] else 2
        if alive * size + self._chunks.rooms > self._limit:
            self._disk = self._unpacked()
            return
        if self._held is None:
            self._tell("memory")
        before = None if self._frames is None else weakref.ref(self._frames)
        self._frames = self._held = None
        if self._memory is None or (before is not None and before() is not None):
            self._memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        shape = (stop - start, *self._cut.region.shape)
        frames: NDArray[Any] = np.ndarray(shape, self.dtype, self._memory)
        self._chunks.fetch(Cut((start, stop), self._cut.region), frames)
        self._frames, self._held = frames, (start, stop)

    def _unpacked(self) -> Mapped:
        """Unpack everything into a file without a name, and map it."""
        size = math.prod(self.shape) * self.dtype.itemsize
        self._tell(f"disk: {size / 1e9:.3g} GB in {tempfile.gettempdir()}")
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with plainly(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, size + SPARE)
            pages = mmap.mmap(file.fileno(), size)
            frames: NDArray[Any] = np.ndarray(self.shape, self.dtype, pages)
            for part in self._parts():
                self._chunks.fetch(part, frames[part.within(self._cut)])
                pages.madvise(mmap.MADV_DONTNEED)  # they stay in the file, and leave this process
            whole = Cut((0, self.shape[0]), Region.whole(self.shape[1:]))
            return Mapped(file.fileno(), self._place, 0, self.shape, self.dtype, whole, "unpacked to disk")

    def _parts(self) -> Iterator[Cut]:
        """Cut the cut along the borders of chunks, into as large pieces as there is memory for."""
        _, height, width = self._chunks.chunk
        size = math.prod(self._chunks.chunk) * self.dtype.itemsize
        across = width * max(1, self._limit // (2 * size))
        region, frame = self._cut.region, 0
        while frame < self.shape[0]:
            frames = self._slab(frame)
            for rows in _pieces(region.rows, height):
                for columns in _pieces(region.columns, across):
                    yield Cut(frames, Region(rows, columns))
            frame = frames[1] - self._cut.frames[0]

    def _tell(self, where: str) -> None:
        frames = self._chunks.chunk[0]
        _log.info(
            "%s: chunks of %s hold %d frames each, more than are read at a time: unpacked to %s",
            self._place.path,
            self._place.dataset,
            frames,
            where,
        )


def _pieces(span: tuple[int, int], length: int) -> Iterator[tuple[int, int]]:
    """Cut a span at the multiples of a length."""
    start, end = span
    while start < end:
        stop = min(end, (start // length + 1) * length)
        yield start, stop
        start = stop
