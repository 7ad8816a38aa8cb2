"""What a stage is: where the body can stand, how far it may go, and what every stage can do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from mirrorskin.hw.errors import HardwareError
from mirrorskin.io import InputError

_ROUNDING = 1e-9  # by which a place may lie beyond a limit, mm and rad


@dataclass(frozen=True, slots=True)
class Position:
    """Where the body stands.

    It leans by the half-angle ``hypot(pitch, roll)`` at the phase ``atan2(roll, pitch)``: it is turned about
    the pivot by Rz(phase) Ry(half-angle) Rz(-phase). A precession is a circle in the plane of pitch and roll.

    Attributes
    ----------
    travel : float
        How far the body is lowered, mm, positive down.
    pitch, roll : float
        Radians: half-angle times the cosine and the sine of the phase.

    Examples
    --------
    >>> Position(1.0, pitch=0.03, roll=0.04).tilt
    0.05
    """

    travel: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    @property
    def tilt(self) -> float:
        """Half-angle of the lean, radians."""
        return math.hypot(self.pitch, self.roll)

    @property
    def phase(self) -> float:
        """Phase of the lean, radians, from -pi to pi, counter-clockwise; 0 of an upright body."""
        return math.atan2(self.roll, self.pitch)


@dataclass(frozen=True, slots=True)
class Report:
    """What a stage said of itself."""

    time: float  # seconds of time.monotonic at which it was so
    position: Position
    state: str  # idle, run, hold, jog, alarm, home, door, check or sleep


@dataclass(frozen=True, slots=True)
class Limits:
    """How far the body may go; held on our side, before anything is sent.

    Attributes
    ----------
    travel : (float, float)
        Least and greatest travel that the axis reaches, mm.
    tilt : float
        Greatest half-angle of the lean, radians; 0 of a stage that cannot lean.
    press : float
        Greatest travel that the sensor's skin bears, mm.
    """

    travel: tuple[float, float]
    tilt: float
    press: float

    def check(self, position: Position, name: str) -> None:
        """Refuse a place beyond the limits: an InputError names the limit, and the stage by `name`."""
        self._check_travel(position.travel, name)
        self._check_tilt(position.tilt, name)

    def check_precession(self, travel: float, tilt: float, name: str) -> None:
        """Refuse a precession beyond the limits: turns at half-angle `tilt`, rad, pressed by `travel`, mm."""
        self._check_travel(travel, name)
        self._check_tilt(tilt, name)

    def excess(self, position: Position) -> float:
        """Return how far a place lies beyond the limits: mm or degrees, whichever are more; 0 within."""
        low, high = self.travel
        lean = math.degrees(position.tilt - self.tilt)
        return max(0.0, low - position.travel, position.travel - min(high, self.press), lean)

    def _check_travel(self, travel: float, name: str) -> None:
        low, high = self.travel
        if not math.isfinite(travel):
            raise InputError(
                f"{name}: a travel of {travel} mm is no place; give a finite number of millimetres"
            )
        if not low - _ROUNDING <= travel <= high + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm is beyond the axis, which goes from {low:.9g} to "
                f"{high:.9g} mm; stay within, or correct the rig file's limits"
            )
        if travel > self.press + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm presses deeper than the {self.press:.9g} mm that "
                "the rig file allows; press less, or raise its press"
            )

    def _check_tilt(self, tilt: float, name: str) -> None:
        if not math.isfinite(tilt):
            raise InputError(f"{name}: a tilt of {tilt} is no angle; give a finite one")
        if abs(tilt) > self.tilt + _ROUNDING:
            raise InputError(
                f"{name}: a tilt of {math.degrees(abs(tilt)):.9g} degrees is beyond the greatest, "
                f"{math.degrees(self.tilt):.9g}; tilt less, or correct the rig file's pitch and roll"
            )


class Stage(Protocol):
    """What moves the body.

    A place or a precession beyond the limits is an `InputError`, raised before anything is sent. What goes
    wrong afterwards is a `HardwareError`. Whatever interrupts a call that waits (Ctrl-C too) stops the stage.
    """

    @property
    def name(self) -> str:
        """What to call it in messages."""

    @property
    def limits(self) -> Limits:
        """How far the body may go."""

    @property
    def error(self) -> HardwareError | None:
        """What is wrong with the stage; None while all is well. To be asked at any time, from any thread."""

    def home(self) -> None:
        """Find the axes' switches; returns when they are found."""

    def move(self, place: Position, speed: float | None = None) -> None:
        """Begin to go to `place` in a straight line; returns when the controller has taken the command.

        Parameters
        ----------
        place : Position
            Where to go.
        speed : float, optional
            Millimetres a second; radians a second if only the lean changes. If not given, as fast as the
            axes go.
        """

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> None:
        """Begin to go round at half-angle `tilt`, from phase `start`, where the body must stand.

        Parameters
        ----------
        tilt : float
            Half-angle, radians.
        turns : float
            How often to go round; counter-clockwise if positive.
        rate : float
            Turns a second, positive.
        start : float
            Phase to begin at, radians.
        """

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until the body rests and every command is done.

        Parameters
        ----------
        timeout : float, optional
            Seconds; by default what the commands should take, and a margin.

        Returns
        -------
        Report
            Where the body rests.

        Raises
        ------
        HardwareError
            On an alarm, when the stage is lost or was stopped, or when the time is up.
        """

    def report(self) -> Report:
        """Return what the stage said last; it is asked all the time.

        Raises
        ------
        HardwareError
            When the stage is lost, stopped or in alarm.
        """

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports later than `since`, oldest first; the newest of an hour or so are kept."""

    def stop(self) -> None:
        """Stop the body at once. To be called from any thread, as often as wished; raises nothing."""

    def close(self) -> None:
        """Stop the body if it moves, and let the stage go."""
