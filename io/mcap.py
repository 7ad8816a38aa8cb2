"""ROS 2 messages in MCAP files: recordings and results as topics, and frames from topics."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.arguments import checked
from mirrorskin.io.atomic import MAKE_ROOM, new_file
from mirrorskin.io.export import check_heights, points_of
from mirrorskin.io.frames import FrameSequence
from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.pictures import quiet_opencv
from mirrorskin.io.positions import Positions
from mirrorskin.io.recording import Recording
from mirrorskin.io.result import Result
from mirrorskin.io.types import Block, Closing, Floats, Header, InputError

if TYPE_CHECKING:
    from mcap_ros2.writer import Writer

IMAGES = "/camera/image"
_METRE = 1e-3  # m a mm
_SECOND = 1_000_000_000  # nanoseconds
_FRAME = "sensor"  # to which coordinates belong: x right and y up in the picture, z towards the sensor
_ENCODINGS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
_COLOURS = {"rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA"}
_NAMES = {np.dtype(np.uint8): "mono8", np.dtype(np.uint16): "mono16", np.dtype(np.float32): "32FC1"}
_FLOAT32 = 7  # of a PointField
_SERIES = {"travel": _METRE, "phase": 1.0, "tilt": 1.0, "twist": 1.0}  # topics of numbers, to SI units
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CLOUD, _NUMBER, _WRENCH = (
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/Float64",
    "geometry_msgs/msg/WrenchStamped",
)
_INSTALL = "MCAP needs packages that are not installed: pip install 'mirrorskin[mcap]'"

# The fields of ROS 2's own messages.
_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
}
_HEAD, _TIMES = "std_msgs/Header header\n", ("std_msgs/Header", "builtin_interfaces/Time")
_MESSAGES = {
    _IMAGE: (
        f"{_HEAD}uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        _TIMES,
    ),
    _CLOUD: (
        f"{_HEAD}uint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        (*_TIMES, "sensor_msgs/PointField"),
    ),
    _NUMBER: ("float64 data", ()),
    _WRENCH: (
        f"{_HEAD}geometry_msgs/Wrench wrench",
        (*_TIMES, "geometry_msgs/Wrench", "geometry_msgs/Vector3"),
    ),
}


def load_writer() -> type[Writer]:
    """Return what writes messages; InputError if it is not installed."""
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise InputError(_INSTALL) from error
    return Writer


class _File:
    """Messages on their way into an MCAP file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._writer: Writer = load_writer()(stream)
        self._schemas: dict[str, Any] = {}

    def put(self, topic: str, kind: str, message: Mapping[str, Any], stamp: int) -> None:
        """Write a message of a time, nanoseconds; its header is made where it has one."""
        if kind not in self._schemas:
            text, parts = _MESSAGES[kind]
            rule = "=" * 80
            whole = "\n".join([text, *(f"{rule}\nMSG: {part}\n{_PARTS[part]}" for part in parts)])
            self._schemas[kind] = self._writer.register_msgdef(kind, whole)
        seconds, rest = divmod(stamp, _SECOND)
        head = {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": _FRAME}
        whole_message = dict(message) if kind == _NUMBER else {"header": head, **message}
        self._writer.write_message(topic, self._schemas[kind], whole_message, stamp, stamp)

    def note(self, notes: Mapping[str, Any]) -> None:
        """Add texts to the file's metadata."""
        self._writer.add_metadata("mirrorskin", {name: str(value) for name, value in notes.items()})

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]


