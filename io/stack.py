"""Frames of a dataset, all or some of them, or a region of each, read by the fastest method.

Contiguous frames are mapped into memory; chunks are decoded by threads; others are read by HDF5.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import math
import mmap
import os
import signal
import sys
import tempfile
import weakref
from contextlib import suppress
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.chunks import Chunks, chunk_index, find_codecs
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.selection import Place, Region, Span
from mirrorskin.io.types import Closing, InputError
from mirrorskin.io.zarr import ZarrFrames

_log = logging.getLogger("mirrorskin.io")

_LIMIT = 256_000_000  # bytes of unpacked frames, by default
_MAPPED = 4  # factor for mapped frames, which are in the system's cache
_PADDING = 64  # bytes required after the last sample, because kernels load their last word as a whole


class MappedFrames:
    """Contiguous frames in an open file, starting at an offset; whole frames are returned without a copy.

    OSError: the file is too short, or cannot be mapped. The descriptor may be closed afterwards. At most
    ``span`` bytes are returned at once, and at most a quarter of the machine's memory, because a kernel that
    reads them several times must find them in memory.
    """

    length: int
    how: str
    scratch_bytes: int

    length, how, scratch_bytes = 1, "mapped", 0

    def __init__(
        self,
        file: int,
        place: Place,
        offset: int,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        span: int,
    ) -> None:
        self._place, self._frame = place, math.prod(shape[1:]) * dtype.itemsize
        self._end = offset + shape[0] * self._frame
        size = os.fstat(file).st_size
        self._check_length(size)
        base = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        if sys.platform == "linux":
            _survive_lost_pages()
        length = min(size, self._end + _PADDING) - base
        pages = mmap.mmap(file, length, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ, offset=base)
        _maps[pages] = np.frombuffer(pages, np.uint8).ctypes.data, base
        self._map: mmap.mmap | None = pages
        self._offset = offset - base
        self._frames = np.ndarray(shape, dtype, self._map, self._offset)
        # Whole pages are mapped, up to the end of the last one.
        reach = -(-length // mmap.PAGESIZE) * mmap.PAGESIZE
        self._lendable = (reach - _PADDING - self._offset) // self._frame if self._frames.flags.aligned else 0
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        self._longest = max(1, min(span, memory // 4) // self._frame)
        self._used = self._dropped = 0

    def lend(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return whole frames without a copy, perhaps fewer than requested; None if there are none."""
        stop = min(stop, start + self._longest, self._lendable)
        if stop <= start:
            return None
        self._turn_to(start, stop)
        return self._frames[start:stop]

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Copy a part into ``out``."""
        self._turn_to(*frames)
        out[...] = self._frames[slice(*frames), *region.slices]

    def close(self) -> None:
        """Release the pages; frames that were returned keep theirs."""
        self._frames = self._frames[:0].copy()  # a view would keep the mapping
        self._map = None

    def _turn_to(self, start: int, stop: int) -> None:
        """Check that frames exist, and release those before the preceding block."""
        with self._place.reading(start, stop):
            if self._map is None:
                raise ValueError("(it is closed)")
            self._check_length(self._map.size())
            # Pages that were read count as memory of this process.
            behind = self._offset + min(self._used, start) * self._frame
            behind -= behind % mmap.PAGESIZE
            if behind > self._dropped:
                self._map.madvise(mmap.MADV_DONTNEED, self._dropped, behind - self._dropped)
            self._dropped, self._used = behind, start

    def _check_length(self, size: int) -> None:
        if size < self._end:
            raise OSError("truncated: the file became shorter")


class Hdf5Frames(Closing):
    """A dataset that HDF5 reads in one thread; ``why`` is the reason that faster methods do not apply."""

    scratch_bytes: int

    def __init__(self, dataset: h5py.Dataset, place: Place, why: str) -> None:
        chunk = dataset.chunks or (1, *dataset.shape[1:])
        self.length, self.scratch_bytes = chunk[0], math.prod(chunk) * dataset.dtype.itemsize
        self.how: str = f"through HDF5 ({why})"
        self._dataset, self._place = dataset, place

    def lend(self, start: int, stop: int) -> None:
        """Return None: frames have to be read."""

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Write a part into ``out``, a C-contiguous array."""
        with self._place.reading(*frames):
            self._dataset.read_direct(out, (slice(*frames), *region.slices))


