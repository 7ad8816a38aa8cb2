"""Frames in chunks: where they lie in a file, read past HDF5 and unpacked by several threads, each once."""

from __future__ import annotations

import itertools
import logging
import math
import mmap
import os
import tempfile
import weakref
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.codecs import Bytes, Codec, decode
from mirrorskin.io.mapped_stack import SPARE, MappedStack
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.selection import Place, Region, Selection


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """The chunks of a dataset.

    Attributes
    ----------
    shape : (int, int, int)
        Of a chunk, in samples.
    offsets, sizes : ndarray, one element a chunk along each axis, int64
        Where the stored bytes begin, and how many they are.
    left_out : ndarray, likewise
        A bit for each filter that a chunk did not go through.
    """

    shape: tuple[int, int, int]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    left_out: NDArray[np.int64]

    def frame_by_frame(self, itemsize: int) -> ChunkIndex:
        """Return the index of raw chunks as if each were of one frame: parts of them can be read."""
        size = math.prod(self.shape[1:]) * itemsize
        steps = size * np.arange(self.shape[0])[:, None, None]
        offsets = (self.offsets[:, None] + steps).reshape(-1, *self.offsets.shape[1:])
        sizes = np.full_like(offsets, size)
        return ChunkIndex((1, *self.shape[1:]), offsets, sizes, np.zeros_like(offsets))

    def piece(self, shape: tuple[int, int, int]) -> int | None:
        """Return where raw chunks of one frame begin, if each begins where the one before ends."""
        offsets, sizes = self.offsets.ravel()[: shape[0]], self.sizes.ravel()[: shape[0] - 1]
        if self.shape != (1, *shape[1:]) or np.any(np.diff(offsets) != sizes):
            return None
        return int(offsets[0])


