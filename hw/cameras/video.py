"""A camera, video file or network stream, read by a thread that never waits for a reader."""

from __future__ import annotations

import logging
import math
import os
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.drivers import Driver
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras.reopened import OPEN_TIMEOUT, READ_TIMEOUT, ReopenedCamera, warn_of_other
from mirrorskin.io import InputError
from mirrorskin.io.base.opencv import quiet_opencv

VIDEO = Driver(
    name="",
    help="cameras of the system, streams and video files, by OpenCV",
    loads="VideoCamera",
    takes=("clock",),
    formats=r"(?!.{5})[!-~]{2,4} {0,2}",
    formats_help="two to four letters",
)

_log = logging.getLogger("mirrorskin.hw")

# OpenCV reads these from the environment only: silence FFmpeg, and a timeout for cameras in whole seconds.
_ENVIRONMENT = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": f"{READ_TIMEOUT:.0f}"}
_RAW = {"GREY", "Y16", "Y10", "Y12", "YUYV"}  # formats that OpenCV returns unchanged on request
_GREY8, _GREY16 = b"Y800", b"Y1\0\x10"  # FFmpeg's tags of grey formats
# Tags of RGB with 48 or 64 bits per pixel, which end or start with that number.
_DEEP_COLOURS = {b"RGB0", b"BGR0", b"0RGB", b"0BGR", b"RBA@", b"BRA@", b"@RBA", b"@BRA"}
_JPEG, _JPEG_END = "MJPG", b"\xff\xd9"
_FROZEN, _CHANGES = 5, 16  # unchanged pictures in a row that count as frozen, after this many changed ones
_MANUAL = 1.0  # V4L2's "manual exposure"
_EXPOSURE_UNIT = 1e-4  # V4L2's unit of exposure, seconds
_STALEST = 0.5  # seconds; an older time stamp of a camera is not of this clock
_LONGEST_BACKLOG = 0.5  # seconds
_WAITED = 0.9  # share of OpenCV's timeout after which a failure counts as a timeout
_USUAL_RATE = 25.0  # default frame rate
_DEVICES = Path("/dev")
_ANSWER_SIZE_MAX = 64  # bytes
EXPOSURE_PORT = "exposure_port"
"""In the URL of an emulated camera: the port that takes an exposure, seconds, and answers with that set."""

_CONVERSIONS = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}


class VideoCamera(ReopenedCamera):
    """A camera that OpenCV can open, as a ``mirrorskin.hw.Camera``.

    Format, size, rate, exposure and gain of a local camera (V4L2) are set according to the settings;
    deviations are logged as warnings. Frames are grey: unchanged if the source is grey (8 or 16 bits) or
    YUYV, otherwise the luma of the colours. Their times are the driver's if these are on the clock of
    ``time.monotonic``, otherwise those of arrival.

    A file plays once at its own rate, and then ends with an error. Pictures of a stream that waited while it
    was opened are discarded. A picture of another size counts as a loss, and so do five in a row without a
    changed pixel if no two were equal before.

    A lost camera or stream is reopened, for at most 10 s; see ``ReopenedCamera``.

    Parameters
    ----------
    settings : CameraSettings
    slots : int, optional
        Number of frames that can wait; see ``mirrorskin.hw.cameras.ring.usual_slots``.
    clock : Clock
        Clock to wait with; OpenCV uses the system's.

    Raises
    ------
    InputError
        It does not exist, cannot be opened, or delivers no frame within 7 s or frames of another size or
        type.

    Examples
    --------
    >>> with VideoCamera(CameraSettings(source=0, size=(640, 480))) as camera:  # doctest: +SKIP
    ...     camera.take(limit=8, timeout=1.0).pixels.shape
    (1, 480, 640)
    """

    def __init__(self, settings: CameraSettings, slots: int | None = None, clock: Clock = SYSTEM) -> None:
        self._source = find_source(settings.source)
        if settings.trigger is not None and self._source.kind != "device":
            raise InputError(f"{self._source.name} cannot be triggered: remove camera.trigger")
        if settings.trigger_input is not None:
            raise InputError(
                f"{self._source.name}: its trigger input must be set with its own tools; remove trigger_input"
            )
        self._returns = self._source.kind != "file"
        self._repeats = _Repeats()
        super().__init__(self._source.name, settings, slots, clock)
        self._start()

    def set_exposure(self, seconds: float, /) -> float:
        """Change the exposure of a local camera, or of an emulated one; see ``ReopenedCamera``."""
        if self._source.kind == "device":
            return super().set_exposure(seconds)
        exposure = expose_at_sender(self._source, seconds)
        if exposure is None:
            raise InputError(f"{self.name}: the exposure can only be set at the sender")
        return exposure

    def _drain(self) -> None:
        with quiet_opencv():
            super()._drain()

    def _read_until_lost(self, timeout: float) -> str:
        capture = Capture(self._source, self._settings, self.clock, timeout)
        self._opened()
        pace = _Pace(self.clock, capture.period) if self._source.kind == "file" else None
        try:
            while not self._stop.is_set():
                self._change_exposure(capture.set_exposure)
                began = self.clock.now()
                time = capture.grab()
                if time is None:
                    waited = self.clock.now() - began > _WAITED * READ_TIMEOUT
                    if waited and self._settings.trigger is not None:
                        continue
                    break
                slot = self._slot()
                capture.retrieve(slot)
                if self._repeats.frozen(slot):
                    return f"{self.name} repeats the same picture"
                if pace is not None:
                    self._stop.wait(pace.due(capture.position) - self.clock.now())
                    time = self.clock.now()
                self._arrived(time)
        finally:
            capture.release()
        if self._source.kind == "file":
            return f"{self.name} has ended after {self._number} frames"
        return f"{self.name} delivers no picture"


