"""What cameras share that may be lost and come back: a thread opens them, again if need be, and reads."""

from __future__ import annotations

import logging
import math

from mirrorskin.hw.camera import Frames
from mirrorskin.hw.camera_thread import ThreadedCamera
from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.rig_file import CameraSettings
from mirrorskin.io import InputError

_log = logging.getLogger("mirrorskin.hw")

OPEN_TIMEOUT = 5.0  # seconds that a source has for its opening
READ_TIMEOUT = 2.0  # seconds without a picture after which a source counts as lost
PATIENCE = 10.0  # seconds from the loss of a camera until it is given up
_FIRST_FRAME = OPEN_TIMEOUT + READ_TIMEOUT  # seconds until the first frame
_CLOSING = READ_TIMEOUT + 1.0  # seconds that the thread has for its end
_PAUSES = (0.05, 1.0)  # seconds between two tries to have a camera back, at first and at most


class ReopenedCamera(ThreadedCamera):
    """A camera that a thread opens and drains, and opens again if it is lost, for at most 10 s.

    It is logged that it is lost, and that it is back. Numbers then go on after as many as the time away had
    room for. ``error`` stays None meanwhile; ``latest`` shows at once that nothing comes.

    A subclass has ``_read_until_lost``, sets what that needs, and then calls ``_start``.

    Parameters
    ----------
    name : str
        What messages call it.
    settings : CameraSettings
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.
    clock : Clock
        What it waits by.
    """

    _returns = True  # whether it is opened again after a loss

    def __init__(
        self, name: str, settings: CameraSettings, slots: int | None = None, clock: Clock = SYSTEM
    ) -> None:
        self._settings = settings
        super().__init__(name, settings.shape, settings.dtype, settings.rate, slots, clock)
        self._lost: float | None = None  # since when
        self._pause = _PAUSES[0]
        self._refusal: InputError | None = None
        self._ready, self._stop = clock.event(), clock.event()
        # A driver may hang: the program's end must not wait for that.
        self._thread = clock.thread(self._drain, self.name, daemon=True)

    def _read_until_lost(self, timeout: float) -> str:
        """Open the source within so many seconds, and until ``_stop`` fill slots and call ``_arrived``.

        Return why no more frames come. InputError if it cannot be opened, or gives what is not asked for.
        """
        raise NotImplementedError

    def _start(self) -> None:
        """Begin to drain, and wait for the first frame unless it is triggered; InputError after 7 s."""
        self._thread.start()
        try:
            if not self._ready.wait(_FIRST_FRAME):
                raise InputError(
                    f"{self.name} gave no picture within {_FIRST_FRAME:.3g} s: see its cable and power"
                )
            if self._refusal is not None:
                raise self._refusal
        except BaseException:
            self.close()
            raise

    def _opened(self) -> None:
        """Say that the source is open; of one that waits for a trigger that is enough."""
        if self._settings.trigger is not None:
            self._ready.set()

    def _arrived(self, time: float, lost: int = 0) -> None:
        """Let readers have what is in the slot, which arrived at a time, after so many lost frames."""
        self._put(time, lost if self._lost is None else self._came_back(time))
        self._ready.set()

    def take(self, most: int, timeout: float) -> Frames:
        """Take the oldest frames that wait, or wait for one; see ``Camera.take``."""
        try:
            return super().take(most, timeout)
        except HardwareError as error:
            lost = self._lost
            if lost is None or self.error is not None:
                raise
            away = self.clock.now() - lost
            raise HardwareError(f"{self.name} was lost {away:.1f} s ago and is not back yet") from error

    def close(self) -> None:
        """Let the camera go; a driver that does not answer is left to itself after 3 s."""
        self._stop.set()
        self._fail(f"{self.name} is closed")
        self._thread.join(_CLOSING)
        if self._thread.is_alive():
            _log.warning("%s does not let go: unplug it before it is used again", self.name)

    def _drain(self) -> None:
        """Move frames to the ring until the end: what the thread does."""
        try:
            self._keep_open()
        except Exception as error:  # whatever it is, readers must not wait
            _log.debug("%s failed", self.name, exc_info=error)
            self._fail(f"{self.name} failed: {error}")
            if not self._ready.is_set():
                self._refusal = InputError(f"{self.name} failed: {error}")
        finally:
            self._ready.set()

    def _keep_open(self) -> None:
        """Open the source and follow it; again and again if it is lost."""
        timeout = OPEN_TIMEOUT
        while not self._stop.is_set():
            try:
                why = self._read_until_lost(timeout)
            except InputError as error:
                why = str(error)
            if not self._ready.is_set():
                self._refusal = InputError(why)
                return
            if not self._returns:
                self._fail(why)
                return
            if not self._stop.is_set():
                timeout = self._wait_for_return(why)

    def _wait_for_return(self, why: str) -> float:
        """Wait before a lost camera is tried again, or give it up; return the seconds left to try."""
        left = self._was_lost(why) + PATIENCE - self.clock.now()
        if left <= 0:
            self._fail(f"{why}: it was lost, and not back within {PATIENCE:.3g} s; see its cable and power")
            self._stop.set()
        self._stop.wait(min(self._pause, max(left, 0.0)))
        self._pause = min(2 * self._pause, _PAUSES[1])
        return min(OPEN_TIMEOUT, max(left, 0.1))

    def _was_lost(self, why: str) -> float:
        """Log that the camera is lost, if that is news, and return since when it is."""
        if self._lost is None and not self._stop.is_set():
            self._lost = self.clock.now()
            message = "%s: it was lost after %d frames, and is tried again for %.3g s"
            _log.warning(message, why, self._number, PATIENCE)
        return self._lost or self.clock.now()

    def _came_back(self, time: float) -> int:
        """Log that the camera is back, and return how many frames it would have given meanwhile."""
        away = time - self.latest
        rate = self._counter.counts().rate
        missing = max(1, round(away * rate) - 1) if math.isfinite(rate) else 1
        self._lost, self._pause = None, _PAUSES[0]
        self._reconnects += 1
        _log.warning("%s is back after %.2f s; about %d frames are missing", self.name, away, missing)
        return missing


def warn_of_other(name: str, what: str, asked: float | str, got: float | str, unit: str = "") -> None:
    """Log that a camera set something else than was asked for."""
    said = [f"{value}{unit}" if isinstance(value, str) else f"{value:g}{unit}" for value in (asked, got)]
    _log.warning("%s: %s %s was asked for, the camera set %s", name, what, *said)
