"""Recordings from arrays, in memory or in a file written by NumPy."""

from __future__ import annotations

import hashlib
import math
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.arguments import as_array, as_pixel_size, unknown_argument
from mirrorskin.io.base.content import identified
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.samples import DecodedFrames, Decoding, frame_axes
from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.system import (
    MAX_UNPACKED_BYTES,
    check_regular,
    check_unpacked,
    open_regular,
    translate_os_errors,
)
from mirrorskin.io.base.types import FRAME_DTYPES, MOTIONS, Block, Header, InputError, Motion, block_memory
from mirrorskin.io.files.recording import Recording, cut_out, unwritten_frames
from mirrorskin.io.formats.registry import Format, open_reader
from mirrorskin.io.model.frames import FrameReader, WholeFrames
from mirrorskin.io.model.positions import Positions, along, check_finite
from mirrorskin.io.storage.fingerprint import State, check_unchanged, fingerprint_of_files, modified, state_of
from mirrorskin.io.storage.layout import COMPLETE, POSITIONS, REMEDIES, ROW_SHAPES, as_series
from mirrorskin.io.storage.stack import RawFrames

_KNOWN = {*POSITIONS.values(), "dark", "bright"}  # arrays of an archive that are not frames
_NEEDED = "travel (--travel-step or --travel), phase (--phase-step or --phases)"
_HASH_INTERVAL, _HASH_LENGTH = 4 << 20, 4 << 10  # bytes: of each 4 MiB of frames, the first 4 KiB are hashed
_HEAD_BYTES = 1 << 14  # bytes read for the header of a member: NumPy accepts at most 10 000 characters
_UNPACKED_BYTES = 1 << 20  # bytes unpacked at a time