class _Repeats:
    """Detects a frozen stream; in a still scene, noise makes all pictures differ."""

    def __init__(self) -> None:
        self._last: NDArray[Any] | None = None
        self._changes = self._alike = 0  # number of changed pictures, and of unchanged ones in a row
        self._noisy = True  # whether no two pictures were equal before this row

    def frozen(self, picture: NDArray[Any]) -> bool:
        """Return whether the stream is frozen; a picture must stay unmodified during the next call."""
        if not self._noisy:
            return False
        if self._last is not None and all(map(np.array_equal, picture, self._last)):  # row by row
            self._alike += 1
            self._noisy = self._alike < _FROZEN or self._changes > _CHANGES
        else:
            self._noisy = self._alike == 0
            self._changes, self._alike = self._changes + 1, 0
        self._last = picture
        return self._noisy and self._alike >= _FROZEN


class _Pace:
    """The playing times of the pictures of a file."""

    def __init__(self, clock: Clock, period: float) -> None:
        self._clock, self._period = clock, period
        self._start: float | None = None
        self._position = 0.0

    def due(self, position: float) -> float:
        """Return when a picture is due, monotonic seconds, from its position in the file."""
        if self._start is None:
            self._start = self._clock.now() - position
        elif not position > self._position:  # some files have no positions
            position = self._position + self._period
        self._position = position
        return self._start + position


class Capture:
    """One connection to a camera, a stream or a file, opened with the settings, until it is lost."""

    def __init__(
        self,
        source: VideoSource,
        settings: CameraSettings,
        clock: Clock,
        timeout: float = OPEN_TIMEOUT,
    ) -> None:
        self._source, self._settings, self._clock = source, settings, clock
        self._video = _open(source, timeout)
        self._picture: NDArray[Any] | None = None
        self._trusts = source.kind == "device"
        self._last = -math.inf
        try:
            self._jpeg = source.kind != "device" and _as_jpeg(self._video)
            self._raw = _configure(self._video, source, settings) and not self._jpeg
            declared = float(self._video.get(cv2.CAP_PROP_FPS))
            self._declared = declared if math.isfinite(declared) and declared > 0 else _USUAL_RATE
            if source.kind == "stream":
                self._skip_backlog()
        except BaseException:
            self._video.release()
            raise

    def grab(self) -> float | None:
        """Wait for the next picture, and return its arrival, monotonic seconds; None if there is none."""
        if not self._video.grab():
            return None
        now = self._clock.now()
        if self._trusts:
            # V4L2 reports the time of the driver, which good drivers take from this clock.
            stamp = float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000
            self._trusts = now - _STALEST <= stamp <= now and stamp > self._last
            now = stamp if self._trusts else now
        self._last = max(self._last, now)
        return self._last

    def retrieve(self, out: NDArray[Any]) -> None:
        """Write the picture that was grabbed to a frame, (H, W)."""
        try:
            success, picture = self._video.retrieve(out if self._raw else self._picture)
            if self._jpeg:
                picture = _decode(picture) if success else None
        except cv2.error as error:
            raise InputError(f"{self._source.name}: a picture cannot be decoded: {error.err}") from None
        if not success or picture is None:
            raise InputError(f"{self._source.name}: a picture cannot be decoded: check camera.fourcc")
        if picture is not out:
            self._picture = picture
            to_grey(picture, out, self._source.name)

    def set_exposure(self, seconds: float) -> float:
        """Set the exposure of a local camera, and return the one that it has then, seconds."""
        self._video.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
        self._video.set(cv2.CAP_PROP_EXPOSURE, seconds / _EXPOSURE_UNIT)
        return float(self._video.get(cv2.CAP_PROP_EXPOSURE)) * _EXPOSURE_UNIT

    @property
    def position(self) -> float:
        """Position of the grabbed picture in a file, seconds, as the file states."""
        return float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000

    @property
    def period(self) -> float:
        """Declared period of the source, seconds."""
        return 1 / self._declared

    def release(self) -> None:
        """Close the source."""
        self._video.release()

    def _skip_backlog(self) -> None:
        """Discard the pictures that waited while the stream was opened, because their times are unknown."""
        period = 1 / (self._settings.rate or self._declared)
        begun = before = self._clock.now()
        waited = 0
        while (time := self.grab()) is not None and time - begun < _LONGEST_BACKLOG:
            # A single one may be the start of a decoder.
            waited = waited + 1 if time - before > period / 2 else 0
            if waited == 2:
                return
            before = time


