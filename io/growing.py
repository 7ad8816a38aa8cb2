"""A recording in HDF5 that others can read while it grows."""

from __future__ import annotations

import errno
import fcntl
import itertools
import math
import os
from collections.abc import Collection, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import MAKE_ROOM, VERSIONS
from mirrorskin.io.calibration.file import size_of
from mirrorskin.io.calibration.types import Calibration
from mirrorskin.io.layout import CHECKSUM, DROPPED, LIVE, POSITIONS, SERIES, STATE, UNDER_WAY, USED
from mirrorskin.io.recorder import Compression, checksums, new_stack, packing, write_header, write_plot
from mirrorskin.io.types import Block, Closing, Floats, Header, InputError

_STATE_LENGTH = 240  # bytes; their place is made before the first frame
_ROWS = 1 << 14  # of each column, for which there is room at once
_PAGE, _STEP, _SPARE, _MOST_META = 4 << 10, 64 << 20, 2 << 20, 4 << 20  # bytes
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNABLE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


class Column:
    """A dataset with one row a frame; rows are set at any time, and written by ``flush``."""

    def __init__(
        self,
        file: h5py.File,
        name: str,
        unit: str | None,
        default: Any,
        expected: int,
        width: tuple[int, ...] = (),
    ) -> None:
        chunk = (min(max(expected, 64), _ROWS), *width)
        self._default = default
        self._rows: NDArray[Any] = np.full((chunk[0], *width), default)
        # With a first row, its place in the file is found before the first frame.
        blank = np.zeros_like(self._rows[:1])
        self._dataset = file.create_dataset(name, data=blank, chunks=chunk, maxshape=(None, *width))
        if unit is not None:
            self._dataset.attrs["units"] = unit
        self._written = 0  # rows in the file that are up to date

    def set(self, start: int, rows: NDArray[Any]) -> None:
        """Set the rows from some frame on; those of other frames are the default."""
        self._grow(start + len(rows))
        self._rows[start : start + len(rows)] = rows
        self._written = min(self._written, start)

    def correct(self, rows: NDArray[Any]) -> None:
        """Replace the first rows by better ones, where these are finite."""
        self._grow(len(rows))
        self.set(0, np.where(np.isfinite(rows), rows, self._rows[: len(rows)]))

    def flush(self, count: int) -> None:
        """Give HDF5 what is new of the first rows."""
        self._grow(count)
        if self._written < count:
            if count > len(self._dataset):
                self._dataset.resize(count, axis=0)
            self._dataset[self._written : count] = self._rows[self._written : count]
        self._written = max(self._written, count)

    def _grow(self, count: int) -> None:
        if count > len(self._rows):
            more = max(count - len(self._rows), len(self._rows)), *self._rows.shape[1:]
            self._rows = np.concatenate([self._rows, np.full(more, self._default, self._rows.dtype)])


