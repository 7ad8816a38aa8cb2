"""Writing recordings: a source that keeps what it reads."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.calibration.file import CARRIED, write_calibration
from mirrorskin.io.calibration.types import Calibration
from mirrorskin.io.layout import SERIES, TRUTH, TRUTH_UNITS
from mirrorskin.io.passing import Passing
from mirrorskin.io.types import Block, Floats, InputError, Source, Truth
from mirrorskin.io.writing import (
    Compression,
    new_group,
    new_stack,
    packing,
    put,
    write_header,
    write_plot,
)

# Bytes of frames that are drained at a time: much at once, and the system keeps it in large pages.
_BLOCK = 64_000_000


class Recorder(Passing[Source]):
    """Pass on the frames of a source, and write them to a recording as they go by.

    The recording appears under its name when the recorder is left without an error.

    Parameters
    ----------
    source : Source
    path : str or Path
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
        Raw frames are stored in one piece, which is the fastest to read; the others in one chunk a frame.
    truth : Truth or callable, optional
        What a simulation knows; a callable is asked for it after the last frame.
    calibration : Calibration, optional
        What the recording is to carry a copy of; positions and references stay those of the source.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        The source's; what was recorded cannot be read again.
    """

    def __init__(
        self,
        source: Source,
        path: str | Path,
        compression: Compression = "raw",
        truth: Truth | Callable[[], Truth] | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(source, path, compression, calibration)
        self.header, self.shape, self.dtype = source.header, source.shape, source.dtype
        self._truth = truth
        self._count = 0
        self._series: dict[str, Floats] = {}

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            self._new = opening.enter_context(new_hdf5(self.path))
            opening.push(self._finish)
            opening.enter_context(self.source)
            write_header(self._new.root, self.header)
            if self._calibration is not None:
                write_calibration(self._new.root, self._calibration, CARRIED)
            chunks = None if self._compression == "raw" else (1, *self.shape[1:])
            storage = {"chunks": chunks, **packing(self._compression)}
            self._frames = new_stack(self._new.root, self.shape, self.dtype, **storage)
            self._exit = opening.pop_all()
        return self

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames and write them; see ``Source.read``.

        Raises
        ------
        InputError
            The disk is full, or the source gives more frames than it announced.
        """
        block = self.source.read(out)
        if block is not None:
            part = slice(self._count, self._count + len(block.frames))
            self._count = part.stop
            self._check_count(self._count <= self.shape[0])
            self._frames[part] = block.frames
            for name in SERIES:
                values = getattr(block, name)
                if values is not None:
                    room = np.full((self.shape[0], *values.shape[1:]), np.nan)
                    self._series.setdefault(name, room)[part] = values
            self._new.check()
        return block

    def drain(self, progress: Callable[[int], None]) -> None:
        """Write all frames, for their recording alone; ``progress`` is told how many there are so far."""
        length = max(1, _BLOCK // (self.shape[1] * self.shape[2] * self.dtype.itemsize))
        room = np.empty((min(length, self.shape[0]), *self.shape[1:]), self.dtype)
        while self.read(room) is not None:
            progress(self._count)

    def _finish(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Write what is known only after the last frame."""
        if kind is None:
            self._check_count(self._count == self.shape[0])
            for name, values in self._series.items():
                put(self._new.root, *SERIES[name], values)
            if self._truth is not None:
                truth = self._truth() if callable(self._truth) else self._truth
                _write_truth(self._new.root, truth)
            write_plot(self._new.root, self.motion, set(self._series))

    def _check_count(self, fits: bool) -> None:
        if not fits:
            raise InputError(
                f"{self.name} gave {self._count} frames and announced {self.shape[0]}: nothing was written"
            )


def _write_truth(file: h5py.File, truth: Truth) -> None:
    group = new_group(file["entry"], TRUTH, "NXdata", signal="height")
    for name, unit in TRUTH_UNITS.items():
        put(group, name, unit, getattr(truth, name))
