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
from mirrorskin.io.mapped_stack import PADDING, MappedStack
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.selection import Place, Region, Selection

_log = logging.getLogger("mirrorskin.io")


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """The chunks of a dataset: of what shape, and in arrays with one element a chunk where they are."""

    shape: tuple[int, int, int]  # samples
    offsets: NDArray[np.int64]  # bytes, in the file
    sizes: NDArray[np.int64]  # bytes, as they are stored
    filter_masks: NDArray[np.int64]  # a bit for each filter that a chunk did not go through

    def frame_by_frame(self, itemsize: int) -> ChunkIndex:
        """Return the index of raw chunks as if each were of one frame: parts of them can be read."""
        size = math.prod(self.shape[1:]) * itemsize
        steps = size * np.arange(self.shape[0])[:, None, None]
        offsets = (self.offsets[:, None] + steps).reshape(-1, *self.offsets.shape[1:])
        return ChunkIndex((1, *self.shape[1:]), offsets, np.full_like(offsets, size), np.zeros_like(offsets))

    def contiguous_offset(self, shape: tuple[int, int, int]) -> int | None:
        """Return where raw chunks of one frame begin, if each begins where the one before ends."""
        offsets, sizes = self.offsets.ravel()[: shape[0]], self.sizes.ravel()[: shape[0] - 1]
        if self.shape != (1, *shape[1:]) or np.any(np.diff(offsets) != sizes):
            return None
        return int(offsets[0])


def chunk_index(dataset: h5py.Dataset, shape: tuple[int, int, int], size: int) -> ChunkIndex | str:
    """Return where the chunks of the first frames lie in a file of so many bytes, or why that is unknown.

    OSError or ValueError: chunks are missing, or outside the file.
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


class Hdf5Reader:
    """A dataset that HDF5 itself reads, in one thread; ``why`` says what keeps us from doing so."""

    def __init__(self, dataset: h5py.Dataset, place: Place, why: str) -> None:
        self.dtype: np.dtype[Any] = dataset.dtype.newbyteorder("=")
        self.chunk = dataset.chunks or (1, *dataset.shape[1:])
        self.scratch_bytes = math.prod(self.chunk) * self.dtype.itemsize
        self.how = f"through HDF5 ({why})"
        self._dataset, self._place = dataset, place

    def fetch(self, part: Selection, out: NDArray[Any]) -> None:
        """Write a part into ``out``."""
        room = out if out.flags.c_contiguous else np.empty(out.shape, out.dtype)
        with self._place.reading(*part.frames):
            self._dataset.read_direct(room, (slice(*part.frames), *part.region.slices))
        if room is not out:
            out[...] = room

    def close(self) -> None:
        """Do nothing: the file is the recording's to close."""


