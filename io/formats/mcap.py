"""ROS 2 messages in MCAP files: recordings and results as topics, and frames read from topics."""

from __future__ import annotations

import contextlib
import os
import re
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.arguments import check_path, checked
from mirrorskin.io.base.checksums import REMEDY, crc32
from mirrorskin.io.base.content import CONVERT_BAG, identified, packed_by
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import is_coloured, to_grey
from mirrorskin.io.base.system import (
    MAX_UNPACKED_BYTES,
    check_unpacked,
    open_regular,
    read_text,
    translate_os_errors,
)
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import MOTIONS, PROPERTIES, Block, Closing, Floats, Header, InputError
from mirrorskin.io.formats.pictures import Picture, decode_bytes
from mirrorskin.io.formats.registry import Format, marks_folder
from mirrorskin.io.formats.surface import check_heights, points_of
from mirrorskin.io.model.frames import (
    CONVERTED_COLOUR,
    FrameReader,
    JoinedFrames,
    WholeFrames,
    lost_frames,
    part_of_several,
)
from mirrorskin.io.model.result import Result
from mirrorskin.io.storage.atomic import MAKE_ROOM, new_file
from mirrorskin.io.storage.existing import SURFACE_TOPIC

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, ChunkIndex, Message
    from mcap_ros2.writer import Writer

    from mirrorskin.io.files.recording import Recording

MCAP = Format(
    name="MCAP",
    suffixes=(".mcap",),
    source="MCAP",
    reader="open_messages",
    folder_mark=("metadata.yaml", b"rosbag2_bagfile_information"),
    takes=("dataset", "channel", "verify"),
    content="ROS 2 messages",
    encoder="save_messages",
    writes_itself=True,
    of_recordings=True,
    recorder="GrowingMessages",
    extra="mcap",
    exported=(
        (
            "`.mcap`",
            "[ROS 2 messages](#ros-2-messages)",
            "metres, the ROS convention",
            "no point, NaN",
            "not marked",
            "ROS 2, Foxglove, PlotJuggler",
        ),
    ),
)


IMAGES = "/camera/image"
_METRE = 1e-3  # m per mm
_SECOND = 1_000_000_000  # nanoseconds
_FRAME = "sensor"  # coordinate frame: x right and y up in the picture, z towards the sensor
_ENCODINGS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
# Indices of blue, green, red and opacity.
_COLOURS = {"rgb8": [2, 1, 0], "bgr8": [0, 1, 2], "rgba8": [2, 1, 0, 3], "bgra8": [0, 1, 2, 3]}
_NAMES = {np.dtype(np.uint8): "mono8", np.dtype(np.uint16): "mono16", np.dtype(np.float32): "32FC1"}
_FLOAT32 = 7  # datatype of a PointField
_SERIES = {"travel": _METRE, "phase": 1.0, "tilt": 1.0, "twist": 1.0}  # topics, with factors to SI units
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CLOUD, _NUMBER, _WRENCH = (
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/Float64",
    "geometry_msgs/msg/WrenchStamped",
)
_INSTALL = "MCAP needs packages that are not installed: pip install 'mirrorskin[mcap]'"

_NUMBERS = ("tilt", "press", *PROPERTIES)  # numbers of a recording, in the metadata
_NOTES, _MOST_NOTES = "mirrorskin", 8  # name of the metadata; maximum number of its records to read
# The names in the list of a bag's metadata, of YAML; its other entries have another form.
_BAG_FILES = re.compile(r"^ *relative_file_paths:[ \t]*\n((?: *- *[^\n:]+\n?)+)", re.MULTILINE)
_NUMERAL = re.compile(r"[-+]?[0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?")
_QUOTED_MAX = 100  # characters quoted of an error message of a package
_COPIES = 6  # of a chunk with one image that exist at the same time: packed, unpacked, message, image, frame
_MOST_PACKED = 255  # largest compression ratio accepted for all chunks of a file, the limit of LZ4

# From the file format (https://mcap.dev/spec): opcode and length, then the fields.
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_HEADER_BYTES = 12  # bytes of a header in CDR: encapsulation, seconds and nanoseconds
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _FOOTER_CODE = struct.Struct("<BQQQI8s"), 2