class Stack:
    """Some frames (``numbers``, in order) of the first ``count`` of a dataset, and the ``region`` of each.

    Frames that are returned without a copy are never overwritten while they are referred to. A chunk is
    unpacked once: if chunks contain more frames than are read at a time, these are kept in memory, up to
    ``limit`` bytes, or on disk.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    def __init__(
        self,
        dataset: h5py.Dataset,
        path: str,
        count: int,
        numbers: NDArray[np.intp],
        region: Region,
        memory_limit: int | None,
        threads: int | None,
        frames: ZarrFrames | None = None,
    ) -> None:
        self.shape, self.dtype = (len(numbers), *region.shape), dataset.dtype.newbyteorder("=")
        self._place, self._limit = Place(path, str(dataset.name)), memory_limit or _LIMIT
        self._numbers, self._region = numbers, region
        self._first, self._end = int(numbers[0]), int(numbers[-1]) + 1
        self._whole = region.shape == dataset.shape[1:]
        with as_input_error(f"{path}: {dataset.name}"):
            self._frames = frames or _open(dataset, self._place, count, self._limit, threads)
        self._kept: Span = (0, 0)
        self._unpacked: NDArray[Any] | None = None
        self._memory: mmap.mmap | None = None
        self._how = ""

    @property
    def how(self) -> str:
        """How frames are read, as text."""
        return self._how or self._frames.how

    def lend(self, start: int, most: int) -> NDArray[Any] | None:
        """Return frames without a copy, at most ``most`` or fewer; None where they have to be read."""
        return self._frames.lend(*self._run(start, most)) if self._whole else None

    def read(self, start: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames in ``out`` or without a copy, at most as many as it holds."""
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
        """Close the file; returned frames remain valid."""
        self._frames.close()
        self._unpacked, self._memory, self._kept = None, None, (0, 0)

    def _run(self, start: int, most: int) -> Span:
        """Return the consecutive frames of the dataset from a selected one on: first and end."""
        numbers = self._numbers[start : start + most]
        gaps = np.flatnonzero(np.diff(numbers) != 1)
        return int(numbers[0]), int(numbers[gaps[0] if gaps.size else -1]) + 1

    def _chunk_span(self, frame: int) -> Span:
        """Return the frames that share chunks with a frame."""
        start = frame // self._frames.length * self._frames.length
        return max(start, self._first), min(start + self._frames.length, self._end)

    def _unpack(self, start: int, stop: int) -> None:
        """Unpack all chunks of some frames into memory; if they do not fit, those of all frames to disk."""
        frame, count = math.prod(self.shape[1:]) * self.dtype.itemsize, self._end - self._first
        size = min(self._frames.length, count) * frame + _PADDING
        # While the next frames are unpacked, the preceding ones may still be in use.
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
        """Return the memory of a mapped file without a name."""
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with as_input_error(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, size + _PADDING)
            return mmap.mmap(file.fileno(), size + _PADDING)


def _open(
    dataset: h5py.Dataset, place: Place, count: int, limit: int, threads: int | None
) -> MappedFrames | Chunks | Hdf5Frames:
    """Open the frames: mapped if they are contiguous, else by chunks, else through HDF5."""
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
                # The number of threads is limited so that a quarter of the memory suffices for them.
                most = max(1, limit // (4 * math.prod(dataset.chunks) * dtype.itemsize))
                threads = min(threads or len(os.sched_getaffinity(0)), most)
                opened, file = file, -1
                return Chunks(opened, place, count, dtype, index, codecs, threads)
        return MappedFrames(file, place, offset, shape, dtype, _MAPPED * limit)
    finally:
        if file >= 0:
            os.close(file)


def _open_again(opened: h5py.File) -> int:
    """Open again the file that HDF5 has open, unless the name now belongs to another file."""
    # A duplicate of HDF5's descriptor would hold its lock as long as frames are in use.
    file = os.open(opened.filename, os.O_RDONLY | os.O_CLOEXEC)
    if not os.path.samestat(os.fstat(file), os.fstat(opened.id.get_vfd_handle())):
        os.close(file)
        raise InputError(f"{opened.filename} was replaced while it was opened: start again")
    return file


def _why_only_hdf5(dataset: h5py.Dataset) -> str:
    """Return why only HDF5 can read a dataset (storage or data type); an empty text otherwise."""
    if dataset.is_virtual:
        return "virtual"
    if dataset.external:
        return "raw files"
    if dataset.id.get_type() != h5py.h5t.py_create(dataset.dtype.newbyteorder("=")):
        return "byte order" if not dataset.dtype.isnative else "bits"
    return ""


# Accessing a mapped page beyond the end of a file that became shorter raises SIGBUS, which ends the program.
# A kernel's thread may do this between the check of a block and its end. Such pages are replaced by empty
# ones. The check of the next block, or of the source's fingerprint at the end, detects that the file has
# changed.

_maps: weakref.WeakKeyDictionary[mmap.mmap, tuple[int, int]] = weakref.WeakKeyDictionary()
"""Mapped pages of files: their address, and their offset in the file."""

_FIXED, _WITH_ADDRESS = 0x10, 4  # MAP_FIXED, SA_SIGINFO
_FAULT = 16  # offset of the accessed address in a siginfo_t, in bytes
_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t)


class _Action(ctypes.Structure):
    """struct sigaction of Linux C libraries."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_char * 128),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


@functools.cache
def _survive_lost_pages() -> Any:
    """Replace lost pages when one is accessed; any other SIGBUS is passed to the previous handler."""
    libc, before = ctypes.CDLL(None), _Action()
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    libc.mmap.restype = ctypes.c_void_p

    def replace(number: int, info: int, _: int) -> None:
        touched = ctypes.c_size_t.from_address(info + _FAULT).value
        with suppress(OSError):  # the size of the file cannot be read
            for pages, (address, base) in list(_maps.items()):
                kept = max(0, -(-(pages.size() - base) // mmap.PAGESIZE)) * mmap.PAGESIZE
                if address + kept <= touched < address + -(-len(pages) // mmap.PAGESIZE) * mmap.PAGESIZE:
                    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _FIXED
                    libc.mmap(address + kept, len(pages) - kept, mmap.PROT_READ, flags, -1, 0)
                    return
        libc.sigaction(number, ctypes.byref(before), None)

    handler = _HANDLER(replace)
    action = _Action(ctypes.cast(handler, ctypes.c_void_p).value, flags=_WITH_ADDRESS)
    libc.sigaction(signal.SIGBUS, ctypes.byref(action), ctypes.byref(before))
    return handler  # must not be garbage-collected, since the system calls it