class ChunkReader:
    """A dataset in chunks, of which threads read and unpack one after the other.

    A chunk of whole frames that are wanted is unpacked where they are wanted; of others the part that is
    wanted is copied there. The file's descriptor is closed at the latest with the last reference to this.
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
        self.dtype, self.chunk = dtype, index.shape
        self.scratch_bytes = threads * math.prod(self.chunk) * dtype.itemsize
        by = "one thread" if threads == 1 else f"{threads} threads"
        self.how = f"chunks {'decoded' if codecs else 'read'} by {by}"
        self._frames, self._file, self._place = shape[0], file, place
        self._index, self._codecs, self._threads = index, codecs, threads
        self._close_file = weakref.finalize(self, os.close, file)
        self._pool: ThreadPoolExecutor | None = None
        self._process = os.getpid()
        self._scratch: deque[_Scratch] = deque()

    def fetch(self, part: Selection, out: NDArray[Any]) -> None:
        """Write a part into ``out``; every chunk that it touches is decoded once."""
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(part.spans, self.chunk, strict=True)]
        work = deque(itertools.product(*ranges))
        helpers = min(self._threads, len(work)) - 1
        if helpers and (self._pool is None or self._process != os.getpid()):  # threads stay behind in a fork
            self._process = os.getpid()
            self._pool = ThreadPoolExecutor(self._threads - 1, "chunks")
        running: list[Future[None]] = []
        try:
            while self._pool is not None and len(running) < helpers:
                running.append(self._pool.submit(self._work, work, part, out))
            self._work(work, part, out)
        finally:
            work.clear()  # after an error, too: when this returns, nobody writes to out any more
            for helper in running:
                helper.exception()
        for helper in running:
            helper.result()

    def close(self) -> None:
        """Close the file."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        self._file = -1  # the number may be another file's by then
        self._close_file()

    def _work(self, work: deque[tuple[int, ...]], part: Selection, out: NDArray[Any]) -> None:
        """Take chunk after chunk, until there is none left."""
        scratch = _popped(self._scratch) or _Scratch()
        try:
            while (position := _popped(work)) is not None:
                self._fetch_chunk(position, part, out, scratch)
        except BaseException:
            work.clear()  # so that the others stop, too
            raise
        finally:
            self._scratch.append(scratch)

    def _fetch_chunk(
        self, position: tuple[int, ...], part: Selection, out: NDArray[Any], scratch: _Scratch
    ) -> None:
        frames, rows, columns = ((p * c, (p + 1) * c) for p, c in zip(position, self.chunk, strict=True))
        chunk = Selection(frames, Region(rows, columns))
        wanted = chunk.overlap(part)
        target = out[wanted.within(part)]
        with self._place.reading(frames[0], min(frames[1], self._frames)):
            if target.shape == self.chunk and target.flags.c_contiguous:
                self._decode(position, target.reshape(-1).view(np.uint8), scratch)
            else:
                unpacked = scratch.unpacked(math.prod(self.chunk) * self.dtype.itemsize)
                self._decode(position, unpacked, scratch)
                target[...] = unpacked.view(self.dtype).reshape(self.chunk)[wanted.within(chunk)]

    def _decode(self, position: tuple[int, ...], out: Bytes, scratch: _Scratch) -> None:
        offset, size = int(self._index.offsets[position]), int(self._index.sizes[position])
        if not self._codecs:
            _read(self._file, offset, out)
            return
        packed = scratch.packed(size)
        _read(self._file, offset, packed)
        decode(self._codecs, int(self._index.filter_masks[position]), packed, out)


