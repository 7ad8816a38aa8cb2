"""Recordings that can be read while they are written."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import math
import os
import queue
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.checksums import checksums
from mirrorskin.io.base.system import lock, reserve_space, translate_os_errors
from mirrorskin.io.base.types import Block, Closing, Floats, Header, InputError, LiveSource
from mirrorskin.io.files.recorder import (
    Compression,
    TeeSource,
    new_stack,
    packing,
    write_header,
    write_plot,
)
from mirrorskin.io.formats.registry import export_format
from mirrorskin.io.model.calibration import Calibration
from mirrorskin.io.storage.atomic import (
    MAKE_ROOM,
    VERSIONS,
    check_hdf5_name,
    check_output,
    link_new,
    new_part,
    replace_file,
    synchronise,
)
from mirrorskin.io.storage.calibration_file import size_of
from mirrorskin.io.storage.layout import (
    CHECKSUM,
    COMPLETE,
    CUT_SHORT,
    DROPPED,
    LIVE,
    POSITIONS,
    ROW_SHAPES,
    SERIES,
    STATE,
    UNDER_WAY,
    USED,
)

if TYPE_CHECKING:
    from mirrorskin.io.formats.mcap import GrowingMessages

_POLL = 0.5  # seconds between checks whether the main program is still running
_BACKLOG = 256_000_000  # bytes of frames that may wait to be written
_STATE_LENGTH = 240  # bytes, allocated before the first frame
_ROWS = 1 << 14  # rows of a column allocated at once
_PAGE, _STEP, _SPARE, _MOST_META = 4 << 10, 64 << 20, 2 << 20, 4 << 20  # bytes
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNABLE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


class _Mark(NamedTuple):
    """Whether some frames were used."""

    start: int
    used: NDArray[np.bool_]


class _Maps(NamedTuple):
    """Maps computed from the frames up to a time."""

    time: float
    height: NDArray[np.float32] | None
    contact_area: float | None

    @property
    def size(self) -> int:
        """Size in bytes."""
        return 0 if self.height is None else self.height.nbytes


class _End(NamedTuple):
    """Values stored after the last frame."""

    positions: Mapping[str, Floats]
    state: str


class StreamRecorder(TeeSource[LiveSource]):
    """Pass on the frames of a live source immediately, and write them to a recording in another thread.

    The recording appears with the first frame, as ``file``. This is ``path`` if no file has this name. If an
    older file exists and ``overwrite`` is set, the recording has another name next to it
    (``press-partial.h5``), and replaces the older file at the end, if it is complete. From the first frame on
    other programs can read it (HDF5's SWMR). Every ``period`` all data is passed to the operating system, and
    survives if this process is killed. ``/entry/state`` is "complete" only if the source was read to its end;
    otherwise, and after an exception, the frames so far are kept, and it contains "cut short" and the reason.
    At the end the source is closed first, so that hardware stops. Then its corrected positions are stored as
    the positions, in addition to those that arrived with the frames.

    Parameters
    ----------
    source : LiveSource
        Frames that do not stay valid are copied.
    path : str or Path
        HDF5, or for ROS 2 a file ``.mcap`` (`GrowingMessages`), which also stores maps.
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
        Frames are stored in one chunk each; not for MCAP.
    period : float, optional
        Interval in seconds.
    calibration : Calibration, optional
        Calibration to copy into the recording; it does not change positions and references.
    overwrite : bool, optional
        Whether an existing file of that name is replaced; by default it is refused.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        As for the source; recorded frames cannot be read again.
    path, file : Path
        The requested name, and the actual name of the recording, once the first frame is written.
    state : str
        "under way", "complete", or "cut short: " and the reason.
    count, written : int
        Number of frames read, and number of frames in the file.

    Examples
    --------
    >>> with StreamRecorder(rig, "press.h5") as recorder:  # doctest: +SKIP
    ...     while (block := recorder.read()) is not None:
    ...         print(block.index)
    """

    count: int
    written: int

    def __init__(
        self,
        source: LiveSource,
        path: str | Path,
        compression: Compression = "raw",
        period: float = 0.5,
        calibration: Calibration | None = None,
        overwrite: bool = False,
    ) -> None:
        super().__init__(source, path, compression, calibration, overwrite)
        self.file: Path = self.path
        self.state: str = UNDER_WAY
        self._older: _Identity | None = None  # identity of the file that has the name at the start
        self.count = self.written = 0
        self._period = period
        form = export_format(self.path.suffix.lower())
        self._messages: type[GrowingMessages] | None = None  # what writes files of another program
        if form is not None and form.recorder:
            self._messages = form.load(form.recorder)
            self._messages.check_installed()
            if calibration is not None:
                raise InputError(
                    f"{path}: an {form.name} file cannot contain a calibration; record to a file .h5"
                )
        if self._messages is None:
            check_hdf5_name(self.path)
        self._queue: queue.SimpleQueue[Block | _Mark | _Maps | _End] = queue.SimpleQueue()
        self._backlog, self._lock = 0, threading.Lock()
        self._error: BaseException | None = None
        self._reached_end = False  # the source has no more frames
        self._writer = threading.Thread(target=self._write, name="recorder")

    @property
    def header(self) -> Header:
        """Properties of all frames, read from the source with the first frame."""
        return self.source.header

    @property
    def shape(self) -> tuple[int, int, int]:
        """Expected number of frames, rows and columns."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample."""
        return self.source.dtype

    def __enter__(self) -> Self:
        check_output(self.path, replaces=self._replaces)
        self._older = _identity(self.path)
        with ExitStack() as opening:
            opening.push(self._finish)
            self._writer.start()
            opening.enter_context(self.source)
            self._exit = opening.pop_all()
        return self

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames, and pass them to the writing thread."""
        self._check()
        block = self.source.read(out)
        self._check()
        if block is None:
            self._reached_end = True
        else:
            self._hand_over(block)
        return block

    def now(self) -> float:
        """Return the source's time."""
        return self.source.now()

    def positions(self) -> Mapping[str, Floats]:
        """Return the source's positions."""
        return self.source.positions()

    def mark(self, index: int, used: NDArray[np.bool_]) -> None:
        """Mark frames, from number ``index`` on, as used or not; unmarked frames count as used."""
        self._queue.put(_Mark(index, np.array(used, bool)))

    def add_maps(self, time: float, height: NDArray[np.float32] | None, contact_area: float | None) -> None:
        """Write maps computed from the frames up to a time, mm and mm^2; not supported for HDF5."""
        if self._messages is not None and self.count:
            maps = _Maps(time, height, contact_area)
            self._reserve(maps.size)
            self._queue.put(maps)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _hand_over(self, block: Block) -> None:
        """Queue a block for the writing thread, unless the queue is full."""
        frames, size = block.frames, block.frames.nbytes
        if frames.dtype != self.dtype or frames.shape[1:] != self.shape[1:]:
            raise ValueError(f"{self.name} gave {frames.shape} {frames.dtype} and announced {self.shape}")
        self._reserve(size)
        if not block.stays_valid:
            block = dataclasses.replace(block, frames=frames.copy())
        self._queue.put(block)
        self.count += len(frames)

    def _reserve(self, size: int) -> None:
        """Add to the number of bytes waiting to be written; InputError if there are too many."""
        with self._lock:
            backlog, self._backlog = self._backlog, self._backlog + size
        if backlog and backlog + size > _BACKLOG:
            raise InputError(
                f"{self.path}: the disk is too slow: {backlog / 1e6:.0f} MB of frames wait for it; "
                "take fewer or smaller ones, or choose another place with -o"
            )

    def _finish(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Make the thread write the final values, and wait for it."""
        positions: Mapping[str, Floats] = {}
        failure = error
        try:
            if self.count:
                positions = self.source.positions()
        except BaseException as failed:  # Ctrl-C, too: the frames are kept in any case
            failure = failure or failed
        finally:
            self._queue.put(_End(positions, self._final_state(failure)))
        if self._writer.ident is not None:  # the thread was started
            self._writer.join()
        if error is None:
            failure = self._error or failure
            if failure is not None:
                raise failure
            if not self.count:
                raise InputError(f"{self.name} gave no frames: nothing was written")

    def _final_state(self, failure: BaseException | None) -> str:
        if failure is not None:
            return _cut_short(failure)
        return COMPLETE if self._reached_end else f"{CUT_SHORT}stopped before the last frame"

    def _write(self) -> None:
        """Write the contents of the queue; the body of the thread."""
        try:
            with self._write_errors():
                file = self._begin()
                if file is not None:
                    with file:
                        end = self._follow(file)
                        file.finish(end.positions, end.state)
                    self.state = end.state
                    if self.state == COMPLETE:
                        self._take_name()
        except BaseException as error:  # raised again where frames are read
            self._error = self._error or error

    def _begin(self) -> GrowingRecording | GrowingMessages | None:
        """Create the file with the first block in it, and name it; None if there is no block."""
        while (block := self._wait(_POLL)) is None:
            pass
        if not isinstance(block, Block):
            return None
        with ExitStack() as opening, new_part(self.path) as (part, descriptor):
            file = self._open(descriptor, block)
            opening.push(file)
            self._append(file, block)
            file.publish()
            synchronise(descriptor)
            self.file = self._name(part)
            opening.pop_all()  # the caller closes it from now on
        return file

    def _name(self, part: Path) -> Path:
        """Rename the recording to the first free name: ``path``, or another name next to it."""
        target = Path(os.path.realpath(self.path))
        with suppress(FileExistsError):
            link_new(part, target)
            return self.path
        number = 1
        while True:
            ending = "-partial" if number == 1 else f"-partial-{number}"
            name = target.with_name(f"{target.stem}{ending}{target.suffix}")
            with suppress(FileExistsError):
                link_new(part, name)
                return name
            number += 1

    def _take_name(self) -> None:
        """Replace the older file by the complete recording, unless the older file has changed."""
        if self.file == self.path:
            return
        target = Path(os.path.realpath(self.path))
        with suppress(FileExistsError):
            if self._older is not None and _identity(target) == self._older:
                replace_file(self.file, target)
            else:
                link_new(self.file, target)
                with suppress(OSError):  # the recording has its name
                    self.file.unlink(missing_ok=True)
            self.file = self.path
            return
        raise InputError(
            f"{self.path} was made by another program meanwhile: the recording is complete, and named"
            f" {self.file}; rename it"
        )

    def _open(self, descriptor: int, block: Block) -> GrowingRecording | GrowingMessages:
        if self._messages is not None:
            return self._messages(self.path, descriptor, self.header)
        layout = self.header, self.shape, self.dtype, self._compression, self._calibration
        series = [name for name in SERIES if getattr(block, name) is not None]
        return GrowingRecording(self.path, descriptor, *layout, series)

    def _follow(self, file: GrowingRecording | GrowingMessages) -> _End:
        """Append queued items until the end; after an error, wait for the end."""
        try:
            with self._write_errors():
                return self._append_all(file)
        except InputError as error:
            self._error = error
            while not isinstance(item := self._wait(_POLL), _End):
                pass
            return _End(item.positions, _cut_short(error))

    def _append_all(self, file: GrowingRecording | GrowingMessages) -> _End:
        due = time.monotonic() + self._period
        while True:
            item = self._wait(max(0.0, due - time.monotonic()))
            if isinstance(item, _End):
                return item
            if isinstance(item, _Mark):
                file.mark(item.start, item.used)
            elif isinstance(item, _Maps):
                file.add_maps(*item)
                self._release(item.size)
            elif item is not None:
                self._append(file, item)
            del item  # releases frames at once
            if time.monotonic() >= due:
                file.flush()
                due = time.monotonic() + self._period

    def _wait(self, timeout: float) -> Block | _Mark | _Maps | _End | None:
        """Return the next item in the queue; None after a timeout, the end if the program has ended."""
        with suppress(queue.Empty):
            return self._queue.get(timeout=timeout)
        return None if threading.main_thread().is_alive() else _End({}, _cut_short(SystemExit()))

    def _append(self, file: GrowingRecording | GrowingMessages, block: Block) -> None:
        file.append(block)
        self.written = file.count
        self._release(block.frames.nbytes)

    def _release(self, size: int) -> None:
        with self._lock:
            self._backlog -= size

    def _write_errors(self) -> AbstractContextManager[None]:
        return translate_os_errors(f"{self.path} could not be written", MAKE_ROOM)


_Identity = tuple[int, int]


def _identity(path: Path) -> _Identity | None:
    """Return the identity of a file, which differs for another file of the same name; None without a file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _cut_short(error: BaseException) -> str:
    """Return in one line why a recording ended."""
    if isinstance(error, KeyboardInterrupt):
        why = "stopped by the user"
    elif isinstance(error, SystemExit | GeneratorExit):
        why = "the program was ended"
    else:
        why = (str(error) or type(error).__name__).splitlines()[0]
    return CUT_SHORT + why


class Column:
    """A dataset with one row per frame; rows can be set at any time, and are written by ``flush``."""

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
        # An initial row allocates its storage before the first frame.
        blank = np.zeros_like(self._rows[:1])
        self._dataset = file.create_dataset(name, data=blank, chunks=chunk, maxshape=(None, *width))
        if unit is not None:
            self._dataset.attrs["units"] = unit
        self._written = 0  # rows of the file that are up to date

    def set(self, start: int, rows: NDArray[Any]) -> None:
        """Set rows, starting at some frame; frames in between keep the default."""
        self._grow(start + len(rows))
        self._rows[start : start + len(rows)] = rows
        self._written = min(self._written, start)

    def correct(self, rows: NDArray[Any]) -> None:
        """Replace the first rows by corrected values, where these are finite."""
        self._grow(len(rows))
        self.set(0, np.where(np.isfinite(rows), rows, self._rows[: len(rows)]))

    def flush(self, count: int) -> None:
        """Write the changes of the first rows to HDF5."""
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
    """A recording to which frames are appended; after ``publish`` other programs can read it.

    Raw frames are contiguous if there are no more than expected. A frame counts as used unless ``mark``
    states otherwise.
    """

    def __init__(
        self,
        path: Path,
        descriptor: int,
        header: Header,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        compression: Compression,
        calibration: Calibration | None,
        series: Collection[str],
    ) -> None:
        self.count: int = 0
        self._raw = compression == "raw"
        self._frame = math.prod(shape[1:]) * dtype.itemsize
        # Indices of chunks and other metadata are contiguous before the frames, not between them.
        meta = min((1 << 16) + 24 * shape[0], _MOST_META)
        self._spare = _SPARE + 2 * meta
        self._path, self._step = path, min(_STEP, shape[0] * self._frame)
        self._reserved, self._cannot_preallocate = 0, False
        with ExitStack() as opening:
            self._descriptor = os.dup(descriptor)
            opening.callback(os.close, self._descriptor)
            opening.callback(synchronise, self._descriptor)
            needed = self._spare + 32 * math.prod(shape[1:])  # includes the maps of the header
            needed += 0 if calibration is None else size_of(calibration)
            self._reserve(needed)
            file = h5py.File(
                f"/proc/self/fd/{self._descriptor}",
                "w",
                libver=VERSIONS,
                locking=False,  # HDF5 releases its lock when others may read; this class keeps its own
                meta_block_size=meta,
                alignment_threshold=self._frame,
                alignment_interval=math.gcd(self._frame, _PAGE),
            )
            self._file = opening.enter_context(file)
            self._reserve(needed)  # again, because HDF5 has truncated the file
            write_header(self._file, header, calibration)
            names = {"time", POSITIONS[header.motion], *series}
            self._make(shape, dtype, compression, names)
            write_plot(self._file, header.motion, names)
            self._file.flush()  # everything but the frames is allocated now
            self._exit = opening.pop_all()

    def append(self, block: Block) -> None:
        """Write frames, and store the values of each until the next ``flush``."""
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

    def mark(self, start: int, used: NDArray[np.bool_]) -> None:
        """Mark frames, from number ``start`` on, as used or not."""
        self._used.set(start, used)

    def add_maps(self, *_maps: object) -> None:
        """Raise TypeError: this format does not store maps."""
        raise TypeError("maps go into MCAP files alone")

    def flush(self) -> None:
        """Pass all data to the operating system, so that it can be read and survives this process."""
        self._hold(0)
        self._flush()

    def publish(self) -> None:
        """Allow other programs to read; they still cannot write."""
        self.flush()
        self._file.swmr_mode = True
        with suppress(OSError):  # a file system without locks
            lock(self._descriptor, shared=True)

    def finish(self, positions: Mapping[str, Floats], state: str) -> None:
        """Write the values that are only known at the end."""
        if self._frames.shape[0] > self.count:  # writing some frames failed
            self._frames.resize(self.count, axis=0)
        for name, values in positions.items():
            if name in self._series:
                self._series[name][0].correct(np.asarray(values, np.float64)[: self.count])
        self._flush()
        self._write_state(state)
        self._file.flush()

    def close(self) -> None:
        """Close the file, and release the preallocated space that was not needed."""
        if self._file:
            os.ftruncate(self._descriptor, self._file.id.get_filesize())
        self._exit.close()

    def _make(
        self, shape: tuple[int, int, int], dtype: np.dtype[Any], compression: Compression, names: set[str]
    ) -> None:
        """Create the datasets that grow: no others can be created afterwards."""
        file, (expected, rows, columns) = self._file, shape
        chunks, maximum = (1, rows, columns), (None, rows, columns)
        storage = {"chunks": chunks, "maxshape": maximum, **packing(compression)}
        # Without a cache, each chunk is compressed immediately.
        self._frames = new_stack(file, (0, rows, columns), dtype, rdcc_nbytes=0, **storage)
        self._state = file.create_dataset(STATE, (), h5py.string_dtype("utf-8", _STATE_LENGTH))
        self._write_state(UNDER_WAY)
        self._series = {
            name: [
                Column(file, *place, np.nan, expected, ROW_SHAPES.get(name, ()))
                for place in (SERIES[name], LIVE.get(name))
                if place is not None
            ]
            for name in SERIES
            if name in names
        }
        self._dropped = Column(file, DROPPED, None, np.int32(0), expected)
        self._checksums = Column(file, CHECKSUM, None, np.uint32(0), expected)
        self._used = Column(file, USED, None, np.uint8(1), expected)

    def _flush(self) -> None:
        """Flush the frames, then the other values; the preallocated space is sufficient."""
        self._frames.flush()  # the frames must be stored before any count of them
        for column in (*itertools.chain(*self._series.values()), self._dropped, self._checksums, self._used):
            column.flush(self.count)
        self._file.flush()

    def _write_state(self, state: str) -> None:
        self._state[()] = state.encode()[:_STATE_LENGTH].decode(errors="ignore")

    def _hold(self, size: int) -> None:
        """Preallocate space for ``size`` bytes of frames, and for their values."""
        self._reserve(self._file.id.get_filesize() + size + self._spare)

    def _reserve(self, end: int) -> None:
        """Preallocate the file up to ``end``, if the file system supports it."""
        start = min(self._reserved, os.fstat(self._descriptor).st_size)  # HDF5 may have truncated it
        if self._cannot_preallocate or end <= start:
            return
        for reach in (end + self._step, end):
            try:
                reserve_space(self._descriptor, start, reach - start)
                self._reserved = reach
                return
            except OSError as error:
                self._cannot_preallocate = error.errno in _UNABLE
                if self._cannot_preallocate:
                    return
                if error.errno not in _FULL:
                    raise
                why = os.strerror(error.errno)
        raise InputError(f"{self._path}: the disk is full ({why}); {MAKE_ROOM}")