class ArrayRecording(Recording):
    """A recording of a motion from an array of frames, (T, H, W); see ``Recording``.

    Parameters
    ----------
    frames : array_like or FrameReader, (T, H, W)
        An array, or frames in a file, which are read when they are used; see
        `mirrorskin.io.base.samples.frame_dtype` for their types.
    positions : mapping
        ``travel``, mm, (T,), ``phase`` or ``twist``, radians, (T,), or ``displacement``, mm, (T, 2).
    header : mapping
        Properties, such as ``pixel_size``, ``tilt``, ``press``, ``pivot`` and ``dark``: those of ``Header``.
    motion : str, optional
        By default the motion of the given position.
    region, frame_range
        The part of the picture; the first frame, and the end of the frames.
    name : str
        Name of the array in messages.
    origins : mapping
        The file of the array, with its state when it was opened.

    Raises
    ------
    InputError
        Frames, positions or header cannot be used.

    Examples
    --------
    >>> frames = np.zeros((5, 3, 4), np.uint8)
    >>> press = ArrayRecording(frames, {"travel": [0.0, 0.1, 0.2, 0.3, 0.4]}, {"pixel_size": 0.03})
    >>> press.motion, press.header.pixel_size
    ('vertical', (0.03, 0.03))
    """

    def __init__(
        self,
        frames: ArrayLike | FrameReader,
        positions: Mapping[str, ArrayLike | Positions | None],
        header: Mapping[str, Any],
        motion: Motion | None = None,
        region: Region | None = None,
        frame_range: tuple[int, int | None] | None = None,
        name: str = "the array of frames",
        origins: Mapping[Path, State] | None = None,
    ) -> None:
        _check_names(name, positions, header)
        frames = frames if isinstance(frames, FrameReader) else as_array("frames", frames)
        reader = frames if isinstance(frames, FrameReader) else None
        if isinstance(frames, np.ndarray) and frames.ndim > 3:
            frames = frames.squeeze(tuple(frame_axes(frames.shape, (), None, name)[1]))
        if reader is not None and reader.shape[0] < 2:
            hints = "".join(f". {finding.text}" for finding in reader.findings if finding.warning)
            raise InputError(f"{name} contains {reader.shape[0]} frame: a stack has at least 2{hints}")
        if len(frames.shape) != 3 or frames.shape[0] < 2 or 0 in frames.shape:
            raise InputError(f"{name} has shape {frames.shape}: frames, (T, H, W), at least 2, are needed")
        decoding = Decoding(frames.dtype.newbyteorder("="), where=name)
        self._frames: NDArray[Any] | FrameReader | DecodedFrames = frames
        if isinstance(frames, np.ndarray) and frames.dtype != decoding.dtype:
            self._frames = decoding.decode(frames)
        elif isinstance(frames, FrameReader) and not decoding.plain:
            self._frames = DecodedFrames(frames, decoding, frames.shape)
        self.findings = decoding.findings
        self.path, self.name, self.dataset, self._files = Path(name), name, "", dict(origins or {})
        self.motion, series = _motion(name, positions, motion)
        self.full_shape: tuple[int, int, int] = frames.shape[0], frames.shape[1], frames.shape[2]
        selection = cut_out(name, self.full_shape, frame_range, region)
        self.region, self.origin, self.first_frame = (
            selection.region,
            selection.region.origin,
            selection.frames[0],
        )
        self.which: str = f"{selection.frames[0]}:{selection.frames[1]}"
        self.shape: tuple[int, int, int] = (
            selection.frames[1] - selection.frames[0],
            *selection.region.shape,
        )
        self.dtype: np.dtype[Any] = decoding.dtype
        self.time = self.travel = self.phase = self.displacement = self.twist = self.tilt = None
        lost = None if reader is None else reader.lost
        series_of_frames = along(as_series(series, positions[series]), self.full_shape[0], lost)
        assert series_of_frames is not None
        width = ROW_SHAPES.get(series, ())
        where = f"{name}: the {series} given"
        if np.shape(series_of_frames)[:1] == (self.full_shape[2],) != (self.full_shape[0],):
            count, _, columns = self.full_shape
            problem = (
                f"{where} has shape {np.shape(series_of_frames)} for {count} frames of {columns} columns"
            )
            raise InputError(f"{problem}: if the frames are the last axis, use numpy.moveaxis(frames, -1, 0)")
        setattr(
            self, series, check_finite(series_of_frames, self.full_shape[0], where, selection.frames, width)
        )
        levels = {
            level: _map(name, level, header.get(level), self.full_shape[1:]) for level in ("dark", "bright")
        }
        properties: dict[str, Any] = {
            key: level[selection.region.slices] for key, level in levels.items() if level is not None
        }
        properties["pixel_size"] = _pixel_size(name, header.get("pixel_size"))
        self.header: Header = Header(self.motion, **{"title": self.path.stem, **header, **properties})
        self.used, self.dropped, self.state = None, None, COMPLETE
        if reader is not None:
            self.time = None if reader.time is None else reader.time[slice(*selection.frames)]
            self.dropped = None if lost is None else lost[slice(*selection.frames)]
            self.left_out, self.findings = reader.left_out, (*reader.findings, *decoding.findings)
        self.storage = reader.how if isinstance(reader, WholeFrames) else "one piece"
        self._next, self._hash = 0, ""
        self._random_access = reader is None or reader.random_access
        if self.twist is not None and (extent := float(np.ptp(self.twist))) > math.pi:
            text = f"the twist spans {extent:.4g} rad, more than half a turn: is it in degrees?"
            self.findings = (*self.findings, Finding("twist", text))

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Return the next frames, at most ``len(out)``: a view of the array, or copied to ``out``."""
        out = block_memory(out, self.shape, self.dtype)
        if isinstance(self._frames, np.ndarray):
            return self.read_in_place(len(out))
        start, stop = self._next, min(self._next + len(out), self.shape[0])
        if start == stop:
            return None
        lost = self.dropped
        if lost is not None:  # frames of one block follow each other
            stop = next((number for number in range(start + 1, stop) if lost[number]), stop)
        block = self._block(self._part(start, out[: stop - start]))
        return block if lost is None else replace(block, dropped=int(lost[start]))

    def read_in_place(self, limit: int) -> Block | None:
        """Return at most ``limit`` next frames as a view of the array; None at the end or for a file."""
        if not isinstance(self._frames, np.ndarray):
            return None
        start = self.first_frame + self._next
        stop = min(start + limit, self.first_frame + self.shape[0])
        frames = self._frames[start:stop, *self.region.slices]
        return self._block(frames) if len(frames) else None

    def frame(self, number: int) -> NDArray[Any]:
        """Return one frame, (H, W)."""
        frame: NDArray[Any] = self._part(number, np.empty((1, *self.shape[1:]), self.dtype))[0]
        return frame

    def _part(self, start: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames: a view of the array, or read into ``out``."""
        start += self.first_frame
        if isinstance(self._frames, np.ndarray):
            return self._frames[start : start + len(out), *self.region.slices]
        span = start, start + len(out)
        with translate_os_errors(f"{self.name}: frames {start} to {span[1] - 1} cannot be read"):
            self._frames.fetch((span, self.region.rows, self.region.columns), out)
        return out

    def fingerprint(self) -> str:
        """Return a SHA-256 of the array's shape and type, and of 4 KiB of each 4 MiB of its frames.

        If frames can only be decoded in order, the bytes of their files are hashed instead.
        """
        check_unchanged(self._files)
        if not self._hash:
            digest = hashlib.sha256(f"{self.full_shape} {self.dtype} {self.which} {self.region}".encode())
            if isinstance(self._frames, WholeFrames):
                self._hash = fingerprint_of_files(self._files, digest)
                return self._hash
            step = max(1, _HASH_INTERVAL // (math.prod(self.shape[1:]) * self.dtype.itemsize))
            for number in range(0, self.shape[0], step):
                flat = np.ascontiguousarray(self.frame(number)).reshape(-1).view(np.uint8)
                for start in range(0, len(flat), _HASH_INTERVAL):
                    digest.update(flat[start : start + _HASH_LENGTH].tobytes())
            self._hash = digest.hexdigest()
        return self._hash

    def find_damage(self) -> None:
        """Return None: an array has no checksums."""

    @property
    def carried(self) -> None:
        """None: an array contains no calibration."""

    truth = carried

    @property
    def how(self) -> str:
        """How the frames are read."""
        return "in place" if isinstance(self._frames, np.ndarray) else self._frames.how

    @property
    def random_access(self) -> bool:
        """Whether a frame is read without others."""
        return self._random_access

    @property
    def modified(self) -> str:
        """Time of the last change of the file; empty for an array in memory."""
        return modified(self._files) if self._files else ""

    def close(self) -> None:
        """Release the frames."""
        if isinstance(self._frames, np.ndarray):
            self._frames = self._frames[:0]
        else:
            self._frames.close()


@contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    """Convert NumPy's errors for a damaged file to a one-line error that names the file."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # a damaged header is parsed as Python, which raises errors of many types
        text = " ".join(str(error).split())
        kind = identified(path) if path.is_file() else ""
        if kind and (path.suffix.lower() == ".npy" or not zipfile.is_zipfile(path)):
            raise InputError(f"{path} is not a NumPy array, but {kind}") from error
        raise InputError(
            f"{path} is not a NumPy array of numbers ({text}): write it with numpy.save"
        ) from error


class _Head(NamedTuple):
    """Contents of the header of an array."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    size: int  # bytes of the header; the values follow

    @property
    def nbytes(self) -> int:
        """Size of the values in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def _read_head(file: IO[bytes]) -> _Head:
    # NumPy's own functions read as many bytes as the header states, without a limit.
    start = BytesIO(file.read(_HEAD_BYTES))
    version = np.lib.format.read_magic(start)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read(start)
    if any(length < 0 for length in shape):
        raise ValueError(f"its shape is {shape}")
    return _Head(shape, fortran_order, dtype, start.tell())


def list_arrays(path: Path) -> dict[str, str]:
    """Return the names of the arrays in a file, with the shape and type of each."""
    with _errors_named(path), open_regular(path) as file:
        if path.suffix.lower() == ".npy":
            return {"array": _describe(_read_head(file))}
        with zipfile.ZipFile(file) as archive:
            return {name: _describe(_head_of(archive, member)) for name, member in _members(archive).items()}


def _describe(head: _Head) -> str:
    return f"{' x '.join(map(str, head.shape)) or 'one number'}, {head.dtype}"


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an archive by the names of their arrays."""
    return {
        member.filename.removesuffix(".npy"): member for member in archive.infolist() if not member.is_dir()
    }


def _head_of(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> _Head:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename} is compressed by method {member.compress_type}")
    with archive.open(member) as opened:
        return _read_head(opened)


def read_array(path: Path) -> NDArray[Any]:
    """Read an array of numbers written by ``numpy.save``."""
    with _errors_named(path), open_regular(path) as file:
        head = _number_head(file)
        check_unpacked(head.nbytes, str(path), "give a smaller array")
        return _read_values(file, head)


def read_map(path: Path) -> NDArray[Any]:
    """Read a value for each pixel, (H, W): a picture, or an array written by ``numpy.save``.

    Raises
    ------
    InputError
        The file cannot be read, or is not a map.
    """
    from mirrorskin.io.formats.pictures import read_picture

    values = read_array(path) if path.suffix.lower() == ".npy" else read_picture(path)
    if values.ndim != 2:
        raise InputError(f"{path} has shape {values.shape}: a map (H, W) is needed, one value a pixel")
    check_unpacked(values.nbytes + 4 * values.size, f"{path}, as float32,", "give a smaller one")
    return values


def _open_frames(path: Path) -> NDArray[Any] | RawFrames:
    """Open the array of numbers in a ``.npy`` file as frames; they are read when they are used."""
    with open_regular(path) as file:
        head = _number_head(file)
        if head.fortran_order or len(head.shape) < 3:
            return _read_values(file, head)
        axes, _ = frame_axes(head.shape, (), None, str(path))
        frames, rows, columns = (head.shape[axis] for axis in axes)
        return RawFrames(os.dup(file.fileno()), head.size, (frames, rows, columns), head.dtype)


def _rest_of(path: Path) -> tuple[Finding, ...]:
    """Return the finding about what follows the array in a ``.npy`` file, which is not read."""
    if path.suffix.lower() != ".npy":
        return ()
    with open_regular(path) as file:
        head, size = _number_head(file), os.fstat(file.fileno()).st_size
        rest = size - head.size - head.nbytes
        file.seek(head.size + head.nbytes)
        mark = np.lib.format.MAGIC_PREFIX
        again = file.read(len(mark)) == mark
    if not rest:
        return ()
    what = "another array follows, as of several numpy.save" if again else f"{rest} bytes follow"
    text = f"its header states {_describe(head)}, and {what}: only the first array is read; join them in one"
    return (Finding("number of frames", text),)


def _number_head(file: BufferedReader) -> _Head:
    """Read the header of an array of numbers that is complete."""
    head, size = _read_head(file), os.fstat(file.fileno()).st_size
    if head.dtype.kind not in "buif":
        raise ValueError(f"it contains {head.dtype}")
    if head.size + head.nbytes > size:
        raise ValueError(f"it states {head.nbytes} bytes of values and has {size - head.size}")
    return head


def _read_values(file: IO[bytes], head: _Head) -> NDArray[Any]:
    values = np.empty(math.prod(head.shape), head.dtype)
    file.seek(head.size)
    read: Any = file  # IO lacks readinto
    rest = values.view(np.uint8).data if values.size else memoryview(b"")
    while rest:
        count = read.readinto(rest[:_UNPACKED_BYTES])
        if not count:
            raise ValueError("it was cut off")
        rest = rest[count:]
    return values.reshape(head.shape, order="F" if head.fortran_order else "C")


def _read_members(
    path: Path, archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo], limit: int
) -> dict[str, NDArray[Any]]:
    """Read some arrays; compressed arrays may take at most ``limit`` bytes together."""
    heads = {name: _head_of(archive, member) for name, member in members.items()}
    for name, head in heads.items():
        if head.dtype.kind not in "buif":
            raise ValueError(f"{name} contains {head.dtype}")
        if head.size + head.nbytes != members[name].file_size:
            raise ValueError(f"{name} states {head.nbytes} bytes of values and has another number")
    packed = [name for name, member in members.items() if member.compress_type != zipfile.ZIP_STORED]
    unpacked = sum(_memory(heads[name]) for name in packed)
    remedy = "raise --memory, or write it with numpy.savez"
    check_unpacked(unpacked, f"{path}: {', '.join(packed)}", remedy, limit)
    return {name: _read_member(archive, members[name], head) for name, head in heads.items()}