def _open(source: VideoSource, timeout: float) -> Any:
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    backend, parameters = cv2.CAP_FFMPEG, []
    if source.kind == "device":
        backend = cv2.CAP_V4L2
    elif source.kind == "stream":
        # Each of several threads would delay by a picture.
        parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * timeout)]
        parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * READ_TIMEOUT), cv2.CAP_PROP_N_THREADS, 1]
    video = cv2.VideoCapture(source.target, backend, parameters)
    if not video.isOpened():
        video.release()
        why = {
            "device": "another program may be using it, or it is not a camera",
            "stream": f"no video was received within {timeout:.3g} s",
            "file": "it is damaged, or not a video",
        }
        raise InputError(f"{source.name} cannot be opened: {why[source.kind]}")
    return video


def _configure(video: Any, source: VideoSource, settings: CameraSettings) -> bool:
    """Apply the settings, log deviations, and return whether pictures are returned as stored."""
    if source.kind == "device":
        _set_up(video, source, settings)
        raw = _letters(video.get(cv2.CAP_PROP_FOURCC)).strip() in _RAW
    else:
        asked = [name for name in ("fourcc", "exposure", "gain") if getattr(settings, name) is not None]
        if settings.exposure is not None and expose_at_sender(source, settings.exposure) is not None:
            asked.remove("exposure")
        if asked:
            _log.warning("%s: %s can only be set at the sender", source.name, " and ".join(asked))
        raw = _is_grey(video, source)
    _check_size(video, source, settings)
    if raw:
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return raw


def expose_at_sender(source: VideoSource, seconds: float) -> float | None:
    """Set the exposure of an emulated camera, whose URL names a port for it; None for other senders."""
    address = urlsplit(source.target if source.kind == "stream" else "")
    ports = parse_qs(address.query).get(EXPOSURE_PORT, [])
    if address.scheme != "tcp" or not ports:
        return None
    try:
        with socket.create_connection((address.hostname or "", int(ports[0])), READ_TIMEOUT) as line:
            line.sendall(f"{seconds!r}\n".encode())
            with line.makefile("rb") as answer:
                return float(answer.readline(_ANSWER_SIZE_MAX))
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"{source.name}: the exposure could not be set: {error}") from None


def _as_jpeg(video: Any) -> bool:
    """Return the JPEGs of a stream as sent, because OpenCV would scale those of another size."""
    return _letters(video.get(cv2.CAP_PROP_FOURCC)) == _JPEG and video.set(cv2.CAP_PROP_FORMAT, -1)