def chunk_index(dataset: h5py.Dataset, shape: tuple[int, int, int], size: int) -> ChunkIndex | str:
    """Return where the chunks lie, or why that cannot be said.

    Parameters
    ----------
    dataset : h5py.Dataset
    shape : (int, int, int)
        Its frames, or the first of them, rows and columns.
    size : int
        Bytes of the file.

    Raises
    ------
    OSError, ValueError
        The file is damaged: chunks are missing, or outside the file.
    """
    if dataset.file.userblock_size:
        return "user block"  # HDF5's versions differ in what they count from
    if not hasattr(dataset.id, "chunk_iter"):
        return "old HDF5"
    chunks: list[h5py.h5d.StoreInfo] = []
    dataset.id.chunk_iter(chunks.append)
    grid = tuple(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
    places = np.array([chunk.chunk_offset for chunk in chunks], np.int64) // dataset.chunks
    values = np.array([(chunk.byte_offset, chunk.size, chunk.filter_mask) for chunk in chunks], np.int64)
    wanted = np.all(places < grid, axis=1)
    places, values = places[wanted], values[wanted]
    offsets, sizes, left_out = np.full((3, *grid), -1, np.int64)
    for into, column in zip((offsets, sizes, left_out), values.T, strict=True):
        into[tuple(places.T)] = column
    if np.any(offsets < 0):
        raise ValueError("(chunks are missing)")
    if np.any(offsets + sizes > size):
        raise OSError("truncated: a chunk lies behind the end")
    if _raw_edges(dataset, shape, sizes, left_out):
        return "raw chunks at the edge"
    return ChunkIndex(dataset.chunks, offsets, sizes, left_out)


def _raw_edges(
    dataset: h5py.Dataset, shape: tuple[int, ...], sizes: NDArray[np.int64], left_out: NDArray[np.int64]
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
    return bool(np.any(edge & (sizes == raw) & (left_out == 0)))


class Hdf5Reader:
    """A dataset that HDF5 reads, in one thread.

    Parameters
    ----------
    dataset : h5py.Dataset
    place : Place
    why : str
        What keeps us from fetching its frames ourselves.
    """

    def __init__(self, dataset: h5py.Dataset, place: Place, why: str) -> None:
        self.shape = dataset.shape
        self.dtype: np.dtype[Any] = dataset.dtype.newbyteorder("=")
        self.chunk = dataset.chunks or (1, *dataset.shape[1:])
        self.rooms = math.prod(self.chunk) * self.dtype.itemsize
        self.how = f"through HDF5 ({why})"
        self._dataset, self._place = dataset, place

    def fetch(self, cut: Selection, out: NDArray[Any]) -> None:
        """Write a part into ``out``."""
        room = out if out.flags.c_contiguous else np.empty(out.shape, out.dtype)
        with self._place.reading(*cut.frames):
            self._dataset.read_direct(room, (slice(*cut.frames), *cut.region.slices))
        if room is not out:
            out[...] = room

    def close(self) -> None:
        """Do nothing: the file is the recording's to close."""


Position = tuple[int, ...]


class ChunkReader:
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

    def fetch(self, cut: Selection, out: NDArray[Any]) -> None:
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

    def _work(self, work: deque[Position], cut: Selection, out: NDArray[Any]) -> None:
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

    def _chunk(self, position: Position, cut: Selection, out: NDArray[Any], room: _Room) -> None:
        """Bring one chunk to where it is wanted."""
        spans = [(p * c, (p + 1) * c) for p, c in zip(position, self.chunk, strict=True)]
        whole = Selection(spans[0], Region(spans[1], spans[2]))
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


# What was unpacked is worked on next. For less than so many frames, each of them costs more.
_CACHE, _AT_ONCE = 32 << 20, 32

_log = logging.getLogger("mirrorskin.io")


class ChunkedStack:
    """A cut of a dataset in chunks, read in order.

    Chunks that hold more frames than are asked for at a time are unpacked into memory, and their frames are
    lent from there. If there is no room for all chunks of some frames, the whole cut is unpacked into a
    temporary file instead, and that is mapped.

    Parameters
    ----------
    chunks : ChunkReader or Hdf5Reader
    place : Place
    cut : Selection
    memory_limit : int
        Bytes that unpacked frames may take which are kept for later reads.
    """

    def __init__(
        self, chunks: ChunkReader | Hdf5Reader, place: Place, cut: Selection, memory_limit: int
    ) -> None:
        self.shape, self.dtype = cut.shape, chunks.dtype
        self._chunks, self._place, self._cut, self._limit = chunks, place, cut, memory_limit
        self._held: tuple[int, int] | None = None
        self._frames: NDArray[Any] | None = None
        self._memory: mmap.mmap | None = None
        self._disk: MappedStack | None = None

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
            self._chunks.fetch(Selection((first, last), self._cut.region), out[: stop - start])
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
        self._chunks.fetch(Selection((start, stop), self._cut.region), frames)
        self._frames, self._held = frames, (start, stop)

    def _unpacked(self) -> MappedStack:
        """Unpack everything into a file without a name, and map it."""
        size = math.prod(self.shape) * self.dtype.itemsize
        self._tell(f"disk: {size / 1e9:.3g} GB in {tempfile.gettempdir()}")
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with as_input_error(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, size + SPARE)
            pages = mmap.mmap(file.fileno(), size)
            frames: NDArray[Any] = np.ndarray(self.shape, self.dtype, pages)
            for part in self._parts():
                self._chunks.fetch(part, frames[part.within(self._cut)])
                pages.madvise(mmap.MADV_DONTNEED)  # they stay in the file, and leave this process
            whole = Selection((0, self.shape[0]), Region.whole(self.shape[1:]))
            return MappedStack(
                file.fileno(), self._place, 0, self.shape, self.dtype, whole, "unpacked to disk"
            )

    def _parts(self) -> Iterator[Selection]:
        """Cut the cut along the borders of chunks, into as large pieces as there is memory for."""
        _, height, width = self._chunks.chunk
        size = math.prod(self._chunks.chunk) * self.dtype.itemsize
        across = width * max(1, self._limit // (2 * size))
        region, frame = self._cut.region, 0
        while frame < self.shape[0]:
            frames = self._slab(frame)
            for rows in _pieces(region.rows, height):
                for columns in _pieces(region.columns, across):
                    yield Selection(frames, Region(rows, columns))
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