def _memory(head: _Head) -> int:
    """Return the bytes that an array takes; samples are converted to a type of frames after all are read."""
    return head.nbytes if head.dtype in FRAME_DTYPES else 2 * head.nbytes


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, head: _Head) -> NDArray[Any]:
    with archive.open(member) as opened:
        values = _read_values(opened, head)
        if opened.read(1):
            raise ValueError(f"{member.filename} has bytes after its values")
    return values


def open_stack(
    path: Path,
    form: Format | None,
    dataset: str | None,
    channel: int | None,
    positions: Mapping[str, ArrayLike | Positions | None],
    header: Mapping[str, Any],
    motion: Motion | None,
    region: Region | None,
    frame_range: tuple[int, int | None] | None,
    memory_limit: int | None = None,
    override_motion: bool = False,
    verify: bool = True,
) -> ArrayRecording:
    """Open a stack of a format of another program, or without one of NumPy; see ``open_recording``.

    The file may contain ``travel``, ``phase``, ``displacement`` or ``twist`` of each frame, and properties
    such as ``dark`` and ``bright``. Arguments take precedence over them.
    """
    with ExitStack() as opening:
        if form is None:
            with _errors_named(path):
                check_regular(path)
                files = {path: state_of(path.stat())}
                frames, arrays = _open_array(path, dataset, memory_limit)
                rest = _rest_of(path)
            held: dict[str, Any] = {**arrays}
        else:
            if not form.has_positions:  # fail before decoding if there are none
                _motion(str(path), positions, motion)
            options = {"dataset": dataset, "channel": channel, "memory_limit": memory_limit, "verify": verify}
            frames = opening.enter_context(open_reader(path, form, **options))
            with translate_os_errors(str(path)):
                files = {file: state_of(file.stat()) for file in frames.files}
            held, rest = {**frames.positions, **frames.header}, ()
        kept = {name: value for name, value in positions.items() if value is not None}
        series = kept or {name: value for name, value in held.items() if name in POSITIONS.values()}
        stated = held.pop("motion", motion)
        if motion not in (None, stated) and not override_motion:
            raise InputError(
                f"{path} states the motion {stated}, but --motion is {motion}: leave --motion out, or correct"
                " the file"
            )
        motion = motion or (None if kept else stated)
        properties = {name: value for name, value in held.items() if name not in POSITIONS.values()}
        header = properties | {name: value for name, value in header.items() if value is not None}
        recording = ArrayRecording(frames, series, header, motion, region, frame_range, str(path), files)
        recording.findings += (*rest, *unwritten_frames(recording))
        opening.pop_all()  # the recording closes the file from now on
    return recording