@checked
def save_messages(given: Result | Recording, path: str | Path) -> str:
    """Write a result or a recording as ROS 2 messages in an MCAP file, which exists whole or not at all.

    Of a recording, frames are ``sensor_msgs/Image`` on ``/camera/image``, ``dark`` and ``bright`` beside them
    on ``/camera/dark`` and ``/camera/bright``, and positions ``std_msgs/Float64`` on ``/travel``, in metres,
    ``/phase``, ``/tilt`` and ``/twist``, in radians, with the stamps of their frames. Of a result, the
    surface is a ``sensor_msgs/PointCloud2`` on ``/surface`` with ``x``, ``y``, ``z``, ``sigma`` in metres
    and the normal where it is known, the heights a picture in metres on ``/height``, and a force a
    ``geometry_msgs/WrenchStamped`` on ``/force``. What else is known is in the metadata ``mirrorskin``.

    Parameters
    ----------
    given : Result or Recording
        Of frames without times, each is a second after the one before.
    path : str or Path

    Returns
    -------
    str
        What was written, in a few words.

    Raises
    ------
    InputError
        The packages of the extra ``mcap`` are missing, the result has no heights in millimetres, or the file
        cannot be written there.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.save_messages(io.open_result("coin.h5"), "coin.mcap")  # doctest: +SKIP
    '961 points'
    """
    with (
        new_file(Path(path)) as descriptor,
        as_input_error(f"{path} could not be written", MAKE_ROOM, OSError),
        os.fdopen(descriptor, "wb", closefd=False) as stream,
    ):
        file = _File(stream)
        holds = _put_result(file, given, path) if isinstance(given, Result) else _put_recording(file, given)
        file.finish()
    return holds


def _put_result(file: _File, result: Result, path: str | Path) -> str:
    check_heights(result, path)
    assert result.height is not None
    stamp = _stamp(str(result.process.get("date", "")))
    columns = points_of(result)
    unknown = np.full_like(columns["z"], np.nan)
    table = {name: columns.get(name, unknown) * _METRE for name in ("x", "y", "z", "sigma")}
    table |= {f"normal_{name}": columns[f"n{name}"] for name in "xyz" if f"n{name}" in columns}
    points = np.stack(list(table.values()), axis=1).astype("<f4")
    fields = [
        {"name": name, "offset": 4 * number, "datatype": _FLOAT32, "count": 1}
        for number, name in enumerate(table)
    ]
    cloud = {"height": 1, "width": len(points), "fields": fields, "is_bigendian": False, "is_dense": False}
    size = {"point_step": 4 * len(table), "row_step": points.nbytes, "data": points.tobytes()}
    file.put("/surface", _CLOUD, cloud | size, stamp)
    file.put("/height", _IMAGE, _picture(result.height * np.float32(_METRE)), stamp)
    if result.force is not None:
        along = {"x": result.force_x or 0.0, "y": result.force_y or 0.0, "z": result.force}
        file.put("/force", _WRENCH, {"wrench": {"force": along, "torque": dict.fromkeys("xyz", 0.0)}}, stamp)
    file.note(result.process)
    return f"{len(points)} points"


def _put_recording(file: _File, recording: Recording) -> str:
    header, count = recording.header, recording.shape[0]
    begun = _stamp(header.start_time)
    time = np.arange(count, dtype=np.float64) if recording.time is None else recording.time
    _put_header(file, header)
    recording.rewind()
    room = np.empty((1, *recording.shape[1:]), recording.dtype)
    while (block := recording.read(room)) is not None:
        stamps = _stamps(begun, time[block.index : block.index + len(block.frames)])
        _put_frames(file, block, stamps)
        for name in _SERIES:
            if getattr(block, name) is not None:
                _put_numbers(file, name, getattr(block, name), stamps)
    recording.rewind()
    without = "" if recording.time is not None else ", of unknown times: a second apart"
    return f"{count} frames of {recording.shape[2]} x {recording.shape[1]}{without}"


def _put_header(file: _File, header: Header) -> None:
    for name, picture in (("dark", header.dark), ("bright", header.bright)):
        if picture is not None:
            image = _picture(np.atleast_2d(np.asarray(picture, np.float32)))
            file.put(f"/camera/{name}", _IMAGE, image, _stamp(header.start_time))
    notes = {
        name: getattr(header, name) for name in ("motion", "title", "pixel_size", "tilt", "press", "camera")
    }
    file.note({name: value for name, value in notes.items() if value not in (None, "")})


def _put_frames(file: _File, block: Block, stamps: list[int]) -> None:
    for frame, stamp in zip(block.frames, stamps, strict=True):
        file.put(IMAGES, _IMAGE, _picture(frame), stamp)


def _put_numbers(file: _File, name: str, values: Floats, stamps: list[int]) -> None:
    for value, stamp in zip(values, stamps, strict=True):
        file.put(f"/{name}", _NUMBER, {"data": float(value) * _SERIES[name]}, stamp)