# The fields of standard ROS 2 messages.
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
    _COMPRESSED: (f"{_HEAD}string format\nuint8[] data", _TIMES),
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
    """Return the class that writes messages; InputError if it is not installed."""
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise InputError(_INSTALL) from None
    return Writer


def _definition(kind: str) -> str:
    """Return the definition of a message type and of the types it contains."""
    text, parts = _MESSAGES[kind]
    rule = "=" * 80
    return "\n".join([text, *(f"{rule}\nMSG: {part}\n{_PARTS[part]}" for part in parts)])


class _File:
    """Writer of messages to an MCAP file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._writer: Writer = load_writer()(stream)
        self._schemas: dict[str, Any] = {}

    def put(self, topic: str, kind: str, message: Mapping[str, Any], stamp: int) -> None:
        """Write a message with a time stamp in nanoseconds; the header is added if the type has one."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_msgdef(kind, _definition(kind))
        seconds, rest = divmod(stamp, _SECOND)
        head = {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": _FRAME}
        whole_message = dict(message) if kind == _NUMBER else {"header": head, **message}
        self._writer.write_message(topic, self._schemas[kind], whole_message, stamp, stamp)

    def note(self, notes: Mapping[str, Any]) -> None:
        """Add texts to the file's metadata."""
        self._writer.add_metadata(_NOTES, {name: one_line(value) for name, value in notes.items()})

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]


@checked(path=check_path)
def save_messages(source: Result | Recording, path: str | Path) -> str:
    """Write a result or a recording as ROS 2 messages to an MCAP file, which appears complete or not at all.

    For a recording, the frames are ``sensor_msgs/Image`` on ``/camera/image``, ``dark`` and ``bright`` are on
    ``/camera/dark`` and ``/camera/bright``, and positions are ``std_msgs/Float64`` on ``/travel``, in metres,
    ``/phase``, ``/tilt`` and ``/twist``, in radians, with the time stamps of their frames. For a result, the
    surface is a ``sensor_msgs/PointCloud2`` on ``/surface`` with ``x``, ``y``, ``z``, ``sigma`` in metres and
    the normal if there is one, the heights are an image in metres on ``/height``, and a force is a
    ``geometry_msgs/WrenchStamped`` on ``/force``. Other properties are in the metadata ``mirrorskin``.

    Parameters
    ----------
    source : Result or Recording
        Frames without times are stamped one second apart.
    path : str or Path

    Returns
    -------
    str
        Description of what was written.

    Raises
    ------
    InputError
        The packages of the extra ``mcap`` are missing, the result has no heights in millimetres, or the file
        cannot be written.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.save_messages(io.open_result("coin.h5"), "coin.mcap")  # doctest: +SKIP
    '961 points'
    """
    with (
        new_file(Path(path)) as descriptor,
        translate_os_errors(f"{path} could not be written", MAKE_ROOM, OSError),
        os.fdopen(descriptor, "wb", closefd=False) as stream,
    ):
        file = _File(stream)
        holds = (
            _put_result(file, source, path) if isinstance(source, Result) else _put_recording(file, source)
        )
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
    file.put(SURFACE_TOPIC, _CLOUD, cloud | size, stamp)
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
    buffer = np.empty((1, *recording.shape[1:]), recording.dtype)
    while (block := recording.read(buffer)) is not None:
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
    names = ("motion", "title", "pixel_size", "camera", *_NUMBERS)
    notes = {name: getattr(header, name) for name in names}
    file.note({name: value for name, value in notes.items() if value not in (None, "")})


def _put_frames(file: _File, block: Block, stamps: list[int]) -> None:
    for frame, stamp in zip(block.frames, stamps, strict=True):
        file.put(IMAGES, _IMAGE, _picture(frame), stamp)


def _put_numbers(file: _File, name: str, values: Floats, stamps: list[int]) -> None:
    for value, stamp in zip(values, stamps, strict=True):
        file.put(f"/{name}", _NUMBER, {"data": float(value) * _SERIES[name]}, stamp)


