"""The frames of a dataset, all or some of them, or a part of each: the fastest way to fetch them."""

from __future__ import annotations

import logging
import math
import mmap
import os
import tempfile
import weakref
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.chunks import Chunks, chunk_index
from mirrorskin.io.codecs import find_codecs
from mirrorskin.io.mapped import PADDING, MappedFrames
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.selection import Place, Region, Span
from mirrorskin.io.types import InputError

_log = logging.getLogger("mirrorskin.io")

_LIMIT = 256_000_000  # bytes of unpacked frames, where nothing else is given
_MAPPED = 4  # times as many of a mapped file are lent at once: they are in the system's cache


class Hdf5Frames:
    """A dataset that HDF5 itself reads, in one thread; ``why`` says what keeps us from doing so."""

    def __init__(self, dataset: h5py.Dataset, place: Place, why: str) -> None:
        chunk = dataset.chunks or (1, *dataset.shape[1:])
        self.length, self.scratch_bytes = chunk[0], math.prod(chunk) * dataset.dtype.itemsize
        self.how = f"through HDF5 ({why})"
        self._dataset, self._place = dataset, place

    def lend(self, start: int, stop: int) -> None:
        """Lend nothing that was not read."""

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Write a part into ``out``, which is in C order."""
        with self._place.reading(*frames):
            self._dataset.read_direct(out, (slice(*frames), *region.slices))

    def close(self) -> None:
        """Do nothing: the file is the recording's to close."""


