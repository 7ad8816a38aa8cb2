"""Writing of recordings: a source that stores the frames it reads, and functions shared by recorders."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, get_args

import h5py
import msgspec
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.checksums import checksums
from mirrorskin.io.base.types import PROPERTIES, Block, Floats, Header, InputError, Motion, Source, Truth
from mirrorskin.io.model.calibration import Calibration
from mirrorskin.io.model.maps import TWIST, declaration_of
from mirrorskin.io.storage.atomic import fixed_text, new_hdf5
from mirrorskin.io.storage.calibration_file import CARRIED, write_calibration
from mirrorskin.io.storage.existing import Replaces
from mirrorskin.io.storage.layout import (
    CHECKSUM,
    DROPPED,
    FINDINGS,
    GROUPS,
    MARK,
    POSITIONS,
    SERIES,
    STACK,
    TRUTH,
    TRUTH_MAPS,
)
from mirrorskin.io.watch.watch import CheckReport, FrameChecker

Compression = Literal["raw", "bitshuffle", "blosc", "gzip", "lzf"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)


def check_compression(compression: str) -> None:
    """Raise InputError for an unknown compression."""
    if compression not in COMPRESSIONS:
        raise InputError(f"unknown compression {compression!r}; known are {', '.join(COMPRESSIONS)}")


def packing(compression: Compression) -> dict[str, Any]:
    """Return the arguments with which h5py creates a compressed dataset."""
    if compression == "raw":
        return {}
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    if compression == "lzf":
        return {"compression": "lzf", "shuffle": True}
    try:
        import hdf5plugin  # registers its filters with HDF5
    except ImportError:
        raise InputError(
            f"--compression {compression} needs hdf5plugin: pip install 'mirrorskin[codecs]', or choose gzip"
        ) from None
    if compression == "bitshuffle":
        return {**hdf5plugin.Bitshuffle(cname="lz4")}
    return {**hdf5plugin.Blosc(cname="lz4", shuffle=hdf5plugin.Blosc.BITSHUFFLE)}


def write_header(file: h5py.File, header: Header, calibration: Calibration | None) -> None:
    """Write the properties of the whole stack, and create the groups."""
    file.attrs.update(NX_class="NXroot", default="entry")
    entry = new_group(file, "entry", "NXentry", default="data", **{MARK: 1})
    put(entry, "title", None, header.title)
    started = header.start_time or datetime.now(UTC).isoformat(timespec="milliseconds")
    put(entry, "start_time", None, started)
    instrument = new_group(entry, "instrument", "NXinstrument")
    detector = new_group(instrument, "detector", "NXdetector")
    stage = new_group(instrument, "stage", "NXpositioner")
    put(stage, "motion", None, header.motion)
    put(detector, "local_name", None, header.camera or None)
    x, y = header.pixel_size or (None, None)
    put(detector, "x_pixel_size", "mm", x)
    put(detector, "y_pixel_size", "mm", y)
    put(detector, "dark", "counts", header.dark)
    put(detector, "bright", "counts", header.bright)
    put(detector, "zenith_gain", "1/rad", header.zenith_gain)
    put(detector, "zenith_offset", "counts", header.zenith_offset)
    for name, prop in PROPERTIES.items():
        put(file[GROUPS[prop.of]], name, prop.unit, getattr(header, name))
    put(stage, "tilt", "rad", header.tilt)
    put(stage, "pivot", "mm", header.pivot)
    if header.motion != "vertical":
        put(stage, "travel", "mm", header.press)
    if calibration is not None:
        write_calibration(file, calibration, CARRIED)


def new_stack(file: h5py.File, shape: tuple[int, int, int], dtype: Any, **storage: Any) -> h5py.Dataset:
    """Create the dataset of the frames."""
    stack = file.create_dataset(STACK, shape, dtype, **storage)
    stack.attrs.update(interpretation="image", units="counts")
    return stack


def write_plot(file: h5py.File, motion: Motion, names: set[str]) -> None:
    """Write the default plot: the frames against their positions, or against their time if unknown."""
    data = new_group(file["entry"], "data", "NXdata", signal="frames")
    data["frames"] = h5py.SoftLink(STACK)
    axes = names - {"displacement"}  # it has two numbers per frame
    along = next((name for name in ("tilt", POSITIONS[motion], "time") if name in axes), None)
    if along is not None:
        target = SERIES[along][0]
        name = target.rsplit("/", 1)[-1]
        data.attrs["axes"] = [name, ".", "."]
        data[name] = h5py.SoftLink(target)


def new_group(parent: h5py.Group, name: str, nexus: str, **attrs: Any) -> h5py.Group:
    """Create a group of a NeXus class."""
    group = parent.create_group(name)
    group.attrs.update(NX_class=nexus, **attrs)
    return group


def put(group: h5py.Group, name: str, unit: str | None, value: Any) -> None:
    """Write a value, and its unit if it has one."""
    if value is not None:
        group[name] = fixed_text(value) if isinstance(value, str) else value
        if unit is not None:
            group[name].attrs["units"] = unit


_Source = TypeVar("_Source", bound=Source)


class TeeSource(Generic[_Source]):
    """A source whose frames are also written to a file when they are read."""

    name: str

    rewindable = False

    def __init__(
        self,
        source: _Source,
        path: str | Path,
        compression: Compression,
        calibration: Calibration | None,
        overwrite: bool,
    ) -> None:
        check_compression(compression)
        self.source = source
        self.path: Path = Path(path)
        self.name, self.motion = source.name, source.motion
        self._compression: Compression = compression
        self._calibration = calibration
        self._replaces: Replaces = "anything" if overwrite else "nothing"
        self._exit = ExitStack()  # run when the recorder is closed

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._exit.__exit__(kind, error, trace)

    def rewind(self) -> None:
        """Raise RuntimeError, because frames have been written."""
        raise RuntimeError("a recorder cannot be rewound")


# Bytes of frames read at a time: for large blocks the system uses large pages.
_BLOCK = 64_000_000


class Recorder(TeeSource[Source]):
    """Pass on the frames of a source, and write them to a recording.

    The recording appears under its name when the recorder is closed without an error.

    Parameters
    ----------
    source : Source
    path : str or Path
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
        "raw" frames are stored contiguously, which is fastest to read; others in one chunk per frame.
    truth : Truth or callable, optional
        Ground truth of a simulation; a callable is called after the last frame.
    calibration : Calibration, optional
        Calibration to copy into the recording; it does not change positions and references.
    overwrite : bool, optional
        Whether an existing file of that name is replaced; by default it is refused.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        As for the source; recorded frames cannot be read again.

    Examples
    --------
    >>> with Recorder(source, "press.h5") as recorder:  # doctest: +SKIP
    ...     recorder.drain()
    """

    header: Header
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    def __init__(
        self,
        source: Source,
        path: str | Path,
        compression: Compression = "raw",
        truth: Truth | Callable[[], Truth] | None = None,
        calibration: Calibration | None = None,
        overwrite: bool = False,
    ) -> None:
        super().__init__(source, path, compression, calibration, overwrite)
        self.header, self.shape, self.dtype = source.header, source.shape, source.dtype
        self._truth = truth
        self._count = 0
        self._series: dict[str, Floats] = {}
        self._checksums = np.zeros(self.shape[0], np.uint32)
        self._dropped = np.zeros(self.shape[0], np.int32)

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            self._new = opening.enter_context(new_hdf5(self.path, self._replaces))
            opening.push(self._finish)
            opening.enter_context(self.source)
            write_header(self._new.root, self.header, self._calibration)
            findings = getattr(self.source, "findings", ())
            put(self._new.root, FINDINGS, None, msgspec.json.encode(findings).decode() if findings else None)
            chunks = None if self._compression == "raw" else (1, *self.shape[1:])
            storage = {"chunks": chunks, **packing(self._compression)}
            self._frames = new_stack(self._new.root, self.shape, self.dtype, **storage)
            self._exit = opening.pop_all()
        return self

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames and write them; see ``Source.read``."""
        block = self.source.read(out)
        if block is not None:
            part = slice(self._count, self._count + len(block.frames))
            self._count = part.stop
            self._check_count(self._count <= self.shape[0])
            self._frames[part] = block.frames
            self._checksums[part] = checksums(block.frames)
            self._dropped[part.start] = block.dropped
            for name in SERIES:
                values = getattr(block, name)
                if values is not None:
                    buffer = np.full((self.shape[0], *values.shape[1:]), np.nan)
                    self._series.setdefault(name, buffer)[part] = values
            self._new.check()
        return block

    def drain(self, progress: Callable[[int], None] | None = None) -> CheckReport:
        """Write all frames, and return their check; ``progress`` is called with the number so far."""
        watch = FrameChecker(self.source, alone=True)
        length = max(1, _BLOCK // (self.shape[1] * self.shape[2] * self.dtype.itemsize))
        buffer = np.empty((min(length, self.shape[0]), *self.shape[1:]), self.dtype)
        while (block := self.read(buffer)) is not None:
            watch.push(block)
            if progress is not None:
                progress(self._count)
        return watch.check()

    def _finish(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Write the values that are only known after the last frame."""
        if kind is None:
            self._check_count(self._count == self.shape[0])
            for name, values in self._series.items():
                put(self._new.root, *SERIES[name], values)
            put(self._new.root, CHECKSUM, None, self._checksums)
            put(self._new.root, DROPPED, None, self._dropped if self._dropped.any() else None)
            if self._truth is not None:
                truth = self._truth() if callable(self._truth) else self._truth
                _write_truth(self._new.root, truth, self.motion)
            write_plot(self._new.root, self.motion, set(self._series))

    def _check_count(self, fits: bool) -> None:
        if not fits:
            raise InputError(
                f"{self.name} gave {self._count} frames and announced {self.shape[0]}: nothing was written"
            )


def _write_truth(file: h5py.File, truth: Truth, motion: Motion) -> None:
    group = new_group(file["entry"], TRUTH, "NXdata", signal="height")
    for name in TRUTH_MAPS:
        declared = declaration_of(name, TWIST if motion == "twist" else {})
        put(group, name, declared.unit or None, getattr(truth, name))