class _Scratch:
    """Memory that one thread uses again and again."""

    def __init__(self) -> None:
        self._packed = self._unpacked = np.empty(0, np.uint8)

    def packed(self, size: int) -> Bytes:
        if self._packed.size < size:
            self._packed = np.empty(size + size // 8, np.uint8)
        return self._packed[:size]

    def unpacked(self, size: int) -> Bytes:
        if self._unpacked.size != size:
            self._unpacked = np.empty(size, np.uint8)
        return self._unpacked


def _popped(items: deque[Any]) -> Any:
    """Take the first item, None if there is none: several threads do so at once."""
    try:
        return items.popleft()
    except IndexError:
        return None


def _read(file: int, offset: int, out: Bytes) -> None:
    done = 0
    while done < out.size:
        count = os.preadv(file, [out[done:].data], offset + done)
        if not count:
            raise OSError("truncated: the file became shorter")
        done += count


class ChunkedStack:
    """A part of a dataset in chunks, read in order, so that each chunk is unpacked once.

    Chunks that hold more frames than are read at a time are unpacked into memory, and their frames are lent
    from there. If these take more bytes than the limit, the whole part is unpacked into a temporary file
    instead, and that is mapped.
    """

    def __init__(
        self, chunks: ChunkReader | Hdf5Reader, place: Place, part: Selection, memory_limit: int
    ) -> None:
        self.shape, self.dtype = part.shape, chunks.dtype
        self._chunks, self._place, self._part, self._limit = chunks, place, part, memory_limit
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
        """End a read where chunks end, so that none is unpacked twice."""
        first, length = self._part.frames[0], self._chunks.chunk[0]
        if (first + start) % length and start:
            return min(stop, self._chunk_span(start)[1] - first)
        aligned = stop if stop == self.shape[0] else (first + stop) // length * length - first
        return aligned if start < aligned else stop

    def lend(self, start: int, stop: int) -> None:
        """Lend nothing that was not read."""

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames in ``out``, or lend those that are kept."""
        first, last = self._part.frames[0] + start, self._part.frames[0] + stop
        span = self._chunk_span(start)
        if self._disk is None and span[0] == first and self._chunk_span(stop - 1)[1] == last:
            self._chunks.fetch(Selection((first, last), self._part.region), out[: stop - start])
            return out[: stop - start]
        if self._disk is None and self._held != span:
            self._unpack(*span)
        if self._disk is not None:
            return self._disk.read(start, stop, out)
        assert self._frames is not None  # what was not unpacked to disk is kept
        return self._frames[first - span[0] : last - span[0]]

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""
        self._chunks.close()
        if self._disk is not None:
            self._disk.close()
        self._frames = self._memory = self._held = None

    def _chunk_span(self, frame: int) -> tuple[int, int]:
        """Return which frames of the dataset share their chunks with one of the part."""
        first, end = self._part.frames
        length = self._chunks.chunk[0]
        start = (first + frame) // length * length
        return max(start, first), min(start + length, end)

    def _unpack(self, start: int, stop: int) -> None:
        """Unpack all chunks of some frames into memory; if there is no room, those of all frames to disk."""
        pixels = math.prod(self._part.region.shape)
        size = min(self._chunks.chunk[0], self.shape[0]) * pixels * self.dtype.itemsize + PADDING
        # While the next are unpacked, someone may still work on those before.
        alive = 1 if stop - start == self.shape[0] else 2
        if alive * size + self._chunks.scratch_bytes > self._limit:
            self._disk = self._unpack_to_disk()
            return
        if self._held is None:
            self._log_unpacking("memory")
        before = None if self._frames is None else weakref.ref(self._frames)
        self._frames = self._held = None
        if self._memory is None or (before is not None and before() is not None):
            self._memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        shape = (stop - start, *self._part.region.shape)
        frames: NDArray[Any] = np.ndarray(shape, self.dtype, self._memory)
        self._chunks.fetch(Selection((start, stop), self._part.region), frames)
        self._frames, self._held = frames, (start, stop)

    def _unpack_to_disk(self) -> MappedStack:
        """Unpack everything into a file without a name, and map it."""
        size = math.prod(self.shape) * self.dtype.itemsize
        self._log_unpacking(f"disk: {size / 1e9:.3g} GB in {tempfile.gettempdir()}")
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with as_input_error(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, size + PADDING)
            pages = mmap.mmap(file.fileno(), size)
            frames: NDArray[Any] = np.ndarray(self.shape, self.dtype, pages)
            for part in self._pieces():
                self._chunks.fetch(part, frames[part.within(self._part)])
                pages.madvise(mmap.MADV_DONTNEED)  # they stay in the file, and leave this process
            whole = Selection((0, self.shape[0]), Region.whole(self.shape[1:]))
            return MappedStack(
                file.fileno(), self._place, 0, self.shape, self.dtype, whole, "unpacked to disk"
            )

    def _pieces(self) -> Iterator[Selection]:
        """Cut the part along the borders of chunks, into pieces as large as there is memory for."""
        _, height, width = self._chunks.chunk
        size = math.prod(self._chunks.chunk) * self.dtype.itemsize
        across = width * max(1, self._limit // (2 * size))
        region, frame = self._part.region, 0
        while frame < self.shape[0]:
            frames = self._chunk_span(frame)
            for rows in _cut_at_multiples(region.rows, height):
                for columns in _cut_at_multiples(region.columns, across):
                    yield Selection(frames, Region(rows, columns))
            frame = frames[1] - self._part.frames[0]

    def _log_unpacking(self, where: str) -> None:
        place, frames = self._place, self._chunks.chunk[0]
        said = "%s: chunks of %s hold %d frames each, more than are read at a time: unpacked to %s"
        _log.info(said, place.path, place.dataset, frames, where)


def _cut_at_multiples(span: tuple[int, int], length: int) -> Iterator[tuple[int, int]]:
    start, end = span
    while start < end:
        stop = min(end, (start // length + 1) * length)
        yield start, stop
        start = stop