class GrowingMessages(Closing):
    """An MCAP file to which frames, like to a `GrowingRecording`, and computed maps are appended.

    Topics are named as in ``save_messages``; the final positions of the source are written at the end. Each
    update of the heights is an image on ``/height``, and the contact area is a number on ``/contact_area``,
    m^2. An incomplete file has no index; the program ``mcap recover`` creates it.
    """

    @staticmethod
    def check_installed() -> None:
        """Raise InputError if a package is missing, before hardware moves."""
        load_writer()

    def __init__(self, path: Path, descriptor: int, header: Header) -> None:
        self.count: int = 0
        self._path = path
        self._begun: int | None = None  # start of the source's clock, set with the first frames
        self._stream = os.fdopen(os.dup(descriptor), "wb")
        self._file = _File(self._stream)
        self._stamps: list[int] = []
        self._positions: dict[str, list[float]] = {}
        _put_header(self._file, header)

    def append(self, block: Block) -> None:
        """Write frames, and store their positions."""
        assert block.time is not None  # live frames have times
        if self._begun is None:
            self._begun = time.time_ns() - round(float(block.time[-1]) * _SECOND)
        stamps = _stamps(self._begun, block.time - block.lateness)
        _put_frames(self._file, block, stamps)
        self._stamps += stamps
        for name in _SERIES:
            if getattr(block, name) is not None:
                self._positions.setdefault(name, []).extend(getattr(block, name).tolist())
        self.count += len(block.frames)

    def add_maps(self, time: float, height: NDArray[np.float32] | None, contact_area: float | None) -> None:
        """Write the maps computed from the frames up to a time: mm, mm^2."""
        assert self._begun is not None  # frames have been written
        (stamp,) = _stamps(self._begun, np.array([time]))
        if height is not None:
            self._file.put("/height", _IMAGE, _picture(height * np.float32(_METRE)), stamp)
        if contact_area is not None:
            self._file.put("/contact_area", _NUMBER, {"data": contact_area * _METRE**2}, stamp)

    def mark(self, start: int, used: NDArray[np.bool_]) -> None:
        """Do nothing: MCAP files do not store which frames were used."""

    def flush(self) -> None:
        """Pass written data to the operating system."""
        self._stream.flush()

    publish = flush

    def finish(self, positions: Mapping[str, Floats], state: str) -> None:
        """Write the index, and the positions: the corrected ones, or those stored with the frames."""
        for name, live in self._positions.items():
            better = np.asarray(positions.get(name, live), np.float64)[: self.count]
            values = np.where(np.isfinite(better), better, live[: len(better)])
            _put_numbers(self._file, name, values, self._stamps[: len(values)])
        self._file.note({"state": state})
        self._file.finish()
        self.flush()

    def close(self) -> None:
        """Close the file, after synchronising it to the disk."""
        with self._stream:
            self._stream.flush()
            os.fsync(self._stream.fileno())


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
    """Return the time stamps of times in seconds since the start."""
    return [begun + round(float(seconds) * _SECOND) for seconds in time]