def _open_array(
    path: Path, dataset: str | None, memory_limit: int | None
) -> tuple[NDArray[Any] | FrameReader, dict[str, NDArray[Any]]]:
    """Open the frames in a file of ``numpy.save`` or ``numpy.savez``, and read the other known arrays.

    A compressed archive is refused if these take more than ``memory_limit`` and ``MAX_UNPACKED_BYTES``.
    """
    if path.suffix.lower() == ".npy":
        return _open_frames(path), {}
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        members = _members(archive)
        chosen = dataset or _stack_of(path, members)
        if chosen not in members:
            raise InputError(f"{path} contains no array {chosen!r}: choose from {', '.join(members)}")
        limit = max(MAX_UNPACKED_BYTES, memory_limit or 0)
        needed = {name: member for name, member in members.items() if name in _KNOWN or name == chosen}
        held = _read_members(path, archive, needed, limit)
        return held.pop(chosen), held


def _stack_of(path: Path, names: Iterable[str]) -> str:
    """Return the name of the array of frames in an archive."""
    others = [name for name in names if name not in _KNOWN]
    if "frames" in others or len(others) == 1:
        return "frames" if "frames" in others else others[0]
    raise InputError(f"{path} contains the arrays {', '.join(names)}: choose the frames with --dataset")


