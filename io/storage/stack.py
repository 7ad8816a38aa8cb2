"""Frames of a dataset, all or some of them, or a region of each, read by the fastest method.

Contiguous frames are read directly; chunks are decoded by threads; others are read by HDF5. No file is mapped
into memory: a program that shortened it would end this process.
"""

from __future__ import annotations

import logging
import math
import mmap
import os
import tempfile
import threading
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.checksums import Verifier
from mirrorskin.io.base.samples import DecodedFrames, Decoding, Reader
from mirrorskin.io.base.selection import FrameLabel, Region, Span
from mirrorskin.io.base.system import reserve_space, translate_os_errors
from mirrorskin.io.base.types import Closing, InputError
from mirrorskin.io.model.frames import FrameReader
from mirrorskin.io.storage.chunks import Chunks, find_codecs
from mirrorskin.io.storage.zarr import ZarrFrames
from mirrorskin.processors import usable_cores

_log = logging.getLogger("mirrorskin.io")

_LIMIT = 256_000_000  # bytes of unpacked frames, by default
_MANY = 8_000_000  # bytes of contiguous frames above which several threads read


def _close(file: int) -> None:
    """Close a file that was only read, ignoring errors."""
    with suppress(OSError):
        os.close(file)


class RawFrames(FrameReader):
    """Contiguous frames at an offset of a file, which is closed when the object is deleted at the latest."""

    how = "directly"
    random_access = True

    def __init__(self, file: int, offset: int, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> None:
        self.shape, self.dtype, self._file, self._offset = shape, dtype, file, offset
        self._close = weakref.finalize(self, _close, file)
        self._frame = math.prod(shape[1:]) * dtype.itemsize

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write frames, some rows and columns of each, into ``out``, a C-contiguous array."""
        (first, _), (top, bottom), columns = spans
        start = self._offset + first * self._frame
        if out.shape[1:] == self.shape[1:]:
            self._read_whole(start, out)
        else:
            rows = np.empty((bottom - top, self.shape[2]), out.dtype)
            for frame in out:
                self._read(start + top * rows[:1].nbytes, rows)
                frame[...] = rows[:, slice(*columns)]
                start += self._frame
        if not self.dtype.isnative:
            out.byteswap(inplace=True)

    def close(self) -> None:
        """Close the file."""
        self._close()

    def _read_whole(self, start: int, out: NDArray[Any]) -> None:
        """Read whole frames, several parts at once if there are many bytes: a thread copies a few GB/s."""
        parts = np.array_split(out, usable_cores() if out.nbytes > _MANY else 1)
        places = start + np.cumsum([0, *(part.nbytes for part in parts[:-1])])
        if len(parts) == 1:
            self._read(start, out)
            return
        with ThreadPoolExecutor(len(parts), "mirrorskin-read") as pool:
            list(pool.map(self._read, places.tolist(), parts))

    def _read(self, place: int, out: NDArray[Any]) -> None:
        if not self._close.alive:
            raise ValueError("(it is closed)")  # the number may belong to another file by now
        rest = out.reshape(-1).view(np.uint8).data
        while rest:
            count = os.preadv(self._file, [rest], place)
            if not count:
                raise OSError("truncated: the file became shorter")
            rest, place = rest[count:], place + count


class Hdf5Frames(Closing):
    """A dataset that HDF5 reads in one thread; ``why`` is the reason that faster methods do not apply."""

    scratch_bytes: int

    def __init__(self, dataset: h5py.Dataset, why: str, axis: int = 0) -> None:
        whole = list(dataset.shape)
        whole[axis if dataset.ndim > 3 else 0] = 1  # one frame
        self.chunk: tuple[int, ...] = dataset.chunks or tuple(whole)
        self.length = self.chunk[0]
        self.scratch_bytes = math.prod(self.chunk) * dataset.dtype.itemsize
        self.how: str = f"through HDF5 ({why})"
        self._dataset = dataset

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write a part into ``out``, a C-contiguous array."""
        self._dataset.read_direct(out, tuple(slice(*span) for span in spans))


class Stack:
    """Some frames (``numbers``, in order) of the first ``count`` of a dataset, and the ``region`` of each.

    ``decoding`` converts stored values to frames. Whole frames are compared with ``checksums``, if given.

    Each chunk is unpacked once: chunks that contain more frames than one read are kept in memory, up to
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
        decoding: Decoding,
        frames: ZarrFrames | None = None,
        checksums: NDArray[np.uint32] | None = None,
    ) -> None:
        self.shape, self.dtype = (len(numbers), *region.shape), decoding.dtype
        self._place, self._limit = FrameLabel(path, str(dataset.name)), memory_limit or _LIMIT
        self._numbers, self._region = numbers, region
        self._first, self._end = int(numbers[0]), int(numbers[-1]) + 1
        with translate_os_errors(f"{path}: {dataset.name}"):
            first = count if decoding.order[0] == 0 else int(dataset.shape[0])
            axis = decoding.order[0]
            reader: Reader = frames or _open(dataset, self._place, first, self._limit, threads, axis)
            self._frames = reader if decoding.plain else DecodedFrames(reader, decoding, dataset.shape)
            self._file = None if frames else dataset.file
            self._size = 0 if frames else os.fstat(dataset.file.id.get_vfd_handle()).st_size
        self.verifier = None if checksums is None else Verifier(checksums, numbers, path)
        self._kept: Span = (0, 0)
        self._reading = threading.Lock()  # a single frame may be wanted while another thread reads
        self._unpacked: NDArray[Any] | None = None
        self._how = ""

    @property
    def how(self) -> str:
        """Return how frames are read, as text."""
        return self._how or self._frames.how

    @property
    def random_access(self) -> bool:
        """Whether a frame is read without others."""
        return self._frames.how.startswith(RawFrames.how)

    def read(self, start: int, out: NDArray[Any]) -> NDArray[Any]:
        """Read frames into ``out``, at most as many as it holds, and return them."""
        first, stop = self._run(start, len(out))
        with self._reading:
            if not self._kept[0] <= first < self._kept[1]:
                span = self._chunk_span(first)
                if span[0] == first and span[1] <= stop:
                    stop = stop if stop == self._end else stop // self._frames.length * self._frames.length
                    self._fetch((first, stop), out[: stop - first])
                    return out[: stop - first]
                self._unpack(*span)
            assert self._unpacked is not None
            stop = min(stop, self._kept[1])
            out[: stop - first] = self._unpacked[first - self._kept[0] : stop - self._kept[0]]
        return out[: stop - first]

    def close(self) -> None:
        """Close the file."""
        self._frames.close()
        self._unpacked, self._kept = None, (0, 0)

    def _fetch(self, frames: Span, out: NDArray[Any]) -> None:
        with translate_os_errors(self._place.name(*frames)):
            # HDF5 returns zeros beyond the end of a truncated file.
            if self._file is not None and os.fstat(self._file.id.get_vfd_handle()).st_size < self._size:
                raise OSError("truncated: the file became shorter")
            spans = frames, self._region.rows, self._region.columns
            if self.verifier is None:
                self._frames.fetch(spans, out)
            else:
                self.verifier.fetch(self._frames, spans, out)

    def _run(self, start: int, limit: int) -> Span:
        """Return the consecutive frames of the dataset that begin with a selected one: first and end."""
        numbers = self._numbers[start : start + limit]
        gaps = np.flatnonzero(np.diff(numbers) != 1)
        return int(numbers[0]), int(numbers[gaps[0] if gaps.size else -1]) + 1

    def _chunk_span(self, frame: int) -> Span:
        """Return the frames that share chunks with a frame."""
        start = frame // self._frames.length * self._frames.length
        return max(start, self._first), min(start + self._frames.length, self._end)

    def _unpack(self, start: int, stop: int) -> None:
        """Unpack the chunks of some frames into memory, or if they do not fit, all chunks to disk."""
        frame, count = math.prod(self.shape[1:]) * self.dtype.itemsize, self._end - self._first
        length = min(self._frames.length, count)
        fits = length * frame + self._frames.scratch_bytes <= self._limit
        if not fits:
            start, stop, length = self._first, self._end, count
        if not self._how:
            where = f"to disk: {count * frame / 1e9:.3g} GB in {tempfile.gettempdir()}"
            _log.info(
                "%s: chunks of %s hold %d frames each, more than are read at a time: unpacked %s",
                self._place.path,
                self._place.dataset,
                self._frames.length,
                "into memory" if fits else where,
            )
            memory = None if fits else self._disk_memory(count * frame)
            self._unpacked = np.ndarray((length, *self.shape[1:]), self.dtype, memory)
            self._how = "unpacked into memory" if fits else "unpacked to disk"
        assert self._unpacked is not None
        self._kept, last = (0, 0), start
        while last < stop:
            span = self._chunk_span(last)
            self._fetch(span, self._unpacked[span[0] - start : span[1] - start])
            last = span[1]
        self._kept = start, stop

    def _disk_memory(self, size: int) -> mmap.mmap:
        """Return the memory of a mapped unnamed file, which no other program can truncate."""
        what = f"{self._place.path}: {self._place.dataset} is unpacked to disk, {size / 1e9:.3g} GB"
        remedy = "name a folder with more room in TMPDIR, raise --memory, or repack it in chunks of one frame"
        with translate_os_errors(what, remedy), tempfile.TemporaryFile(buffering=0) as file:
            reserve_space(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)


def _open(
    dataset: h5py.Dataset, place: FrameLabel, count: int, limit: int, threads: int | None, axis: int
) -> RawFrames | Chunks | Hdf5Frames:
    """Open the frames: directly if they are contiguous, otherwise by chunks, otherwise through HDF5."""
    if why := _why_only_hdf5(dataset):
        return Hdf5Frames(dataset, why, axis)
    if dataset.chunks:
        codecs = find_codecs(dataset.id)
        if isinstance(codecs, str):
            return Hdf5Frames(dataset, codecs, axis)
        # The number of threads is limited so that a quarter of the memory suffices for them.
        count = max(1, limit // (4 * math.prod(dataset.chunks) * dataset.dtype.itemsize))
        return Chunks(dataset.id, codecs, place.name, min(threads or usable_cores(), count))
    offset = dataset.id.get_offset()
    if offset is None:
        return Hdf5Frames(dataset, "in its header", axis)
    if dataset.ndim > 3:
        return Hdf5Frames(dataset, "several axes", axis)
    # A duplicate of HDF5's descriptor would keep the lock as long as it is open.
    file = os.open(dataset.file.filename, os.O_RDONLY | os.O_CLOEXEC)
    frames = RawFrames(file, offset, (count, *dataset.shape[1:]), dataset.dtype)
    if not os.path.samestat(os.fstat(file), os.fstat(dataset.file.id.get_vfd_handle())):
        raise InputError(f"{dataset.file.filename} was replaced while it was opened: start again")
    return frames


def _why_only_hdf5(dataset: h5py.Dataset) -> str:
    """Return why only HDF5 can read a dataset (storage or data type); an empty text otherwise."""
    if dataset.is_virtual:
        return "virtual"
    if dataset.external:
        return "raw files"
    return "" if dataset.id.get_type() == h5py.h5t.py_create(dataset.dtype) else "bits"
