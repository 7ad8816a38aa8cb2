"""Frames in chunks: where they lie in a file, read past HDF5 and unpacked by several threads, each once."""

from __future__ import annotations

import itertools
import math
import os
import weakref
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.codecs import Bytes, Codec, decode
from mirrorskin.io.hdf5 import chunks_of
from mirrorskin.io.selection import Place, Region, Span


class ChunkIndex(NamedTuple):
    """The chunks of a dataset: of what shape, and in arrays with one element a chunk where they are."""

    shape: tuple[int, int, int]  # samples
    offsets: NDArray[np.int64]  # bytes, in the file
    sizes: NDArray[np.int64]  # bytes, as they are stored
    filter_masks: NDArray[np.int64]  # a bit for each filter that a chunk did not go through

    def contiguous_offset(self, shape: tuple[int, int, int]) -> int | None:
        """Return where raw chunks of whole frames begin, if each begins where the one before ends."""
        offsets, sizes = self.offsets.ravel(), self.sizes.ravel()
        if self.shape[1:] != shape[1:] or np.any(np.diff(offsets) != sizes[:-1]):
            return None
        return int(offsets[0])


def chunk_index(dataset: h5py.Dataset, shape: tuple[int, int, int], size: int) -> ChunkIndex | str:
    """Return where the chunks of the first frames lie in a file of so many bytes, or why that is unknown.

    OSError or ValueError: chunks are missing, or outside the file.
    """
    if dataset.file.userblock_size:
        return "user block"  # HDF5's versions differ in what they count from
    chunks = chunks_of(dataset)
    grid = tuple(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
    places = np.array([chunk.chunk_offset for chunk in chunks], np.int64) // dataset.chunks
    values = np.array([(chunk.byte_offset, chunk.size, chunk.filter_mask) for chunk in chunks], np.int64)
    wanted = np.all(places < grid, axis=1)
    index = np.full((3, *grid), -1, np.int64)
    index[:, *places[wanted].T] = values[wanted].T
    offsets, sizes, masks = index
    if np.any(offsets < 0):
        raise ValueError("(chunks are missing)")
    if np.any(offsets + sizes > size):
        raise OSError("truncated: a chunk lies behind the end")
    if _has_raw_edges(dataset, shape, sizes, masks):
        return "raw chunks at the edge"
    return ChunkIndex(dataset.chunks, offsets, sizes, masks)


def _has_raw_edges(
    dataset: h5py.Dataset, shape: tuple[int, ...], sizes: NDArray[np.int64], masks: NDArray[np.int64]
) -> bool:
    """Tell whether chunks that are partly outside the dataset may not have gone through its filters.

    A dataset can be made so, and HDF5 does not tell whether one is; but then they have the size of raw ones.
    """
    if not dataset.id.get_create_plist().get_nfilters():
        return False
    edge = np.zeros(sizes.shape, bool)
    for axis, (n, c) in enumerate(zip(shape, dataset.chunks, strict=True)):
        if n % c:
            np.moveaxis(edge, axis, 0)[-1] = True
    raw = math.prod(dataset.chunks) * dataset.dtype.itemsize
    return bool(np.any(edge & (sizes == raw) & (masks == 0)))


class Chunks:
    """A dataset in chunks, of which threads read and unpack one after the other.

    A chunk of whole frames that are wanted is unpacked where they are wanted; of others the part that is
    wanted is copied there. The file's descriptor is closed at the latest with the last reference to this.
    """

    def __init__(
        self,
        file: int,
        place: Place,
        frames: int,
        dtype: np.dtype[Any],
        index: ChunkIndex,
        codecs: list[Codec],
        threads: int,
    ) -> None:
        self.length, self._shape, self._dtype = index.shape[0], index.shape, dtype
        self._size = math.prod(index.shape) * dtype.itemsize
        self.scratch_bytes = threads * self._size
        by = "one thread" if threads == 1 else f"{threads} threads"
        self.how = f"chunks {'decoded' if codecs else 'read'} by {by}"
        self._frames, self._file, self._place = frames, file, place
        self._index, self._codecs, self._threads = index, codecs, threads
        self._close_file = weakref.finalize(self, os.close, file)
        self._pools: dict[int, ThreadPoolExecutor] = {}  # of each process: threads stay behind in a fork
        self._scratch: list[_Scratch] = []

    def lend(self, start: int, stop: int) -> None:
        """Lend nothing that was not read."""

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Write a part into ``out``; every chunk that it touches is decoded once."""
        spans = frames, region.rows, region.columns
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(spans, self._shape, strict=True)]
        work = deque(itertools.product(*ranges))

        def take_chunks() -> None:
            scratch = self._scratch.pop() if self._scratch else _Scratch()
            try:
                with suppress(IndexError):  # there is none left
                    while True:
                        self._fetch_chunk(work.popleft(), spans, out, scratch)
            finally:
                work.clear()  # after an error, so that the others stop, too
                self._scratch.append(scratch)

        helpers: list[Future[None]] = []
        try:
            if len(work) > 1 < self._threads:
                pool = self._pools.setdefault(os.getpid(), ThreadPoolExecutor(self._threads - 1, "chunks"))
                while len(helpers) < min(self._threads - 1, len(work) - 1):
                    helpers.append(pool.submit(take_chunks))
            take_chunks()
        finally:
            work.clear()
            wait(helpers)  # when this returns, nobody writes to out any more
        for helper in helpers:
            helper.result()

    def close(self) -> None:
        """Close the file."""
        pool = self._pools.pop(os.getpid(), None)
        if pool is not None:
            pool.shutdown()
        self._file = -1  # the number may be another file's by then
        self._close_file()

    def _fetch_chunk(
        self, position: tuple[int, ...], spans: tuple[Span, ...], out: NDArray[Any], scratch: _Scratch
    ) -> None:
        """Write what a chunk holds of the part with these spans."""
        source, target = [], []
        for p, c, (start, stop) in zip(position, self._shape, spans, strict=True):
            first, last = max(p * c, start), min((p + 1) * c, stop)
            source.append(slice(first - p * c, last - p * c))
            target.append(slice(first - start, last - start))
        wanted = out[*target]
        first = position[0] * self.length
        with self._place.reading(first, min(first + self.length, self._frames)):
            if wanted.shape == self._shape and wanted.flags.c_contiguous:
                self._decode(position, wanted.reshape(-1).view(np.uint8), scratch)
            else:
                unpacked = scratch.room("unpacked", self._size)
                self._decode(position, unpacked, scratch)
                wanted[...] = unpacked.view(self._dtype).reshape(self._shape)[*source]

    def _decode(self, position: tuple[int, ...], out: Bytes, scratch: _Scratch) -> None:
        offset, size = int(self._index.offsets[position]), int(self._index.sizes[position])
        if not self._codecs:
            _read(self._file, offset, out)
            return
        packed = scratch.room("packed", size)
        _read(self._file, offset, packed)
        decode(self._codecs, int(self._index.filter_masks[position]), packed, out)


class _Scratch:
    """Memory that one thread uses again and again."""

    def __init__(self) -> None:
        self._rooms: dict[str, Bytes] = {}

    def room(self, name: str, size: int) -> Bytes:
        room = self._rooms.get(name)
        if room is None or room.size < size:
            room = self._rooms[name] = np.empty(size + size // 8, np.uint8)
        return room[:size]


def _read(file: int, offset: int, out: Bytes) -> None:
    done = 0
    while done < out.size:
        count = os.preadv(file, [out[done:].data], offset + done)
        if not count:
            raise OSError("truncated: the file became shorter")
        done += count
