"""A camera, video file or network stream, drained by a thread that never waits for a reader."""

from __future__ import annotations

import logging
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.reopened import OPEN_TIMEOUT, READ_TIMEOUT, ReopenedCamera, warn_of_other
from mirrorskin.hw.rig_file import CameraSettings
from mirrorskin.io import InputError
from mirrorskin.io.opencv import quiet_opencv

_log = logging.getLogger("mirrorskin.hw")

# OpenCV takes these from the environment only: no messages of FFmpeg's, and whole seconds for a camera.
_ENVIRONMENT = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": f"{READ_TIMEOUT:.0f}"}
_RAW = {"GREY", "Y16", "Y10", "Y12", "YUYV"}  # formats that OpenCV hands on as they are, if asked to
_GREY8, _GREY16 = b"Y800", b"Y1\0\x10"  # what FFmpeg calls the grey ones
# Tags of RGB with 48 or 64 bits a pixel, which end in that number or begin with it.
_DEEP_COLOURS = {b"RGB0", b"BGR0", b"0RGB", b"0BGR", b"RBA@", b"BRA@", b"@RBA", b"@BRA"}
_JPEG, _JPEG_END = "MJPG", b"\xff\xd9"
_FROZEN, _CHANGES = 5, 16  # pictures in a row without a changed pixel, after so many that had some
_MANUAL = 1.0  # V4L2's "manual exposure"
_EXPOSURE_UNIT = 1e-4  # seconds, V4L2's
_STALEST = 0.5  # seconds: a camera's own time that is older is not a time of this clock
_LONGEST_BACKLOG = 0.5  # seconds
_WAITED = 0.9  # of the time after which OpenCV says that there is no picture
_USUAL_RATE = 25.0  # frames a second, of what does not say
_DEVICES = Path("/dev")
_CONVERSIONS = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}


class VideoCamera(ReopenedCamera):
    """A camera that OpenCV can open, as a ``mirrorskin.hw.camera.Camera``.

    A camera of this machine (V4L2) is given the format, size, rate, exposure and gain that the settings
    ask for; what it did not take is logged as a warning. Frames are grey: as the camera sends them where
    it sends grey (8 or 16 bits) or YUYV, else the luma of the colours. Their times are the driver's where
    these are on the clock of ``time.monotonic``, else that of the arrival here.

    A file plays once at its own rate, and ends with an error that says so. Of a stream, the pictures that
    waited while it was opened are left out. A picture of another size counts as a loss, and so do five in a
    row without a changed pixel if no two were alike before.

    A camera or stream that is lost is opened again, for at most 10 s; see ``ReopenedCamera``.

    Parameters
    ----------
    settings : CameraSettings
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.
    clock : Clock
        What it waits by; OpenCV itself goes by the computer's.

    Raises
    ------
    InputError
        It is not there, cannot be opened, gives no frame within 7 s, or frames of another size or type.

    Examples
    --------
    >>> with VideoCamera(CameraSettings(source=0, size=(640, 480))) as camera:  # doctest: +SKIP
    ...     camera.take(most=8, timeout=1.0).pixels.shape
    (1, 480, 640)
    """

    def __init__(self, settings: CameraSettings, slots: int | None = None, clock: Clock = SYSTEM) -> None:
        self._source = find_source(settings.source)
        if settings.trigger is not None and self._source.kind != "device":
            raise InputError(f"{self._source.name} cannot be triggered: leave camera.trigger out")
        if settings.trigger_input is not None:
            raise InputError(
                f"{self._source.name}: its input is set by its own tools; leave trigger_input out"
            )
        self._returns = self._source.kind != "file"
        self._repeats = _Repeats()
        super().__init__(self._source.name, settings, slots, clock)
        self._start()

    def _drain(self) -> None:
        with quiet_opencv():
            super()._drain()

    def _read_until_lost(self, timeout: float) -> str:
        capture = Capture(self._source, self._settings, self.clock, timeout)
        self._opened()
        pace = _Pace(self.clock, capture.period) if self._source.kind == "file" else None
        try:
            while not self._stop.is_set():
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
                    return f"{self.name} gives the same picture again and again"
                if pace is not None:
                    self._stop.wait(pace.due(capture.position) - self.clock.now())
                    time = self.clock.now()
                self._arrived(time)
        finally:
            capture.release()
        if self._source.kind == "file":
            return f"{self.name} has ended after {self._number} frames"
        return f"{self.name} gives no picture"


class _Repeats:
    """Tells a stream that stands still from a scene that does: noise makes all pictures differ."""

    def __init__(self) -> None:
        self._last: NDArray[Any] | None = None
        self._changes = self._alike = (
            0  # pictures that differ from the one before; those in a row that do not
        )
        self._noisy = True  # no two were alike so far, but for those of this row

    def frozen(self, picture: NDArray[Any]) -> bool:
        """Take the next picture, whose memory stays as it is until the one after it was taken."""
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
    """When the pictures of a file that begins to play now are due."""

    def __init__(self, clock: Clock, period: float) -> None:
        self._clock, self._period = clock, period
        self._start: float | None = None
        self._position = 0.0

    def due(self, position: float) -> float:
        """Return when a picture is due, monotonic seconds, from its position in the file."""
        if self._start is None:
            self._start = self._clock.now() - position
        elif not position > self._position:  # some files do not say
            position = self._position + self._period
        self._position = position
        return self._start + position


