"""Writing recordings: a source that keeps what it reads."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, get_args

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.layout import MARK, SERIES, STACK, TRUTH, TRUTH_UNITS
from mirrorskin.io.plain import legible
from mirrorskin.io.types import Block, Floats, Header, InputError, Motion, Source, Truth

Compression = Literal["raw", "bitshuffle", "blosc", "gzip", "lzf"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)

# What the frames are plotted along, if it is known; else along the time.
_AXES: dict[Motion, str] = {"vertical": "travel", "axial": "phase", "twist": "twist"}

# Bytes of frames that are drained at a time: much at once, and the system keeps it in large pages.
_BLOCK = 64_000_000


class Recorder:
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

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        The source's; what was recorded cannot be read again.
    """

    rewindable = False

    def __init__(
        self,
        source: Source,
        path: str | Path,
        compression: Compression = "raw",
        truth: Truth | Callable[[], Truth] | None = None,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise InputError(f"unknown compression {compression!r}; known are {', '.join(COMPRESSIONS)}")
        self.source = source
        self.path = Path(path)
        self.name, self.header, self.motion = source.name, source.header, source.motion
        self.shape, self.dtype = source.shape, source.dtype
        self._compression = compression
        self._truth = truth
        self._count = 0
        self._series: dict[str, Floats] = {}
        self._exit = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            self._new = opening.enter_context(new_hdf5(self.path))
            opening.push(self._finish)
            opening.enter_context(self.source)
            _write_header(self._new.root, self.header)
            self._frames = _make_stack(self._new.root, self.shape, self.dtype, self._compression)
            self._exit = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._exit.__exit__(kind, error, trace)

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

    def rewind(self) -> None:
        """Refuse: what was written stays written."""
        raise RuntimeError("a recorder cannot be rewound")

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
                _put(self._new.root, *SERIES[name], values)
            if self._truth is not None:
                truth = self._truth() if callable(self._truth) else self._truth
                _write_truth(self._new.root, truth)
            _make_plot(self._new.root, self._axis())

    def _check_count(self, fits: bool) -> None:
        if not fits:
            raise InputError(
                f"{self.name} gave {self._count} frames and announced {self.shape[0]}: nothing was written"
            )

    def _axis(self) -> str | None:
        names = (_AXES.get(self.motion), "time")
        return next((name for name in names if name in self._series), None)


def _write_header(file: h5py.File, header: Header) -> None:
    file.attrs.update(NX_class="NXroot", default="entry")
    entry = _group(file, "entry", "NXentry", default="data", **{MARK: 1})
    entry["title"] = legible(header.title)
    entry["start_time"] = header.start_time or datetime.now(UTC).isoformat(timespec="milliseconds")
    instrument = _group(entry, "instrument", "NXinstrument")
    detector = _group(instrument, "detector", "NXdetector")
    stage = _group(instrument, "stage", "NXpositioner")
    stage["motion"] = header.motion
    x, y = header.pixel_size or (None, None)
    _put(detector, "x_pixel_size", "mm", x)
    _put(detector, "y_pixel_size", "mm", y)
    _put(detector, "dark", "counts", header.dark)
    _put(detector, "bright", "counts", header.bright)
    _put(detector, "zenith_gain", "1/rad", header.zenith_gain)
    _put(detector, "zenith_offset", "counts", header.zenith_offset)
    _put(stage, "tilt", "rad", header.tilt)
    _put(stage, "pivot", "mm", header.pivot)
    if header.motion != "vertical":
        _put(stage, "travel", "mm", header.press)


def _make_stack(
    file: h5py.File, shape: tuple[int, int, int], dtype: np.dtype[Any], compression: Compression
) -> h5py.Dataset:
    packing: dict[Compression, dict[str, Any]] = {
        "raw": {},
        "bitshuffle": {**hdf5plugin.Bitshuffle(cname="lz4")},
        "blosc": {**hdf5plugin.Blosc(cname="lz4", shuffle=hdf5plugin.Blosc.BITSHUFFLE)},
        "gzip": {"compression": "gzip", "compression_opts": 1, "shuffle": True},
        "lzf": {"compression": "lzf", "shuffle": True},
    }
    chunks = None if compression == "raw" else (1, *shape[1:])
    stack = file.create_dataset(STACK, shape, dtype, chunks=chunks, **packing[compression])
    stack.attrs.update(interpretation="image", units="counts")
    return stack


def _make_plot(file: h5py.File, axis: str | None) -> None:
    """Say what to plot: the frames, along what is known of each."""
    data = _group(file["entry"], "data", "NXdata", signal="frames")
    data["frames"] = h5py.SoftLink(STACK)
    if axis is not None:
        target = SERIES[axis][0]
        name = target.rsplit("/", 1)[-1]
        data.attrs["axes"] = [name, ".", "."]
        data[name] = h5py.SoftLink(target)


def _write_truth(file: h5py.File, truth: Truth) -> None:
    group = _group(file["entry"], TRUTH, "NXdata", signal="height")
    for name, unit in TRUTH_UNITS.items():
        _put(group, name, unit, getattr(truth, name))


def _group(parent: h5py.Group, name: str, nexus: str, **attrs: Any) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs.update(NX_class=nexus, **attrs)
    return group


def _put(group: h5py.Group, name: str, unit: str | None, value: Any) -> None:
    if value is not None:
        group[name] = value
        if unit is not None:
            group[name].attrs["units"] = unit
