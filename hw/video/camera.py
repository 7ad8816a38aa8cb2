"""A camera, video file or network stream, drained by a thread that never waits for a reader."""

from __future__ import annotations

import logging
import math
import threading
import time as clock

from mirrorskin.hw.camera import Frames
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.running import RunningCamera
from mirrorskin.hw.settings import CameraSettings
from mirrorskin.hw.video.capture import OPEN_TIMEOUT, READ_TIMEOUT, Capture
from mirrorskin.hw.video.source import find_source
from mirrorskin.io import InputError
from mirrorskin.io.frames import quiet_opencv

PATIENCE = 10.0
"""Seconds from the loss of a camera until it is given up."""

_FIRST = OPEN_TIMEOUT + READ_TIMEOUT  # seconds until the first frame
_CLOSING = READ_TIMEOUT + 1.0  # seconds that the thread has for its end
_PAUSES = (0.05, 1.0)  # seconds between two tries to have a camera back, at first and at most

_log = logging.getLogger("mirrorskin.hw")


class VideoCamera(RunningCamera):
    """A camera that OpenCV can open, as a ``mirrorskin.hw.camera.Camera``.

    A camera of this machine (V4L2) is given the format, size, rate, exposure and gain that the settings
    ask for; what it did not take is logged as a warning. Frames are grey: as the camera sends them where
    it sends grey (8 or 16 bits) or YUYV, else the luma of the colours. Their times are the driver's where
    these are on the clock of ``time.monotonic``, else that of the arrival here.

    A file plays once at its own rate, and ends with an error that says so. Of a stream, the pictures that
    waited while it was opened are left out.

    A camera or stream that is lost is opened again, for at most 10 s; it is logged that it is lost, and
    that it is back. Numbers then go on after as many as the time away had room for. ``error`` stays None
    meanwhile; ``latest`` tells at once that nothing comes.

    Parameters
    ----------
    settings : CameraSettings
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.

    Raises
    ------
    InputError
        It is not there, cannot be opened, gives no frame within 7 s, or frames of another size or type.
    """

    def __init__(self, settings: CameraSettings, slots: int | None = None) -> None:
        self._source = find_source(settings.source)
        self._settings = settings
        super().__init__(self._source.name, settings.shape, settings.dtype, settings.rate, slots)
        self._lost: float | None = None  # since when
        self._pause = _PAUSES[0]
        self._refusal: InputError | None = None
        self._ready, self._stop = threading.Event(), threading.Event()
        # OpenCV may hang in a driver: the program's end must not wait for that.
        self._thread = threading.Thread(target=self._drain, name=self.name, daemon=True)
        self._thread.start()
        try:
            self._await_first()
        except BaseException:
            self.close()
            raise

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one; see ``Camera.take``."""
        try:
            return super().take(most, timeout)
        except HardwareError as error:
            lost = self._lost
            if lost is None or self.error is not None:
                raise
            away = clock.monotonic() - lost
            raise HardwareError(f"{self.name} was lost {away:.1f} s ago and is not back yet") from error

    def close(self) -> None:
        """Let the camera go; a driver that does not answer is left to itself after 3 s."""
        self._stop.set()
        self._fail(f"{self.name} is closed")
        self._thread.join(_CLOSING)
        if self._thread.is_alive():
            _log.warning("%s does not let go: unplug it before it is used again", self.name)

    def _await_first(self) -> None:
        if not self._ready.wait(_FIRST):
            raise InputError(f"{self.name} gave no picture within {_FIRST:.3g} s: see its cable and power")
        if self._refusal is not None:
            raise self._refusal

    def _drain(self) -> None:
        """Move frames to the ring until the end: what the thread does."""
        with quiet_opencv():
            try:
                self._keep_open()
            except Exception as error:  # whatever it is, readers must not wait
                _log.debug("%s failed", self.name, exc_info=error)
                self._fail(f"{self.name} failed: {error}")
            finally:
                self._ready.set()

    def _keep_open(self) -> None:
        """Open the source and follow it; again and again if it is lost."""
        timeout = OPEN_TIMEOUT
        while not self._stop.is_set():
            try:
                why = self._follow(Capture(self._source, self._settings, timeout))
            except InputError as error:
                why = str(error)
            if not self._ready.is_set():
                self._refusal = InputError(why)
                return
            if self._source.kind == "file":
                self._fail(why)
                return
            if not self._stop.is_set():
                timeout = self._wait_for_return(why)

    def _follow(self, capture: Capture) -> str:
        """Put frames into the ring as they come, and return why they do not come any more."""
        pace = _Pace(capture.period) if self._source.kind == "file" else None
        try:
            while not self._stop.is_set():
                time = capture.grab()
                if time is None:
                    break
                capture.retrieve(self._slot())
                if pace is not None:
                    self._stop.wait(pace.due(capture.position) - clock.monotonic())
                    time = clock.monotonic()
                self._put(time, 0 if self._lost is None else self._came_back(time))
                self._ready.set()
        finally:
            capture.release()
        if self._source.kind == "file":
            return f"{self.name} has ended after {self._number} frames"
        return f"{self.name} gives no picture"

    def _wait_for_return(self, why: str) -> float:
        """Wait before a lost camera is tried again, or give it up; return the seconds left to try."""
        now = clock.monotonic()
        if self._lost is None:
            self._lost = now
            told = "%s: it was lost after %d frames, and is tried again for %.3g s"
            _log.warning(told, why, self._number, PATIENCE)
        left = self._lost + PATIENCE - now
        if left <= 0:
            self._fail(f"{why}: it was lost, and not back within {PATIENCE:.3g} s; see its cable and power")
            self._stop.set()
        self._stop.wait(min(self._pause, max(left, 0.0)))
        self._pause = min(2 * self._pause, _PAUSES[1])
        return min(OPEN_TIMEOUT, max(left, 0.1))

    def _came_back(self, time: float) -> int:
        """Tell that the camera is back, and return how many frames it would have given meanwhile."""
        away = time - self.latest
        rate = self._tally.counts().rate
        missing = max(1, round(away * rate) - 1) if math.isfinite(rate) else 1
        self._lost, self._pause = None, _PAUSES[0]
        self._reconnects += 1
        _log.warning("%s is back after %.2f s; about %d frames are missing", self.name, away, missing)
        return missing


class _Pace:
    """When the pictures of a file that begins to play now are due."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._start: float | None = None
        self._position = 0.0

    def due(self, position: float) -> float:
        """Return when a picture is due, monotonic seconds, from its position in the file."""
        if self._start is None:
            self._start = clock.monotonic() - position
        elif not position > self._position:  # some files do not say
            position = self._position + self._period
        self._position = position
        return self._start + position