def _check_names(name: str, positions: Iterable[str], header: Iterable[str]) -> None:
    """Raise InputError if a position or a property does not exist."""
    properties = [field.name for field in fields(Header) if field.name != "motion"]
    for stated, allowed in ((positions, [*POSITIONS.values()]), (header, properties)):
        if unknown := next((name for name in stated if name not in allowed), ""):
            raise InputError(unknown_argument(name, unknown, allowed, "property"))


def _pixel_size(name: str, size: Any) -> tuple[float, float] | None:
    """Return millimetres along x and y; None if they are unknown."""
    if size is None:
        return None
    lengths = as_pixel_size("pixel_size", size)
    if not all(1e-9 < length < 1e6 for length in lengths):
        raise InputError(f"{name}: pixel size {lengths} mm: give one above zero: 1e-9 to 1e6")
    return lengths


def _motion(
    name: str, positions: Mapping[str, ArrayLike | Positions | None], motion: Motion | None
) -> tuple[Motion, str]:
    """Return the motion, and the name of its position."""
    if motion is not None and motion not in MOTIONS:
        raise InputError(f"{name}: unknown motion {motion!r}: give one of {', '.join(MOTIONS)}")
    stated = [name for name, values in positions.items() if values is not None]
    fitting = [
        candidate for candidate in MOTIONS if POSITIONS[candidate] in stated and motion in (None, candidate)
    ]
    if motion is not None and not fitting:
        remedy = REMEDIES.get(POSITIONS[motion], "give it")
        raise InputError(f"{name}: {motion} motion needs the {POSITIONS[motion]} of each frame: {remedy}")
    if len(fitting) != 1:
        where = "does not state the position of the body in each frame"
        problem = f"has {' and '.join(stated)}" if stated else where
        remedy = ", or --motion" if fitting else ""
        raise InputError(f"{name} {problem}: give one of {_NEEDED}{remedy}")
    return fitting[0], POSITIONS[fitting[0]]


def _map(name: str, what: str, value: Any, shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return a reference as a map of the whole picture."""
    if value is None:
        return None
    array = as_array(what, value)
    if array.shape not in ((), shape):
        raise InputError(f"{name}: {what} has shape {array.shape}: a number, or a map {shape}, is needed")
    return np.broadcast_to(array.astype(np.float32), shape)
