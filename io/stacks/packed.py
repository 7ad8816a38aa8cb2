"""Frames in chunks: read past HDF5, and unpacked by several threads at once."""

from __future__ import annotations

import itertools
import math
import os
import weakref
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.region import Region
from mirrorskin.io.stacks.codecs import Bytes, Codec, decode
from mirrorskin.io.stacks.index import ChunkIndex
from mirrorskin.io.stacks.stack import Cut, Place

Position = tuple[int, ...]


class Packed:
    """A dataset in chunks, of which threads read and unpack one after the other.

    A chunk of whole frames that are wanted is unpacked where they are wanted; of others the part that is
    wanted is copied there.

    Parameters
    ----------
    file : int
        Descriptor of the open file; it is closed in the end, at the latest with the last reference to this.
    place : Place
    shape : (int, int, int)
        Frames, rows and columns.
    dtype : dtype
    index : ChunkIndex
    codecs : list of callable
        What undoes each filter, in the order of writing.
    threads : int
    """

    def __init__(
        self,
        file: int,
        place: Place,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        index: ChunkIndex,
        codecs: list[Codec],
        threads: int,
    ) -> None:
        self.shape, self.dtype, self.chunk = shape, dtype, index.shape
        self.rooms = threads * math.prod(self.chunk) * dtype.itemsize
        by = "one thread" if threads == 1 else f"{threads} threads"
        self.how = f"chunks {'decoded' if codecs else 'read'} by {by}"
        self._file, self._place, self._index, self._codecs = file, place, index, codecs
        self._let_go = weakref.finalize(self, os.close, file)
        self._threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._rooms: deque[_Room] = deque()

    def fetch(self, cut: Cut, out: NDArray[Any]) -> None:
        """Write a part into ``out``; see ``Chunks.fetch``."""
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(cut.spans, self.chunk, strict=True)]
        work = deque(itertools.product(*ranges))
        helpers = min(self._threads, len(work)) - 1
        if helpers and self._pool is None:
            self._pool = ThreadPoolExecutor(self._threads - 1, "chunks")
        running: list[Future[None]] = []
        try:
            while self._pool is not None and len(running) < helpers:
                running.append(self._pool.submit(self._work, work, cut, out))
            self._work(work, cut, out)
        finally:
            work.clear()  # of an error, too: when this returns, nobody writes to out any more
            for helper in running:
                helper.exception()
        for helper in running:
            helper.result()

    def close(self) -> None:
        """Let go of the file."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        self._file = -1  # which cannot be read, where the number may be another's file by then
        self._let_go()

    def _work(self, work: deque[Position], cut: Cut, out: NDArray[Any]) -> None:
        """Take chunk after chunk, until there is none left."""
        try:
            room = self._rooms.pop()
        except IndexError:
            room = _Room()
        try:
            while True:
                try:
                    position = work.popleft()
                except IndexError:
                    break
                self._chunk(position, cut, out, room)
        except BaseException:
            work.clear()  # so that the others stop, too
            raise
        finally:
            self._rooms.append(room)

    def _chunk(self, position: Position, cut: Cut, out: NDArray[Any], room: _Room) -> None:
        """Bring one chunk to where it is wanted."""
        spans = [(p * c, (p + 1) * c) for p, c in zip(position, self.chunk, strict=True)]
        whole = Cut(spans[0], Region(spans[1], spans[2]))
        part = whole.overlap(cut)
        target = out[part.within(cut)]
        with self._place.reading(spans[0][0], min(spans[0][1], self.shape[0])):
            if target.shape == self.chunk and target.flags.c_contiguous:
                self._decode(position, target.reshape(-1).view(np.uint8), room)
            else:
                unpacked = room.unpacked(math.prod(self.chunk) * self.dtype.itemsize)
                self._decode(position, unpacked, room)
                target[...] = unpacked.view(self.dtype).reshape(self.chunk)[part.within(whole)]

    def _decode(self, position: Position, out: Bytes, room: _Room) -> None:
        offset, size = int(self._index.offsets[position]), int(self._index.sizes[position])
        if not self._codecs:
            _read(self._file, offset, out)
            return
        packed = room.packed(size)
        _read(self._file, offset, packed)
        decode(self._codecs, int(self._index.left_out[position]), packed, out)


class _Room:
    """Memory that one thread uses again and again."""

    def __init__(self) -> None:
        self._packed = self._unpacked = np.empty(0, np.uint8)

    def packed(self, size: int) -> Bytes:
        """Return room for a chunk as it is stored."""
        if self._packed.size < size:
            self._packed = np.empty(size + size // 8, np.uint8)
        return self._packed[:size]

    def unpacked(self, size: int) -> Bytes:
        """Return room for an unpacked chunk."""
        if self._unpacked.size != size:
            self._unpacked = np.empty(size, np.uint8)
        return self._unpacked


def _read(file: int, offset: int, out: Bytes) -> None:
    """Fill an array from a file."""
    done = 0
    while done < out.size:
        count = os.preadv(file, [out[done:].data], offset + done)
        if not count:
            raise OSError("truncated: the file became shorter")
        done += count
