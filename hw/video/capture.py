"""One connection to a camera, a stream or a file: opened with what was asked, and read until it is lost."""

from __future__ import annotations

import logging
import math
import os
import time as clock
from typing import Any

import cv2
from numpy.typing import NDArray

from mirrorskin.hw.settings import CameraSettings
from mirrorskin.hw.video.grey import to_grey
from mirrorskin.hw.video.source import VideoSource
from mirrorskin.io import InputError

OPEN_TIMEOUT = 5.0
"""Seconds that a stream has for its opening."""
READ_TIMEOUT = 2.0
"""Seconds without a picture after which a stream or camera counts as lost."""

_log = logging.getLogger("mirrorskin.hw")

# OpenCV takes these from the environment only: no messages of FFmpeg's, and whole seconds for a camera.
_ENVIRONMENT = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": f"{READ_TIMEOUT:.0f}"}
_RAW = {"GREY", "Y16", "Y10", "Y12", "YUYV"}  # formats that OpenCV hands on as they are, if told to
_GREY8, _GREY16 = b"Y800", b"Y1\0\x10"  # what FFmpeg calls the grey ones
_MANUAL = 1.0  # V4L2's "manual exposure"
_EXPOSURE_UNIT = 1e-4  # seconds, V4L2's
_STALEST = 0.5  # seconds: a camera's own time that is older is not a time of this clock
_LONGEST_BACKLOG = 0.5  # seconds
_USUAL_RATE = 25.0  # frames a second, of what does not say


class Capture:
    """A camera, stream or file that is open.

    Parameters
    ----------
    source : VideoSource
    settings : CameraSettings
    timeout : float
        Seconds that a stream may take to open.

    Raises
    ------
    InputError
        It cannot be opened, or not with the size that is asked for.
    """

    def __init__(self, source: VideoSource, settings: CameraSettings, timeout: float = OPEN_TIMEOUT) -> None:
        self._source, self._settings = source, settings
        self._video = _open(source, timeout)
        self._picture: NDArray[Any] | None = None
        self._trusts = source.kind == "device"
        self._last = -math.inf
        try:
            self._raw = _configure(self._video, source, settings)
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
        now = clock.monotonic()
        if self._trusts:
            # V4L2 tells when the driver had it, on this clock if the driver is a good one.
            stamp = float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000
            self._trusts = now - _STALEST <= stamp <= now and stamp > self._last
            now = stamp if self._trusts else now
        self._last = max(self._last, now)
        return self._last

    def retrieve(self, out: NDArray[Any]) -> None:
        """Write the picture that was grabbed to a frame, (H, W).

        Raises
        ------
        InputError
            It has another size or type, or cannot be decoded.
        """
        try:
            done, picture = self._video.retrieve(out if self._raw else self._picture)
        except cv2.error as error:
            raise InputError(f"{self._source.name}: a picture cannot be decoded: {error.err}") from error
        if not done:
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
        """Let it go."""
        self._video.release()

    def _skip_backlog(self) -> None:
        """Forget the pictures that waited while the stream was opened: when they were taken is not known."""
        period = 1 / (self._settings.rate or self._declared)
        begun = before = clock.monotonic()
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
    """Set what is asked for, tell what was not taken, and return whether pictures come as they are stored."""
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
            what = f"{name} {asked:g}{symbol} was asked for, the camera set {got:g}{symbol}"
            _log.warning("%s: %s", source.name, what)
    got_format = _letters(video.get(cv2.CAP_PROP_FOURCC))
    if settings.fourcc is not None and got_format != settings.fourcc.ljust(4):
        what = f"fourcc {settings.fourcc} was asked for, the camera set {got_format}"
        _log.warning("%s: %s", source.name, what)


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
    # FFmpeg's tags of the deeper formats end in the number of bits.
    if 8 < tag[3] < 16 or (tag[3] == 16 and tag != _GREY16):
        raise InputError(
            f"{source.name} has {tag[3]} bits a sample, but only 8 would be read: send grey of 8 or 16 bits"
        )
    return tag in (_GREY8, _GREY16)


def _letters(fourcc: float) -> str:
    return _tag(fourcc).decode("ascii", "replace").rstrip("\0")


def _tag(code: float) -> bytes:
    return (int(code) & 0xFFFFFFFF).to_bytes(4, "little")
