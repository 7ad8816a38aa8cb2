"""The best way to fetch the frames of a dataset."""

from __future__ import annotations

import math
import os

import h5py

from mirrorskin.io.plain import plainly
from mirrorskin.io.stacks.codecs import find_codecs
from mirrorskin.io.stacks.index import chunk_index
from mirrorskin.io.stacks.mapped import Mapped
from mirrorskin.io.stacks.packed import Packed
from mirrorskin.io.stacks.stack import Chunks, Cut, Place, Stack
from mirrorskin.io.stacks.through import Through
from mirrorskin.io.stacks.unpacking import Ordered
from mirrorskin.io.types import InputError

_LIMIT = 256_000_000  # bytes of unpacked frames, where nothing else is said


def open_stack(
    dataset: h5py.Dataset,
    path: str,
    cut: Cut,
    memory_limit: int | None = None,
    threads: int | None = None,
    frames: int | None = None,
) -> Stack:
    """Open the frames of a dataset.

    Parameters
    ----------
    dataset : h5py.Dataset, (T, H, W)
        What it claims was checked.
    path : str
        What to call the file in messages.
    cut : Cut
        What is wanted of it.
    memory_limit : int, optional
        Bytes that unpacked frames may take which are kept for later reads.
    threads : int, optional
        How many unpack chunks; as many as there are cores by default.
    frames : int, optional
        How many of its frames there are, if it is yet to be finished.

    Raises
    ------
    InputError
        The file is damaged, or cannot be opened.
    """
    place, limit = Place(path, str(dataset.name)), memory_limit or _LIMIT
    with plainly(f"{path}: {dataset.name}"):
        why = _only_hdf5(dataset)
        offset = None if why or dataset.chunks else dataset.id.get_offset()
        if not why and not dataset.chunks and offset is None:
            why = "in its header"
        if why:
            return Ordered(Through(dataset, place, why), place, cut, limit)
        shape = (frames or dataset.shape[0], *dataset.shape[1:])
        file = _open_again(dataset.file)
        try:
            if offset is None:
                chunks = _open_chunks(dataset, shape, file, place, _threads(dataset, threads, limit))
                if not isinstance(chunks, int):
                    file = -1 if isinstance(chunks, Packed) else file
                    return Ordered(chunks, place, cut, limit)
                offset = chunks
            return Mapped(file, place, offset, shape, dataset.dtype, cut)
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
    """Return how many threads unpack chunks: as asked for or as cores, if a quarter of the room is enough."""
    size: int = math.prod(dataset.chunks) * dataset.dtype.itemsize
    return min(threads or len(os.sched_getaffinity(0)), max(1, limit // (4 * size)))


def _only_hdf5(dataset: h5py.Dataset) -> str:
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
) -> Chunks | int:
    """Return what fetches chunks; of raw frames that lie in one piece, where that begins."""
    codecs = find_codecs(dataset)
    if isinstance(codecs, str):
        return Through(dataset, place, codecs)
    index = chunk_index(dataset, shape, os.fstat(file).st_size)
    if isinstance(index, str):
        return Through(dataset, place, index)
    if not codecs:
        index = index.frame_by_frame(dataset.dtype.itemsize)
        start = index.piece(shape)
        if start is not None:
            return start
    return Packed(file, place, shape, dataset.dtype, index, codecs, threads)
