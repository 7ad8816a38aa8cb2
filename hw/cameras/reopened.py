"""Base class of cameras that may be lost and come back: a thread opens, reads and reopens them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from mirrorskin.hw.base.camera import Frames
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras.camera_thread import ThreadedCamera
from mirrorskin.io import InputError

_log = logging.getLogger("mirrorskin.hw")

OPEN_TIMEOUT = 5.0  # seconds to open a source
READ_TIMEOUT = 2.0  # seconds without a picture after which a source counts as lost
PATIENCE = 10.0  # seconds after which a lost camera is given up
_FIRST_FRAME = OPEN_TIMEOUT + READ_TIMEOUT  # seconds until the first frame
_CLOSING = READ_TIMEOUT + 1.0  # seconds to wait for the end of the thread
_PAUSES = (0.05, 1.0)  # seconds between attempts to reopen a camera, first and maximum


class ReopenedCamera(ThreadedCamera):
    """A camera that a thread opens and reads, and reopens after a loss, for at most 10 s.

    Loss and return are logged. Frame numbers then continue as if the missing frames had been counted.
    Meanwhile ``error`` is None, and ``latest`` shows that no frames arrive.

    A subclass implements ``_read_until_lost``, initialises what that needs, and then calls ``_start``.

    Parameters
    ----------
    name : str
        Name in messages.
    settings : CameraSettings
    slots : int, optional
        Number of frames that can wait; see ``mirrorskin.hw.cameras.ring.usual_slots``.
    clock : Clock
        Clock to wait with.
    """

    _returns = True  # whether it is reopened after a loss

    def __init__(
        self, name: str, settings: CameraSettings, slots: int | None = None, clock: Clock = SYSTEM
    ) -> None:
        self._settings = settings
        super().__init__(name, settings.shape, settings.dtype, settings.rate, slots, clock)
        self._lost: float | None = None  # time of the loss
        self._pause = _PAUSES[0]
        self._refusal: InputError | None = None
        self._ready, self._stop = clock.event(), clock.event()
        self._change: _ExposureChange | None = None  # that the thread is asked for
        # A driver may hang, and must not keep the program from ending.
        self._thread = clock.thread(self._drain, self.name, daemon=True)

    def _read_until_lost(self, timeout: float) -> str:
        """Open the source within a timeout; until ``_stop``, fill slots and call ``_arrived``.

        Return the reason why no more frames arrive. InputError if it cannot be opened, or does not match the
        settings.
        """
        raise NotImplementedError

    def _start(self) -> None:
        """Start the thread, and wait for the first frame unless it is triggered; InputError after 7 s."""
        self._thread.start()
        try:
            if not self._ready.wait(_FIRST_FRAME):
                raise InputError(
                    f"{self.name} delivered no picture within {_FIRST_FRAME:.3g} s: check its "
                    "cable and power supply"
                )
            if self._refusal is not None:
                raise self._refusal
        except BaseException:
            self.close()
            raise

    def _opened(self) -> None:
        """Record that the source is open, which suffices for a triggered camera."""
        if self._settings.trigger is not None:
            self._ready.set()

    def _arrived(self, time: float, lost: int = 0) -> None:
        """Publish the frame in the slot, with its time of arrival and the number of frames lost before it."""
        self._put(time, lost if self._lost is None else self._came_back(time))
        self._ready.set()

    def take(self, limit: int, timeout: float) -> Frames:
        """Take the oldest waiting frames, or wait for one; see ``Camera.take``."""
        try:
            return super().take(limit, timeout)
        except HardwareError as error:
            lost = self._lost
            if lost is None or self.error is not None:
                raise
            away = self.clock.now() - lost
            raise HardwareError(f"{self.name} was lost {away:.1f} s ago and has not come back yet") from error

    def set_exposure(self, seconds: float, /) -> float:
        """Change the exposure of the running camera, and return the one that it has then, seconds.

        Frames that were exposed before may still arrive. A camera that was lost and comes back has the new
        exposure. InputError if the camera refuses it; HardwareError if it does not answer within 3 s.
        """
        change = _ExposureChange(seconds, self.clock.event())
        self._change = change
        if not change.over.wait(_CLOSING):
            raise HardwareError(f"{self.name} does not take another exposure: check its cable")
        if isinstance(change.outcome, InputError):
            raise change.outcome
        self._settings = msgspec.structs.replace(self._settings, exposure=seconds)
        return change.outcome

    def _change_exposure(self, set_exposure: Callable[[float], float]) -> None:
        """Set an exposure that was asked for, if any; called by the thread between frames."""
        change, self._change = self._change, None
        if change is not None:
            try:
                change.outcome = set_exposure(change.seconds)
            except InputError as error:
                change.outcome = error
            change.over.set()

    def close(self) -> None:
        """Close the camera; a driver that does not answer within 3 s is abandoned."""
        self._stop.set()
        self._fail(f"{self.name} is closed")
        self._thread.join(_CLOSING)
        if self._thread.is_alive():
            _log.warning("%s cannot be closed: unplug it before using it again", self.name)

    def _drain(self) -> None:
        """Transfer frames to the ring buffer until the end; run by the thread."""
        try:
            self._keep_open()
        except Exception as error:  # on any exception, readers must not wait forever
            _log.debug("%s failed", self.name, exc_info=error)
            self._fail(f"{self.name} failed: {error}")
            if not self._ready.is_set():
                self._refusal = InputError(f"{self.name} failed: {error}")
        finally:
            self._ready.set()

    def _keep_open(self) -> None:
        """Open the source and read it, again after each loss."""
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
        """Wait before the next attempt, or give up; return the remaining seconds for attempts."""
        remaining = self._was_lost(why) + PATIENCE - self.clock.now()
        if remaining <= 0:
            self._fail(
                f"{why}: it was lost and did not come back within {PATIENCE:.3g} s; check its cable "
                "and power supply"
            )
            self._stop.set()
        self._stop.wait(min(self._pause, max(remaining, 0.0)))
        self._pause = min(2 * self._pause, _PAUSES[1])
        return min(OPEN_TIMEOUT, max(remaining, 0.1))

    def _was_lost(self, why: str) -> float:
        """Log a new loss of the camera, and return the time of the loss."""
        if self._lost is None and not self._stop.is_set():
            self._lost = self.clock.now()
            message = "%s: lost after frame %d; trying to reopen it for %.3g s"
            _log.warning(message, why, self._number, PATIENCE)
        return self._lost or self.clock.now()

    def _came_back(self, time: float) -> int:
        """Log the return of the camera, and return the number of frames missed meanwhile."""
        away = time - self.latest
        rate = self._counter.counts().rate
        missing = max(1, round(away * rate) - 1) if math.isfinite(rate) else 1
        self._lost, self._pause = None, _PAUSES[0]
        self._reconnects += 1
        _log.warning("%s is back after %.2f s; about %d frames are missing", self.name, away, missing)
        return missing


@dataclass
class _ExposureChange:
    """A change of the exposure, and what came of it."""

    seconds: float
    over: Any  # an event of the clock
    outcome: float | InputError = math.nan


def warn_of_other(name: str, what: str, asked: float | str, got: float | str, unit: str = "") -> None:
    """Log that a camera uses another value than requested."""
    texts = [f"{value}{unit}" if isinstance(value, str) else f"{value:g}{unit}" for value in (asked, got)]
    _log.warning("%s: %s %s was requested, but the camera set %s", name, what, *texts)