class Capture:
    """One connection to a camera, a stream or a file: opened as asked, and read until it is lost."""

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
        """Wait for the next picture, and return when it arrived, monotonic seconds; None: there is none."""
        if not self._video.grab():
            return None
        now = self._clock.now()
        if self._trusts:
            # V4L2 says when the driver had it, on this clock if the driver is a good one.
            stamp = float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000
            self._trusts = now - _STALEST <= stamp <= now and stamp > self._last
            now = stamp if self._trusts else now
        self._last = max(self._last, now)
        return self._last

    def retrieve(self, out: NDArray[Any]) -> None:
        """Write the picture that was grabbed to a frame, (H, W)."""
        try:
            done, picture = self._video.retrieve(out if self._raw else self._picture)
            if self._jpeg:
                picture = _decode(picture) if done else None
        except cv2.error as error:
            raise InputError(f"{self._source.name}: a picture cannot be decoded: {error.err}") from error
        if not done or picture is None:
            raise InputError(f"{self._source.name}: a picture cannot be decoded: see camera.fourcc")
        if picture is not out:
            self._picture = picture
            to_grey(picture, out, self._source.name)

    @property
    def position(self) -> float:
        """Seconds from a file's beginning to the picture that was grabbed, as the file says."""
        return float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000

    @property
    def period(self) -> float:
        """Seconds from picture to picture, as the source declares."""
        return 1 / self._declared

    def release(self) -> None:
        """Let the source go."""
        self._video.release()

    def _skip_backlog(self) -> None:
        """Forget the pictures that waited while the stream was opened: when they were taken is not known."""
        period = 1 / (self._settings.rate or self._declared)
        begun = before = self._clock.now()
        waited = 0
        while (time := self.grab()) is not None and time - begun < _LONGEST_BACKLOG:
            # One alone can be a decoder's start.
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
        # Of several threads each holds a picture back.
        parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * timeout)]
        parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * READ_TIMEOUT), cv2.CAP_PROP_N_THREADS, 1]
    video = cv2.VideoCapture(source.target, backend, parameters)
    if not video.isOpened():
        video.release()
        why = {
            "device": "another program may be using it, or it is no camera",
            "stream": f"nothing answers there within {timeout:.3g} s that is a video",
            "file": "it is damaged, or no video",
        }
        raise InputError(f"{source.name} cannot be opened: {why[source.kind]}")
    return video


def _configure(video: Any, source: VideoSource, settings: CameraSettings) -> bool:
    """Set what is asked for, log what was not taken, and return whether pictures come as they are stored."""
    if source.kind == "device":
        _set_up(video, source, settings)
        raw = _letters(video.get(cv2.CAP_PROP_FOURCC)).strip() in _RAW
    else:
        asked = [name for name in ("fourcc", "exposure", "gain") if getattr(settings, name) is not None]
        if asked:
            _log.warning("%s: %s can only be set where it is sent from", source.name, " and ".join(asked))
        raw = _is_grey(video, source)
    _check_size(video, source, settings)
    if raw:
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return raw


def _as_jpeg(video: Any) -> bool:
    """Have the pictures of a stream of JPEGs as they were sent: OpenCV would scale those of another size."""
    return _letters(video.get(cv2.CAP_PROP_FOURCC)) == _JPEG and video.set(cv2.CAP_PROP_FORMAT, -1)


def _decode(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """Return the luma of a JPEG, (H, W), uint8; None of one that is cut short."""
    if _JPEG_END not in data[..., -64:].tobytes():  # some cameras pad
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
            f"{source.name} gives pictures of {got[0]} x {got[1]}, and {columns} x {rows} is asked for: "
            "set camera.size in the rig file to a size that the camera has"
        )


def _is_grey(video: Any, source: VideoSource) -> bool:
    """Whether FFmpeg decodes to grey of 8 or 16 bits, which needs no conversion."""
    tag = _tag(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
    # FFmpeg's tags of deeper formats end in the number of bits, or begin with it if they are big-endian.
    bits = 16 if tag in _DEEP_COLOURS else next((bits for bits in (tag[3], tag[0]) if 8 < bits <= 16), 8)
    if bits > 8 and tag != _GREY16:
        raise InputError(
            f"{source.name} has {bits} bits a sample, but only 8 would be read: send grey of 8 bits, or of 16"
            " bits in little-endian order"
        )
    return tag in (_GREY8, _GREY16)


def _letters(fourcc: float) -> str:
    return _tag(fourcc).decode("ascii", "replace").rstrip("\0")


def _tag(code: float) -> bytes:
    return (int(code) & 0xFFFFFFFF).to_bytes(4, "little")


@dataclass(frozen=True, slots=True)
class VideoSource:
    """What a rig file's ``camera.source`` means: a camera of this machine, a stream, or a file."""

    kind: Literal["device", "stream", "file"]
    target: str  # a device's path, a URL, or a file's path
    name: str  # what messages call it, without a password


def find_source(source: int | str) -> VideoSource:
    """Find a camera by its number or its path under /dev, a URL, or the path of a video file."""
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
        there = sorted(str(found) for found in _DEVICES.glob("video*"))
        raise InputError(
            f"camera {path}: there is no such device; "
            + (f"there are {', '.join(there)}" if there else "no camera is connected that Linux knows")
        )
    if not os.access(path, os.R_OK | os.W_OK):
        raise InputError(f"camera {path} may not be used: add yourself to the group 'video'")


def to_grey(picture: NDArray[Any], out: NDArray[Any], name: str) -> None:
    """Write a picture's grey to a frame.

    A grey picture is copied. Of two channels (YUYV) the first is taken, the luma as the camera sent it. BGR
    becomes the luma of ITU-R BT.601, which is exactly the one value where all three are equal, as a grey
    camera's are.
    """
    if picture.shape[:2] != out.shape or picture.dtype != out.dtype:
        raise InputError(
            f"{name} gives pictures of {_describe(picture)}, and {_describe(out)} is asked for: "
            "set camera.size, camera.dtype or camera.fourcc in the rig file so that they agree"
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