class GrowingMessages(Closing):
    """An MCAP file to which frames are appended, like a `GrowingRecording`, and maps that were found of them.

    Topics are those of ``save_messages``; positions come last, as the source has them then. Each update of
    the heights is a picture on ``/height``, and the area of contact a number on ``/contact_area``, m^2. A
    file that was cut off has no index; the program ``mcap recover`` makes one.
    """

    def __init__(self, path: Path, descriptor: int, header: Header) -> None:
        self.count: int = 0
        self._path = path
        self._begun: int | None = None  # when the source's clock began: at the first frames
        self._stream = os.fdopen(os.dup(descriptor), "wb")
        self._file = _File(self._stream)
        self._stamps: list[int] = []
        self._positions: dict[str, list[float]] = {}
        _put_header(self._file, header)

    def append(self, block: Block) -> None:
        """Write frames, and keep their positions."""
        assert block.time is not None  # frames that come live have one
        if self._begun is None:
            self._begun = time.time_ns() - round(float(block.time[-1]) * _SECOND)
        stamps = _stamps(self._begun, block.time)
        _put_frames(self._file, block, stamps)
        self._stamps += stamps
        for name in _SERIES:
            if getattr(block, name) is not None:
                self._positions.setdefault(name, []).extend(getattr(block, name).tolist())
        self.count += len(block.frames)

    def add_maps(self, time: float, height: NDArray[np.float32] | None, contact_area: float | None) -> None:
        """Write what was found of the frames up to a time: mm, mm^2."""
        assert self._begun is not None  # of frames that have come
        (stamp,) = _stamps(self._begun, np.array([time]))
        if height is not None:
            self._file.put("/height", _IMAGE, _picture(height * np.float32(_METRE)), stamp)
        if contact_area is not None:
            self._file.put("/contact_area", _NUMBER, {"data": contact_area * _METRE**2}, stamp)

    def mark(self, start: int, used: NDArray[np.bool_]) -> None:
        """Forget it: MCAP files do not tell which frames were used."""

    def flush(self) -> None:
        """Hand what is written to the system."""
        self._stream.flush()

    publish = flush

    def finish(self, positions: Mapping[str, Floats], state: str) -> None:
        """Write positions, those that came with the frames where there are no better ones, and the index."""
        for name, live in self._positions.items():
            better = np.asarray(positions.get(name, live), np.float64)[: self.count]
            values = np.where(np.isfinite(better), better, live[: len(better)])
            _put_numbers(self._file, name, values, self._stamps[: len(values)])
        self._file.note({"state": state})
        self._file.finish()
        self.flush()

    def close(self) -> None:
        """Let go of the file."""
        self._stream.close()


def _picture(values: NDArray[Any]) -> dict[str, Any]:
    rows, columns = values.shape
    data = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return {
        "height": rows,
        "width": columns,
        "encoding": _NAMES[values.dtype],
        "is_bigendian": 0,
        "step": columns * values.itemsize,
        "data": data.tobytes(),
    }


def _stamps(begun: int, time: Floats) -> list[int]:
    """Return the stamps of times, seconds since it began."""
    return [begun + round(float(one) * _SECOND) for one in time]