def _decode(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """Return the luma of a JPEG, (H, W), uint8; None if it is truncated."""
    if _JPEG_END not in data[..., -64:].tobytes():  # some cameras append padding
        return None
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def _set_up(video: Any, source: VideoSource, settings: CameraSettings) -> None:
    """Set a camera's format, size, rate, exposure and gain, and read them back."""
    rows, columns = settings.shape
    if settings.fourcc is not None:
        video.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc.ljust(4)))
    video.set(cv2.CAP_PROP_FRAME_WIDTH, columns)
    video.set(cv2.CAP_PROP_FRAME_HEIGHT, rows)
    numbers = [
        ("rate", settings.rate, cv2.CAP_PROP_FPS, 1.0, " Hz"),
        ("exposure", settings.exposure, cv2.CAP_PROP_EXPOSURE, _EXPOSURE_UNIT, " s"),
        ("gain", settings.gain, cv2.CAP_PROP_GAIN, 1.0, ""),
    ]
    if settings.exposure is not None:
        video.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
    for _, asked, code, unit, _ in numbers:
        if asked is not None:
            video.set(code, asked / unit)
    for name, asked, code, unit, symbol in numbers:
        got = float(video.get(code)) * unit
        if asked is not None and not math.isclose(asked, got, rel_tol=0.01, abs_tol=0.5 * _EXPOSURE_UNIT):
            warn_of_other(source.name, name, asked, got, symbol)
    got_format = _letters(video.get(cv2.CAP_PROP_FOURCC))
    if settings.fourcc is not None and got_format != settings.fourcc.ljust(4):
        warn_of_other(source.name, "fourcc", settings.fourcc, got_format)


def _check_size(video: Any, source: VideoSource, settings: CameraSettings) -> None:
    rows, columns = settings.shape
    got = [int(video.get(code)) for code in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if got != [columns, rows]:
        raise InputError(
            f"{source.name} delivers pictures of {got[0]} x {got[1]}, but {columns} x {rows} was "
            "requested: set camera.size in the rig file to a size that the camera has"
        )


def _is_grey(video: Any, source: VideoSource) -> bool:
    """Return whether FFmpeg decodes to grey of 8 or 16 bits, which needs no conversion."""
    tag = _tag(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
    # FFmpeg's tags of deeper formats end with the number of bits, or start with it if they are big-endian.
    bits = 16 if tag in _DEEP_COLOURS else next((bits for bits in (tag[3], tag[0]) if 8 < bits <= 16), 8)
    if bits > 8 and tag != _GREY16:
        raise InputError(
            f"{source.name} has {bits} bits per sample, but OpenCV would read only 8: send grey "
            "with 8 bits, or with 16 bits in little-endian order"
        )
    return tag in (_GREY8, _GREY16)


def _letters(fourcc: float) -> str:
    return _tag(fourcc).decode("ascii", "replace").rstrip("\0")


def _tag(code: float) -> bytes:
    return (int(code) & 0xFFFFFFFF).to_bytes(4, "little")


@dataclass(frozen=True, slots=True)
class VideoSource:
    """The meaning of ``camera.source`` in a rig file: a local camera, a stream, or a file."""

    kind: Literal["device", "stream", "file"]
    target: str  # path of a device or a file, or a URL
    name: str  # name in messages, without a password


def find_source(source: int | str) -> VideoSource:
    """Return the source for a camera's number, a path under /dev, a URL, or the path of a video file."""
    text = str(source)
    if re.fullmatch(r"\d+", text):
        text = str(_DEVICES / f"video{text}")
    if Path(text).is_relative_to(_DEVICES):
        _check_device(Path(text))
        return VideoSource("device", text, f"camera {text}")
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+://", text):
        return VideoSource("stream", text, f"camera {re.sub('//[^/]*@', '//', text)}")
    if not Path(text).is_file():
        raise InputError(f"camera {text}: there is no such file; give a camera's number, a URL or a video")
    return VideoSource("file", str(Path(text).absolute()), f"camera {text}")


def _check_device(path: Path) -> None:
    if not path.exists():
        devices = sorted(str(path) for path in _DEVICES.glob("video*"))
        raise InputError(
            f"camera {path}: there is no such device; "
            + (f"available: {', '.join(devices)}" if devices else "Linux reports no camera")
        )
    if not os.access(path, os.R_OK | os.W_OK):
        raise InputError(f"no permission to use camera {path}: add yourself to the group 'video'")


def to_grey(picture: NDArray[Any], out: NDArray[Any], name: str) -> None:
    """Write the grey values of a picture to a frame.

    A grey picture is copied. Of two channels (YUYV) the first, the luma, is used. BGR is converted to the
    luma of ITU-R BT.601, which is exactly the common value if all three are equal.
    """
    if picture.shape[:2] != out.shape or picture.dtype != out.dtype:
        raise InputError(
            f"{name} delivers pictures of {_describe(picture)}, but {_describe(out)} was "
            "requested: set camera.size, camera.dtype or camera.fourcc in the rig file so that "
            "they agree"
        )
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if channels in _CONVERSIONS:
        cv2.cvtColor(picture, _CONVERSIONS[channels], dst=out)
    elif picture.ndim == 2:
        np.copyto(out, picture)
    else:
        np.copyto(out, picture[..., 0])


def _describe(picture: NDArray[Any]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]} {picture.dtype}"
