"""Recordings that are written while frames come, and can be watched meanwhile."""

from __future__ import annotations

import dataclasses
import queue
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import MAKE_ROOM, check_output, new_file
from mirrorskin.io.calibration.types import Calibration
from mirrorskin.io.growing import GrowingRecording
from mirrorskin.io.layout import COMPLETE, CUT_SHORT, SERIES
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.recorder import Compression, TeeSource
from mirrorskin.io.types import Block, Floats, Header, InputError, LiveSource

_POLL = 0.5  # seconds from one look whether the program is still there to the next
_BACKLOG = 256_000_000  # bytes of frames that may wait for the disk


class _Mark(NamedTuple):
    """Whether some frames were used."""

    start: int
    used: NDArray[np.bool_]


class _End(NamedTuple):
    """What is known after the last frame."""

    positions: Mapping[str, Floats]
    state: str


class StreamRecorder(TeeSource[LiveSource]):
    """Pass on the frames of a live source at once, and write them to a recording behind its back.

    The recording appears under its name with the first frame, and an older file of that name is replaced
    then, not before. From then on other programs can watch (HDF5's SWMR): everything is handed to the
    system each ``period``, and that is what remains if this process is killed. Left by an exception, it
    keeps what was taken, and says in ``/entry/state`` that it was cut short, and why. When it is left, the
    source is left first, so that hardware stops; then the positions are replaced by the source's corrected
    ones, and those that came with the frames stay beside them.

    Parameters
    ----------
    source : LiveSource
        Frames that it does not lend are copied.
    path : str or Path
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
        Frames are stored in one chunk each.
    period : float, optional
        Seconds.
    calibration : Calibration, optional
        What the recording is to carry a copy of; positions and references stay those of the source.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        The source's; what was recorded cannot be read again.
    count, written : int
        Frames that were taken, and those of them that are in the file.

    Examples
    --------
    >>> with StreamRecorder(rig, "press.h5") as recorder:  # doctest: +SKIP
    ...     while (block := recorder.read()) is not None:
    ...         print(block.index)
    """

    def __init__(
        self,
        source: LiveSource,
        path: str | Path,
        compression: Compression = "raw",
        period: float = 0.5,
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(source, path, compression, calibration)
        self.count = self.written = 0
        self._period = period
        self._queue: queue.SimpleQueue[Block | _Mark | _End] = queue.SimpleQueue()
        self._backlog, self._lock = 0, threading.Lock()
        self._error: BaseException | None = None
        self._writer = threading.Thread(target=self._write, name="recorder")

    @property
    def header(self) -> Header:
        """What holds for all frames; asked of the source when the first frame has come."""
        return self.source.header

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames that are expected, rows and columns."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample."""
        return self.source.dtype

    def __enter__(self) -> Self:
        check_output(self.path)
        with ExitStack() as opening:
            opening.push(self._finish)
            self._writer.start()
            opening.enter_context(self.source)
            self._exit = opening.pop_all()
        return self

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames, and hand them to the thread that writes them."""
        self._check()
        block = self.source.read(out)
        self._check()
        if block is not None:
            self._hand_over(block)
        return block

    def now(self) -> float:
        """Return the source's time."""
        return self.source.now()

    def positions(self) -> Mapping[str, Floats]:
        """Return the source's positions."""
        return self.source.positions()

    def mark(self, index: int, used: NDArray[np.bool_]) -> None:
        """Say whether frames, from number ``index`` on, were used; unless marked, they were."""
        self._queue.put(_Mark(index, np.array(used, bool)))

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _hand_over(self, block: Block) -> None:
        """Queue a block for the thread that writes, if there is room."""
        frames, size = block.frames, block.frames.nbytes
        if frames.dtype != self.dtype or frames.shape[1:] != self.shape[1:]:
            raise ValueError(f"{self.name} gave {frames.shape} {frames.dtype} and announced {self.shape}")
        with self._lock:
            backlog, self._backlog = self._backlog, self._backlog + size
        if backlog and backlog + size > _BACKLOG:
            raise InputError(
                f"{self.path}: the disk is too slow: {backlog / 1e6:.0f} MB of frames wait for it; "
                "take fewer or smaller ones, or choose another place with -o"
            )
        if not block.lent:
            block = dataclasses.replace(block, frames=frames.copy())
        self._queue.put(block)
        self.count += len(frames)

    def _finish(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Have the thread write what is known only now, and wait for it."""
        positions: Mapping[str, Floats] = {}
        failure = error
        try:
            if self.count:
                positions = self.source.positions()
        except BaseException as failed:  # Ctrl-C, too: the frames are kept all the same
            failure = failure or failed
        finally:
            self._queue.put(_End(positions, COMPLETE if failure is None else _cut_short(failure)))
        if self._writer.ident is not None:  # it was started
            self._writer.join()
        if error is None:
            failure = self._error or failure
            if failure is not None:
                raise failure
            if not self.count:
                raise InputError(f"{self.name} gave no frames: nothing was written")

    def _write(self) -> None:
        """Write what is queued; the body of the thread."""
        try:
            with self._write_errors():
                file = self._begin()
                if file is not None:
                    with file:
                        end = self._follow(file)
                        file.finish(end.positions, end.state)
        except BaseException as error:  # it is raised where frames are read
            self._error = self._error or error

    def _begin(self) -> GrowingRecording | None:
        """Make the file with the first block in it, and give it its name; None if no block comes."""
        while (block := self._wait(_POLL)) is None:
            pass
        if not isinstance(block, Block):
            return None
        with ExitStack() as opening:
            with new_file(self.path) as descriptor:
                known = self.header, self.shape, self.dtype, self._compression, self._calibration
                series = [name for name in SERIES if getattr(block, name) is not None]
                file = opening.enter_context(GrowingRecording(self.path, descriptor, *known, series))
                self._append(file, block)
                file.publish()
            opening.pop_all()  # from here on it is the caller's to close
        return file

    def _follow(self, file: GrowingRecording) -> _End:
        """Append what comes; after an error, wait for the end."""
        try:
            with self._write_errors():
                return self._append_all(file)
        except InputError as error:
            self._error = error
            while not isinstance(item := self._wait(_POLL), _End):
                pass
            return _End(item.positions, _cut_short(error))

    def _append_all(self, file: GrowingRecording) -> _End:
        due = time.monotonic() + self._period
        while True:
            item = self._wait(max(0.0, due - time.monotonic()))
            if isinstance(item, _End):
                return item
            if isinstance(item, _Mark):
                file.mark(item.start, item.used)
            elif item is not None:
                self._append(file, item)
            del item  # what a source lends, it has back at once
            if time.monotonic() >= due:
                file.flush()
                due = time.monotonic() + self._period

    def _wait(self, timeout: float) -> Block | _Mark | _End | None:
        """Return what is queued next, None if nothing comes in time; the end, where the program just left."""
        with suppress(queue.Empty):
            return self._queue.get(timeout=timeout)
        return None if threading.main_thread().is_alive() else _End({}, _cut_short(SystemExit()))

    def _append(self, file: GrowingRecording, block: Block) -> None:
        file.append(block)
        self.written = file.count
        with self._lock:
            self._backlog -= block.frames.nbytes

    def _write_errors(self) -> AbstractContextManager[None]:
        return as_input_error(f"{self.path} could not be written", MAKE_ROOM)


def _cut_short(error: BaseException) -> str:
    """Say in one line why a recording ended."""
    if isinstance(error, KeyboardInterrupt):
        why = "stopped by the user"
    elif isinstance(error, SystemExit | GeneratorExit):
        why = "the program was ended"
    else:
        why = (str(error) or type(error).__name__).splitlines()[0]
    return CUT_SHORT + why