def _stamp(text: str) -> int:
    """Return an ISO 8601 time in nanoseconds since 1970; 0 if it is invalid."""
    with contextlib.suppress(ValueError):
        when = datetime.fromisoformat(text)
        return round((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000
    return 0


def open_messages(
    path: Path, dataset: str | None = None, channel: int | None = None, verify: bool = True
) -> FrameReader:
    """Open the images of one topic of a ROS 2 MCAP file, or of all files of a bag's folder.

    A file that is one of several in a bag has a finding.
    """
    if not path.is_dir():
        frames = MessageFrames(path, dataset, channel, verify)
        names = [file.name for file in _files_of_bag(path.parent)] if marks_folder(MCAP, path.parent) else []
        if len(names) > 1 and path.name in names:
            frames.findings += (part_of_several(path.name, names, f"the folder {path.parent}"),)
        return frames
    files = _files_of_bag(path)
    if not files:
        others = sorted(file for file in path.iterdir() if file.is_file())
        kind = next((f", but {text}" for file in others if (text := identified(file))), "")
        raise InputError(f"{path} is the folder of a bag without .mcap{kind}")
    if missing := next((file for file in files if not file.is_file()), None):
        raise InputError(f"{missing} is missing, which the bag's metadata list: copy it there")
    with ExitStack() as opening:
        parts = [opening.enter_context(MessageFrames(file, dataset, channel, verify)) for file in files]
        whole = parts[0] if len(parts) == 1 else JoinedFrames(parts, list(map(str, files)))
        opening.pop_all()  # the reader closes the files from now on
    return whole


def _files_of_bag(folder: Path) -> list[Path]:
    """Return the MCAP files of a bag, in the order of its ``metadata.yaml``, or those that are there."""
    text = read_text(folder / MCAP.folder_mark[0])
    listed = _BAG_FILES.search(text)
    names = [] if listed is None else [name.strip(" -'\"") for name in listed[1].split("\n")]
    files = [folder / Path(name).name for name in names if name.lower().endswith(".mcap")]
    return files or sorted(file for file in folder.glob("*.mcap") if file.is_file())


class MessageFrames(WholeFrames):
    """The images of one topic of a ROS 2 MCAP file.

    Grey images are used unchanged; colours become grey as in ``to_grey``. ``positions`` are read from
    ``/travel`` (m), ``/phase`` and ``/twist`` (rad), if there is one message per image. ``time`` is the time
    stamp in the header of each image, relative to the first, or its log time if these do not increase. A jump
    of the messages' sequence numbers is a gap of lost frames.

    Parameters
    ----------
    path : Path
    dataset : str, optional
        Topic of the images, if the file has more than one.
    channel : int, optional
        Colour to read: 0 red, 1 green, 2 blue; by default luma.
    verify : bool, optional
        Whether chunks are compared with the checksums in the file.
    """

    how = "message by message"

    def __init__(
        self, path: Path, dataset: str | None = None, channel: int | None = None, verify: bool = True
    ) -> None:
        self._path, self.files, self._channel, self._verify = path, (path,), channel, verify
        self._summary = self._read_summary()
        self._known: dict[str, _Stamps] = {}
        self._topic = self._choose(dataset)
        stamps = self._stamps_of(self._topic)
        count = len(stamps.times)
        if not count:
            raise InputError(f"{path}: {self._topic} has no messages: name another topic with --dataset")
        self._left, self._next = self._messages(self._topic), 0
        first = self._picture()
        frame = to_grey(first.samples, str(path), channel)
        self.shape, self.dtype = (count, *frame.shape), frame.dtype
        order = np.argsort(stamps.times, kind="stable")
        self.time = next(
            (
                (times - times[0]) / _SECOND
                for times in (stamps.stamps[order], stamps.times[order])
                if bool(np.all(times[1:] > times[:-1]))
            ),
            None,
        )
        self.start = int(stamps.times[order][0])
        self.lost = _lost(stamps.numbers[order])
        self.positions = dict(self._numbers(count))
        self.header = dict(self._properties(frame.shape))
        findings = [finding for finding in first.findings if channel is None or finding.kind != "colour"]
        listed = sum(n for number, n in self._summary.counts.items() if self._is_of(number, self._topic))
        if listed not in (0, count):
            text = (
                f"its index lists {listed} messages of {self._topic}, and it contains {count}: these are read"
            )
            findings.append(Finding("number of frames", text))
        self.findings = (*lost_frames(self.lost), *findings)

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode images, from the current one on or from the first."""
        if start < self._next:
            self._left, self._next = self._messages(self._topic), 0
        while self._next < start:
            with self._errors_named():
                next(self._left)
            self._next += 1
        while self._next < stop:
            name = f"{self._path}: {self._topic}, message {self._next}"
            yield name, to_grey(self._picture().samples, name, self._channel)

    def _picture(self) -> Picture:
        """Decode the next image."""
        number, self._next = self._next, self._next + 1
        with self._errors_named():
            return _decode(next(self._left), f"{self._path}: {self._topic}, message {number}")

    def _choose(self, topic: str | None) -> str:
        """Return the topic of the images: the requested one, or the only one."""
        topics = {
            channel.topic
            for channel in self._summary.channels.values()
            if channel.kind in (_IMAGE, _COMPRESSED)
        }
        if topic is None and IMAGES in topics:
            return IMAGES
        if topic is None and len(topics) == 1:
            return next(iter(topics))
        if topic in topics:
            return str(topic)
        if not topics and self._summary.others:
            raise InputError(
                f"{self._path} has messages of the encoding {', '.join(sorted(self._summary.others))}, and"
                f" none of ROS 2 (cdr): convert a bag of ROS 1 with {CONVERT_BAG.format('NAME.bag')}, and"
                " others to sensor_msgs/msg/Image"
            )
        names = ", ".join(sorted(topics)) or "none"
        wrong = "name one with --dataset" if topic is None else f"{topic} is not one of them"
        raise InputError(f"{self._path}: its topics of images are {names}: {wrong}")

    def _numbers(self, count: int) -> Iterator[tuple[str, Floats]]:
        """Yield the positions that the file contains for each image."""
        topics = {channel.topic for channel in self._summary.channels.values() if channel.kind == _NUMBER}
        for name in ("travel", "phase", "twist"):
            if f"/{name}" in topics and len(self._stamps_of(f"/{name}").times) == count:
                with self._errors_named():
                    values = [float(message.data) for message in self._messages(f"/{name}")]
                yield name, np.asarray(values) / _SERIES[name]

    def _properties(self, shape: tuple[int, ...]) -> Iterator[tuple[str, Any]]:
        """Yield the properties of a recording that was exported; see ``save_messages``."""
        for name in ("title", "camera"):
            if name in self._summary.notes:
                yield name, self._summary.notes[name]
        if self._summary.notes.get("motion") in MOTIONS:
            yield "motion", self._summary.notes["motion"]
        for name, count in {**dict.fromkeys(_NUMBERS, 1), "pixel_size": 2}.items():
            values = _NUMERAL.findall(self._summary.notes.get(name, ""))
            if len(values) == count:
                yield name, tuple(map(float, values)) if count > 1 else float(values[0])
        images = {channel.topic for channel in self._summary.channels.values() if channel.kind == _IMAGE}
        for name in ("dark", "bright"):
            topic = f"/camera/{name}"
            if topic in images and self._topic == IMAGES:
                with self._errors_named():
                    frames = [
                        to_grey(_decode(message, topic).samples, topic) for message in self._messages(topic)
                    ]
                if len(frames) == 1 and frames[0].shape in (shape, (1, 1)):
                    yield name, frames[0] if frames[0].shape == shape else frames[0][0, 0]

    def _stamps_of(self, topic: str) -> _Stamps:
        """Return the times and sequence numbers of the messages of a topic, in the order of storage."""
        if topic not in self._known:
            with self._errors_named():
                stamps = [
                    (record.log_time, record.sequence, _stamp_in(record.data))
                    for record in self._stored(topic)
                ]
                packed = packed_by(next(iter(self._stored(topic))).data) if stamps else ""
            if packed:
                raise InputError(
                    f"{self._path}: each message is compressed by {packed}, which is not supported: convert"
                    f" the bag with {CONVERT_BAG.format(self._path.parent)}"
                )
            self._known[topic] = _Stamps(*np.array(stamps, np.uint64).reshape(-1, 3).T)
        return self._known[topic]

    def _messages(self, topic: str) -> Iterator[Any]:
        """Yield the messages of a topic in the order of their times, decoded."""
        times, stored = self._stamps_of(topic).times, self._stored(topic)
        if np.any(times[1:] < times[:-1]):
            stored = iter(sorted(self._hold(topic), key=lambda record: record.log_time))
        decoders = {name: _decoder(name) for name in _MESSAGES}
        for message in stored:
            yield decoders[self._summary.channels[message.channel_id].kind](message.data)

    def _is_of(self, number: int, topic: str) -> bool:
        """Return whether a channel has messages of a topic that are read."""
        channel = self._summary.channels.get(number)
        return channel is not None and channel.topic == topic and bool(channel.kind)

    def _hold(self, topic: str) -> Iterator[Message]:
        """Yield all messages of a topic, if they fit into memory."""
        size = 0
        for message in self._stored(topic):
            size += len(message.data)
            unsorted = f"{self._path}: {topic}, whose messages are not stored in the order of their times,"
            check_unpacked(size, unsorted, "sort it with 'mcap sort'")
            yield message

    def _stored(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic in the order of storage."""
        from mcap.records import Chunk, Message

        channels = {number for number in self._summary.channels if self._is_of(number, topic)}
        total = count = 0
        with open_regular(self._path) as file:
            limit = max(MAX_UNPACKED_BYTES, _MOST_PACKED * os.fstat(file.fileno()).st_size)
            for record in self._records(file, channels):
                if isinstance(record, Message) and record.channel_id in channels:
                    yield record
                    count += 1
                if isinstance(record, Chunk):
                    data, crc = _unpack(record), record.uncompressed_crc
                    del record  # before messages are copied
                    total += len(data)
                    check_unpacked(total, f"{self._path}, unpacked,", "repack it with 'mcap compress'", limit)
                    if self._verify and crc not in (0, crc32(data)):  # 0: unknown
                        what = f"the chunk that begins with message {count} of {topic}"
                        raise InputError(f"{self._path}: {what} differs from what was recorded: {REMEDY}")
                    for message in _messages_in(data, channels):
                        yield message
                        count += 1

    def _records(self, file: BufferedReader, channels: set[int]) -> Iterator[Any]:
        """Yield the chunks that contain messages of some channels; without an index, all records."""
        from mcap.stream_reader import StreamReader

        limit = MAX_UNPACKED_BYTES // _COPIES
        if not self._summary.chunks:
            yield from StreamReader(file, emit_chunks=True, record_size_limit=limit).records
        for chunk in sorted(self._summary.chunks, key=lambda part: part.chunk_start_offset):
            if not chunk.message_index_offsets or channels & chunk.message_index_offsets.keys():
                file.seek(chunk.chunk_start_offset)
                yield next(iter(StreamReader(file, skip_magic=True, emit_chunks=True).records))

    def _index_start(self, file: BufferedReader) -> int:
        """Return where the index starts, from the end of a file with the first bytes of MCAP."""
        if file.read(len(_MAGIC)) != _MAGIC:
            if kind := identified(self._path):
                raise InputError(f"{self._path} is not an MCAP file, but {kind}")
            raise ValueError("its first bytes are not those of MCAP")
        file.seek(-_FOOTER.size, os.SEEK_END)
        code, _, start, *_ = _FOOTER.unpack(file.read(_FOOTER.size))
        if code != _FOOTER_CODE or not start:
            raise InputError(f"{self._path} has no index: it is cut off; 'mcap recover' makes one")
        return int(start)

    def _read_summary(self) -> _Summary:
        """Read the channels and chunks from the file's index."""
        try:
            from mcap.records import Channel, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
            from mcap.stream_reader import StreamReader
        except ImportError:
            raise InputError(_INSTALL) from None
        schemas: dict[int, str] = {}
        summary, notes = _Summary({}, [], {}, {}, set()), list[int]()
        with self._errors_named(), open_regular(self._path) as file:
            file.seek(self._index_start(file))
            for record in StreamReader(file, skip_magic=True, emit_chunks=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    summary.take_channel(record, schemas.get(record.schema_id, ""))
                elif isinstance(record, Statistics):
                    summary.counts.update(record.channel_message_counts)
                elif isinstance(record, ChunkIndex):
                    summary.chunks.append(record)
                elif isinstance(record, MetadataIndex) and record.name == _NOTES:
                    notes.append(record.offset)
            for offset in notes[:_MOST_NOTES]:
                file.seek(offset)
                note = next(iter(StreamReader(file, skip_magic=True).records))
                if isinstance(note, Metadata):
                    summary.notes.update(note.metadata)
        return summary

    @contextlib.contextmanager
    def _errors_named(self) -> Iterator[None]:
        """Convert the packages' errors for damaged bytes to a one-line error that names the file."""
        try:
            yield
        except (InputError, ImportError):
            raise
        except Exception as error:  # of many types
            text = one_line(error) or type(error).__name__
            raise InputError(
                f"{self._path} is damaged, or not an MCAP file of ROS 2 ({text[:_QUOTED_MAX]}): copy it again"
            ) from error


class _Stamps(NamedTuple):
    times: NDArray[np.uint64]  # nanoseconds, when a message was logged
    numbers: NDArray[np.uint64]  # sequence numbers; 0 if the writer does not count
    stamps: NDArray[np.uint64]  # nanoseconds, in the header of an image


class _Channel(NamedTuple):
    topic: str
    kind: str  # name of its message type; empty if it is not read


class _Summary(NamedTuple):
    channels: dict[int, _Channel]
    chunks: list[ChunkIndex]
    notes: dict[str, str]  # metadata of this program
    counts: dict[int, int]  # messages of each channel, by the index
    others: set[str]  # encodings of messages that are not read

    def take_channel(self, channel: Channel, kind: str) -> None:
        """Add a channel, whose messages are of a kind."""
        if channel.message_encoding == "cdr":
            self.channels[channel.id] = _Channel(channel.topic, kind if kind in _MESSAGES else "")
        else:
            self.others.add(one_line(channel.message_encoding))


def _unpack(chunk: Chunk) -> bytes:
    """Return the records of a chunk, which must have the stated length; see ``MAX_UNPACKED_BYTES``."""
    size = chunk.uncompressed_size
    check_unpacked(_COPIES * size, "a chunk", "repack the file in smaller chunks with 'mcap compress'")
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"a chunk is compressed by {chunk.compression!r}")
    if len(data) != size:
        raise ValueError(f"a chunk states {size} bytes and has another number")
    return data


def _messages_in(records: bytes, channels: set[int]) -> Iterator[Message]:
    """Yield the messages of some channels in a chunk."""
    from mcap.opcode import Opcode
    from mcap.records import Message

    at = 0
    while at < len(records):
        code, size = _RECORD.unpack_from(records, at)
        start, at = at + _RECORD.size, at + _RECORD.size + size
        if at > len(records):
            raise ValueError("a record is longer than its chunk")
        if code == Opcode.MESSAGE and size >= _MESSAGE.size:
            number, sequence, logged, published = _MESSAGE.unpack_from(records, start)
            data = records[start + _MESSAGE.size : at]
            if number in channels:
                yield Message(number, logged, data, published, sequence)


def _stamp_in(data: bytes) -> int:
    """Return the time stamp of a message that begins with a header, in nanoseconds; 0 if it has none."""
    if len(data) < _HEADER_BYTES:
        return 0
    seconds, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(max(0, seconds) * _SECOND + rest)


def _decoder(kind: str) -> Callable[[bytes], Any]:
    """Return the decoder of a ROS 2 message type from its standard definition, not from the file's."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(data=_definition(kind).encode(), encoding="ros2msg", id=1, name=kind)
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder


def _lost(numbers: NDArray[np.uint64]) -> NDArray[np.int32]:
    """Return the frames lost before each message, if sequence numbers count the messages of the topic."""
    missing = np.concatenate([[0], np.diff(numbers.astype(np.int64)) - 1])
    counted = bool(np.all(missing >= 0)) and missing.sum() <= len(numbers)
    return (missing if counted else np.zeros(len(numbers))).astype(np.int32)


def _decode(message: Any, name: str) -> Picture:
    """Return an image: grey, or blue, green, red and opacity."""
    compressed = not hasattr(message, "encoding")
    encoding = message.format.partition(";")[0].strip() if compressed else message.encoding
    if encoding.startswith("bayer_") or not (compressed or encoding in (*_ENCODINGS, *_COLOURS)):
        raise InputError(f"{name}: encoding {encoding!r} is not supported: save images as mono8 or mono16")
    data = bytes(message.data)
    if not data or (not compressed and not (message.height and message.width)):
        raise InputError(f"{name}: the image has no pixels: remove it")
    if compressed:
        return decode_bytes(data, name)
    code, order = _ENCODINGS.get(encoding, "u1"), _COLOURS.get(encoding, [0])
    kind = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    needed = message.width * len(order) * kind.itemsize
    step = message.step
    if step < needed and len(data) == needed * message.height:
        step = needed
    if step < needed or len(data) < step * (message.height - 1) + needed:
        raise InputError(
            f"{name}: {len(data)} bytes in steps of {message.step} are not {message.width} x {message.height}"
            f" pixels of {encoding}: correct its step, width and height"
        )
    shape = message.height, message.width, len(order)
    stored = np.ndarray(shape, kind, data, strides=(step, len(order) * kind.itemsize, kind.itemsize))
    samples = stored[..., 0] if len(order) == 1 else stored[..., order]
    samples = samples.astype(kind.newbyteorder("="), copy=False)
    if len(order) == 1:
        return Picture(samples)
    return Picture(samples, (CONVERTED_COLOUR,) if is_coloured(samples) else ())