class Stack:
    """Frames of a dataset (T, H, W) whose claims were checked, numbered from 0, read in order.

    Nobody writes to frames that are returned where they lie, as long as someone refers to them. A chunk is
    unpacked once: frames of chunks that hold more of them than are read at a time are kept, in memory or on
    disk.

    Parameters
    ----------
    dataset : h5py.Dataset
    path : str
        What messages call the file.
    count : int
        How many frames the dataset has; it may still grow.
    numbers : ndarray, (n,), int
        Those that are wanted, in order; others are not read.
    region : Region
        What is wanted of each.
    memory_limit : int, optional
        Bytes of unpacked frames to keep.
    threads : int, optional
        How many unpack chunks, by default one a core.
    """

    def __init__(
        self,
        dataset: h5py.Dataset,
        path: str,
        count: int,
        numbers: NDArray[np.intp],
        region: Region,
        memory_limit: int | None = None,
        threads: int | None = None,
    ) -> None:
        self.shape, self.dtype = (len(numbers), *region.shape), dataset.dtype.newbyteorder("=")
        self._place, self._limit = Place(path, str(dataset.name)), memory_limit or _LIMIT
        self._numbers, self._region = numbers, region
        self._first, self._end = int(numbers[0]), int(numbers[-1]) + 1
        self._whole = region.shape == dataset.shape[1:]
        with as_input_error(f"{path}: {dataset.name}"):
            self._frames = _open(dataset, self._place, count, self._limit, threads)
        self._kept: Span = (0, 0)
        self._unpacked: NDArray[Any] | None = None
        self._memory: mmap.mmap | None = None
        self._how = ""

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""
        return self._how or self._frames.how

    def lend(self, start: int, most: int) -> NDArray[Any] | None:
        """Return frames where they lie, at most so many, as is wise; None where they have to be read."""
        return self._frames.lend(*self._run(start, most)) if self._whole else None

    def read(self, start: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames in ``out`` or where they lie, at most as many as it holds."""
        lent = self.lend(start, len(out))
        if lent is not None:
            return lent
        first, stop = self._run(start, len(out))
        if not self._kept[0] <= first < self._kept[1]:
            span = self._chunk_span(first)
            if span[0] == first and span[1] <= stop:
                stop = stop if stop == self._end else stop // self._frames.length * self._frames.length
                self._frames.fetch((first, stop), self._region, out[: stop - first])
                return out[: stop - first]
            self._unpack(*span)
        assert self._unpacked is not None
        return self._unpacked[first - self._kept[0] : min(stop, self._kept[1]) - self._kept[0]]

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""
        self._frames.close()
        self._unpacked, self._memory, self._kept = None, None, (0, 0)

    def _run(self, start: int, most: int) -> Span:
        """Return which frames of the dataset follow each other from a wanted one on: first and end."""
        numbers = self._numbers[start : start + most]
        gaps = np.flatnonzero(np.diff(numbers) != 1)
        return int(numbers[0]), int(numbers[gaps[0] if gaps.size else -1]) + 1

    def _chunk_span(self, frame: int) -> Span:
        """Return which frames share their chunks with one."""
        start = frame // self._frames.length * self._frames.length
        return max(start, self._first), min(start + self._frames.length, self._end)

    def _unpack(self, start: int, stop: int) -> None:
        """Unpack all chunks of some frames into memory; if there is no room, those of all frames to disk."""
        frame, count = math.prod(self.shape[1:]) * self.dtype.itemsize, self._end - self._first
        size = min(self._frames.length, count) * frame + PADDING
        # While the next are unpacked, someone may still work on those before.
        alive = 1 if stop - start == count else 2
        fits = alive * size + self._frames.scratch_bytes <= self._limit
        before = None if self._unpacked is None else weakref.ref(self._unpacked)
        self._unpacked, self._kept = None, (0, 0)
        if not fits:
            start, stop = self._first, self._end
            self._memory = self._disk_memory(count * frame)
        elif self._memory is None or (before is not None and before() is not None):
            self._memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        unpacked: NDArray[Any] = np.ndarray((stop - start, *self.shape[1:]), self.dtype, self._memory)
        if not self._how:
            said = "%s: chunks of %s hold %d frames each, more than are read at a time: unpacked %s"
            where = (
                "into memory" if fits else f"to disk: {count * frame / 1e9:.3g} GB in {tempfile.gettempdir()}"
            )
            _log.info(said, self._place.path, self._place.dataset, self._frames.length, where)
        done = start
        while done < stop:
            span = self._chunk_span(done)
            self._frames.fetch(span, self._region, unpacked[span[0] - start : span[1] - start])
            done = span[1]
        self._unpacked, self._kept = unpacked, (start, stop)
        self._how = "unpacked into memory" if fits else "unpacked to disk"

    def _disk_memory(self, size: int) -> mmap.mmap:
        """Return the memory of a file without a name."""
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with as_input_error(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, size + PADDING)
            return mmap.mmap(file.fileno(), size + PADDING)


def _open(
    dataset: h5py.Dataset, place: Place, count: int, limit: int, threads: int | None
) -> MappedFrames | Chunks | Hdf5Frames:
    """Open the frames: mapped if they lie in one piece, else their chunks; through HDF5 if only that can."""
    offset, codecs = None if dataset.chunks else dataset.id.get_offset(), find_codecs(dataset)
    why = _why_only_hdf5(dataset) or (codecs if isinstance(codecs, str) else "")
    if not why and not dataset.chunks and offset is None:
        why = "in its header"
    if why or isinstance(codecs, str):
        return Hdf5Frames(dataset, place, why)
    shape, dtype, file = (count, *dataset.shape[1:]), dataset.dtype, _open_again(dataset.file)
    try:
        if offset is None:
            index = chunk_index(dataset, shape, os.fstat(file).st_size)
            if isinstance(index, str):
                return Hdf5Frames(dataset, place, index)
            if not codecs:
                offset = index.contiguous_offset(shape)
            if offset is None:
                # So many threads that a quarter of the memory is enough for them.
                most = max(1, limit // (4 * math.prod(dataset.chunks) * dtype.itemsize))
                threads = min(threads or len(os.sched_getaffinity(0)), most)
                opened, file = file, -1
                return Chunks(opened, place, count, dtype, index, codecs, threads)
        return MappedFrames(file, place, offset, shape, dtype, _MAPPED * limit)
    finally:
        if file >= 0:
            os.close(file)


def _open_again(opened: h5py.File) -> int:
    """Open the file that HDF5 has open, if no other took its name."""
    # Not a duplicate of HDF5's own descriptor: that would hold its lock as long as frames are lent.
    file = os.open(opened.filename, os.O_RDONLY | os.O_CLOEXEC)
    if not os.path.samestat(os.fstat(file), os.fstat(opened.id.get_vfd_handle())):
        os.close(file)
        raise InputError(f"{opened.filename} was replaced while it was opened: start again")
    return file


def _why_only_hdf5(dataset: h5py.Dataset) -> str:
    """Return what only HDF5 can read: elsewhere, or in another form than in memory; nothing if we can."""
    if dataset.is_virtual:
        return "virtual"
    if dataset.external:
        return "raw files"
    if dataset.id.get_type() != h5py.h5t.py_create(dataset.dtype.newbyteorder("=")):
        return "byte order" if not dataset.dtype.isnative else "bits"
    return ""