def _stamp(text: str) -> int:
    """Return nanoseconds since 1970 of an ISO 8601 time; 0 if it is none."""
    with contextlib.suppress(ValueError):
        when = datetime.fromisoformat(text)
        return round((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000
    return 0


class Messages(FrameSequence):
    """The images of one topic of an MCAP file of ROS 2, as a source that can be rewound.

    Grey images are taken as they are, of colours and of compressed images the luma. Positions that are not
    given are those of ``/travel`` (m) or ``/phase`` (rad), one message an image.
    """

    def __init__(
        self,
        path: str | Path,
        header: Header,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
        topic: str | None = None,
    ) -> None:
        self._path = Path(path)
        self._topic = self._choose(topic)
        times = [stamp for stamp, _ in self._messages(self._topic)]
        first = _frame(next(self._messages(self._topic))[1], str(path))
        if header.motion == "vertical" and travel is None:
            travel = self._numbers("travel", len(times))
        if header.motion == "axial" and phase is None:
            phase = self._numbers("phase", len(times))
        seconds = (np.asarray(times) - times[0]) / _SECOND
        known = seconds if len(times) == 1 or bool(np.all(np.diff(seconds) > 0)) else None
        shape = (len(times), first.shape[0], first.shape[1])
        super().__init__(str(path), header, shape, first.dtype, travel=travel, phase=phase, time=known)
        self._left = self._messages(self._topic)

    def rewind(self) -> None:
        """Go back to the first frame."""
        super().rewind()
        self._left = self._messages(self._topic)

    def _fill(self, start: int, out: NDArray[Any]) -> None:
        for number, frame in enumerate(out, start):
            picture = _frame(next(self._left)[1], f"{self.name}: {self._topic}")
            if picture.shape != frame.shape or picture.dtype != frame.dtype:
                raise InputError(
                    f"{self.name}: image {number} of {self._topic} has another size or type than the first:"
                    " cut it there"
                )
            frame[...] = picture

    def _choose(self, topic: str | None) -> str:
        """Return the topic of the images: that which was asked for, or the only one."""
        found: dict[str, str] = {
            channel.topic: schema.name
            for channel, schema in self._channels()
            if schema.name in (_IMAGE, _COMPRESSED)
        }
        if topic is None and IMAGES in found:
            return IMAGES
        if topic is None and len(found) == 1:
            return next(iter(found))
        if topic in found:
            return str(topic)
        there = ", ".join(sorted(found)) or "none"
        wrong = "name one with --topic" if topic is None else f"{topic} is none"
        raise InputError(f"{self._path}: its topics of images are {there}: {wrong}")

    def _channels(self) -> list[tuple[Any, Any]]:
        with self._reader() as reader:
            summary = reader.get_summary()
        if summary is None:
            raise InputError(f"{self._path} has no index: it is cut off; 'mcap recover' mends it")
        return [(one, summary.schemas[one.schema_id]) for one in summary.channels.values() if one.schema_id]

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic in the order of their times: nanoseconds, and what they say."""
        with self._reader() as reader:
            for _, _, message, said in reader.iter_decoded_messages(topics=[topic]):
                yield message.log_time, said

    def _numbers(self, name: str, count: int) -> Floats:
        values = [float(said.data) for _, said in self._messages(f"/{name}")]
        if len(values) != count:
            option = {"travel": "--travel-step", "phase": "--phase-step or --phases"}[name]
            raise InputError(
                f"{self._path} has {len(values)} messages on /{name} for {count} frames: give {option}"
            )
        return np.asarray(values) / _SERIES[name]

    @contextlib.contextmanager
    def _reader(self) -> Iterator[Any]:
        try:
            from mcap.reader import make_reader
            from mcap_ros2.decoder import DecoderFactory
        except ImportError as error:
            raise InputError(_INSTALL) from error
        try:
            with self._path.open("rb") as file:
                yield make_reader(file, decoder_factories=[DecoderFactory()])
        except InputError:
            raise
        except Exception as error:  # whatever damaged bytes lead the packages to
            raise InputError(
                f"{self._path} is damaged, or no MCAP of ROS 2 ({error}): copy it again"
            ) from error


def _frame(message: Any, name: str) -> NDArray[Any]:
    """Return an image as grey samples, (H, W)."""
    if not hasattr(message, "encoding"):
        with quiet_opencv() as cv2:
            picture = cv2.imdecode(
                np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
            )
        if picture is None:
            raise InputError(
                f"{name}: an image of format {message.format!r} cannot be decoded: save it as PNG or JPEG"
            )
        return np.asarray(picture)
    code, colours = _ENCODINGS.get(message.encoding, "u1"), len(_COLOURS.get(message.encoding, "Y"))
    if message.encoding not in (*_ENCODINGS, *_COLOURS):
        raise InputError(
            f"{name}: images of encoding {message.encoding!r} are not read: save them as mono8 or mono16"
        )
    kind = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    samples = np.ascontiguousarray(rows[:, : message.width * colours * kind.itemsize]).view(kind)
    frame = samples.astype(kind.newbyteorder("=")).reshape(message.height, message.width, colours)
    if colours > 1:
        with quiet_opencv() as cv2:
            return np.asarray(cv2.cvtColor(frame, getattr(cv2, f"COLOR_{_COLOURS[message.encoding]}2GRAY")))
    return frame[:, :, 0]