class GrowingRecording(Closing):
    """A recording to which frames are appended; from ``publish`` on others can watch.

    Raw frames follow each other without a gap as long as there are no more of them than expected.
    """

    def __init__(
        self,
        path: Path,
        descriptor: int,
        header: Header,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        compression: Compression,
        calibration: Calibration | None = None,
        series: Collection[str] = (),
    ) -> None:
        self.count = 0
        self._raw = compression == "raw"
        self._frame = math.prod(shape[1:]) * dtype.itemsize
        # Indices of chunks and the like lie in one piece before the frames, not among them.
        meta = min((1 << 16) + 24 * shape[0], _MOST_META)
        self._spare = _SPARE + 2 * meta
        with ExitStack() as opening:
            self._descriptor = os.dup(descriptor)
            opening.callback(os.close, self._descriptor)
            self._reserve = Reserve(path, self._descriptor, min(_STEP, shape[0] * self._frame))
            room = self._spare + 32 * math.prod(shape[1:])  # for the maps of the header, too
            room += 0 if calibration is None else size_of(calibration)
            self._reserve.hold(room)
            self._file = opening.enter_context(_new_hdf5(self._descriptor, meta, self._frame))
            self._reserve.hold(room)  # once more: HDF5 has emptied the file
            write_header(self._file, header, calibration)
            known = {"time", POSITIONS[header.motion], *series}
            self._make(shape, dtype, compression, known)
            write_plot(self._file, header.motion, known)
            self._file.flush()  # all but the frames has its place now
            self._exit = opening.pop_all()

    def append(self, block: Block) -> None:
        """Write frames, and keep what is known of each until the next ``flush``."""
        frames, n = block.frames, len(block.frames)
        self._hold(n * (self._frame + self._frame // 8 + _PAGE))
        self._frames.resize(self.count + n, axis=0)
        for number, frame in enumerate(frames, self.count):
            if self._raw:
                self._frames.id.write_direct_chunk((number, 0, 0), np.ascontiguousarray(frame))
            else:
                self._frames[number] = frame
        for name, columns in self._series.items():
            rows = getattr(block, name)
            for column in columns if rows is not None else ():
                column.set(self.count, rows)
        self._dropped.set(self.count, np.array([block.dropped]))
        self._checksums.set(self.count, checksums(frames))
        self.count += n

    def mark(self, index: int, used: NDArray[np.bool_]) -> None:
        """Say whether frames, from number ``index`` on, were used; unless marked, they were."""
        self._used.set(index, used)

    def flush(self) -> None:
        """Hand everything to the system, so that it can be read and outlives this process."""
        self._hold(0)
        self._flush()

    def publish(self) -> None:
        """Let others read from now on; they can still not write."""
        self.flush()
        self._file.swmr_mode = True
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._descriptor, fcntl.LOCK_SH)

    def finish(self, positions: Mapping[str, Floats], state: str) -> None:
        """Write what is known only now."""
        if self._frames.shape[0] > self.count:  # it failed to write some
            self._frames.resize(self.count, axis=0)
        for name, values in positions.items():
            if name in self._series:
                self._series[name][0].correct(np.asarray(values, np.float64)[: self.count])
        self._flush()
        self._write_state(state)
        self._file.flush()

    def close(self) -> None:
        """Let go of the file, and give back the room that was not needed."""
        if self._file:
            os.ftruncate(self._descriptor, self._file.id.get_filesize())
        self._exit.close()

    def _make(
        self, shape: tuple[int, int, int], dtype: np.dtype[Any], compression: Compression, known: set[str]
    ) -> None:
        """Make what grows: afterwards nothing new can be made."""
        file, (expected, rows, columns) = self._file, shape
        chunks, most = (1, rows, columns), (None, rows, columns)
        storage = {"chunks": chunks, "maxshape": most, **packing(compression)}
        # Without a cache, a chunk is packed when it is written.
        self._frames = new_stack(file, (0, rows, columns), dtype, rdcc_nbytes=0, **storage)
        self._state = file.create_dataset(STATE, (), h5py.string_dtype("utf-8", _STATE_LENGTH))
        self._write_state(UNDER_WAY)
        self._series = {
            name: [
                Column(file, *place, np.nan, expected, (2,) if name == "displacement" else ())
                for place in (SERIES[name], LIVE.get(name))
                if place is not None
            ]
            for name in SERIES
            if name in known
        }
        self._dropped = Column(file, DROPPED, None, np.int32(0), expected)
        self._checksums = Column(file, CHECKSUM, None, np.uint32(0), expected)
        self._used = Column(file, USED, None, np.uint8(1), expected)

    def _flush(self) -> None:
        """Do so; the room that was reserved last is enough for it."""
        self._frames.flush()  # the frames are there before anything says so
        for column in (*itertools.chain(*self._series.values()), self._dropped, self._checksums, self._used):
            column.flush(self.count)
        self._file.flush()

    def _write_state(self, state: str) -> None:
        self._state[()] = state.encode()[:_STATE_LENGTH].decode(errors="ignore")

    def _hold(self, size: int) -> None:
        """See that the disk takes so many bytes of frames, and what belongs to them."""
        self._reserve.hold(self._file.id.get_filesize() + size + self._spare)


def _new_hdf5(descriptor: int, meta: int, frame: int) -> h5py.File:
    """Make an HDF5 file of an open one: blocks of so many bytes for indices, and frames of so many."""
    return h5py.File(
        f"/proc/self/fd/{descriptor}",
        "w",
        libver=VERSIONS,
        locking=False,  # HDF5 lets go of its lock when others may read; ours stays
        meta_block_size=meta,
        alignment_threshold=frame,
        alignment_interval=math.gcd(frame, _PAGE),
    )


class Reserve:
    """The bytes of a file that the disk has promised."""

    def __init__(self, path: Path, descriptor: int, step: int) -> None:
        self._path, self._descriptor, self._step = path, descriptor, step
        self._end, self._believed = 0, False

    def hold(self, end: int) -> None:
        """See that the file can be written up to some byte.

        A disk that cannot promise anything is believed to have room.
        """
        start = min(self._end, os.fstat(self._descriptor).st_size)  # HDF5 may have cut it off
        if self._believed or end <= start:
            return
        for reach in (end + self._step, end):
            try:
                os.posix_fallocate(self._descriptor, start, reach - start)
                self._end = reach
                return
            except OSError as error:
                self._believed = error.errno in _UNABLE
                if self._believed:
                    return
                if error.errno not in _FULL:
                    raise
                why = os.strerror(error.errno)
        raise InputError(f"{self._path}: the disk is full ({why}); {MAKE_ROOM}")
