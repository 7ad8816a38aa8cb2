"""The frames of a dataset, or a part of them, numbered from 0: the best way to fetch them.

A stack has `shape`, `dtype` and `how` (in words); `end(start, stop)` says where a read had better end; and
`read(start, stop, out)` returns frames in ``out`` or in memory of its own, which nobody writes to as long as
someone refers to it. `lend(start, stop)` returns frames where they lie, as many of these as is wise, or None.
"""

from __future__ import annotations

import math
import os
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.chunked_stack import ChunkedStack, ChunkReader, Hdf5Reader, chunk_index
from mirrorskin.io.codecs import find_codecs
from mirrorskin.io.mapped_stack import MappedStack
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.selection import Place, Selection
from mirrorskin.io.types import InputError

_LIMIT = 256_000_000  # bytes of unpacked frames, where nothing else is given
_MAPPED = (
    4  # times as many of a mapped file are lent at once: they are in the system's cache, in no memory of ours
)


def open_stack(
    dataset: h5py.Dataset,
    path: str,
    part: Selection,
    memory_limit: int | None = None,
    threads: int | None = None,
    frames: int | None = None,
) -> MappedStack | ChunkedStack:
    """Open a part of a dataset (T, H, W) whose claims were checked.

    ``path`` is what messages call the file; ``memory_limit`` are bytes of unpacked frames to keep; so many
    ``threads`` unpack chunks, by default one a core; a dataset that still grows has so many ``frames``.
    """
    place, limit = Place(path, str(dataset.name)), memory_limit or _LIMIT
    with as_input_error(f"{path}: {dataset.name}"):
        why = _why_only_hdf5(dataset)
        offset = None if why or dataset.chunks else dataset.id.get_offset()
        if not why and not dataset.chunks and offset is None:
            why = "in its header"
        if why:
            return ChunkedStack(Hdf5Reader(dataset, place, why), place, part, limit)
        shape = (frames or dataset.shape[0], *dataset.shape[1:])
        file = _open_again(dataset.file)
        try:
            if offset is None:
                chunks = _open_chunks(dataset, shape, file, place, _threads(dataset, threads, limit))
                if not isinstance(chunks, int):
                    file = -1 if isinstance(chunks, ChunkReader) else file
                    return ChunkedStack(chunks, place, part, limit)
                offset = chunks
            return MappedStack(file, place, offset, shape, dataset.dtype, part, span=_MAPPED * limit)
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


def _threads(dataset: h5py.Dataset, threads: int | None, limit: int) -> int:
    """Return how many threads unpack chunks: so many that a quarter of the memory is enough for them."""
    size: int = math.prod(dataset.chunks) * dataset.dtype.itemsize
    return min(threads or len(os.sched_getaffinity(0)), max(1, limit // (4 * size)))


def _why_only_hdf5(dataset: h5py.Dataset) -> str:
    """Return what only HDF5 can read: elsewhere, or in another form than in memory; nothing if we can."""
    if dataset.is_virtual:
        return "virtual"
    if dataset.external:
        return "raw files"
    if dataset.id.get_type() != h5py.h5t.py_create(dataset.dtype.newbyteorder("=")):
        return "byte order" if not dataset.dtype.isnative else "bits"
    return ""


def _open_chunks(
    dataset: h5py.Dataset, shape: tuple[int, int, int], file: int, place: Place, threads: int
) -> ChunkReader | Hdf5Reader | int:
    """Return what fetches chunks; of raw frames that lie in one piece, where that begins."""
    codecs = find_codecs(dataset)
    if isinstance(codecs, str):
        return Hdf5Reader(dataset, place, codecs)
    index = chunk_index(dataset, shape, os.fstat(file).st_size)
    if isinstance(index, str):
        return Hdf5Reader(dataset, place, index)
    if not codecs:
        index = index.frame_by_frame(dataset.dtype.itemsize)
        start = index.contiguous_offset(shape)
        if start is not None:
            return start
    return ChunkReader(file, place, shape, dataset.dtype, index, codecs, threads)


class FrameSubset:
    """Some frames of a stack, in order, as if there were no others; those between are not read."""

    def __init__(self, stack: MappedStack | ChunkedStack, frames: NDArray[np.intp]) -> None:
        self.shape, self.dtype = (len(frames), *stack.shape[1:]), stack.dtype
        self._stack = stack
        self._frames: list[int] = frames.tolist()
        # Frames that follow each other in the stack are a run, and are read together.
        breaks = np.flatnonzero(np.diff(frames) != 1) + 1
        ends = np.append(breaks, len(frames))
        self._ends: list[int] = np.repeat(ends, np.diff(ends, prepend=0)).tolist()

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""
        return self._stack.how

    def end(self, start: int, stop: int) -> int:
        """Return where a read that begins at ``start`` had better end, at the latest with its run."""
        first = self._frames[start]
        return start + self._stack.end(first, first + min(stop, self._ends[start]) - start) - first

    def lend(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return frames of one run where they lie, or None."""
        first = self._frames[start]
        return self._stack.lend(first, first + min(stop, self._ends[start]) - start)

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames of one run."""
        first = self._frames[start]
        return self._stack.read(first, first + stop - start, out)

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""
        self._stack.close()


Stack = MappedStack | ChunkedStack | FrameSubset
