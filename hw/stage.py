"""Where a stage can place the body, how far it may go, and what it reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from mirrorskin.hw.errors import HardwareError
from mirrorskin.io import InputError

_ROUNDING = 1e-9  # by which a place may lie beyond a limit, mm and rad
_UPRIGHT = 1e-4  # rad
# Motions that need the body upright: their units in messages, and how many there are in one mm or rad.
_SIDEWAYS = (("x", "mm", 1.0), ("y", "mm", 1.0), ("twist", "degrees", math.degrees(1.0)))


@dataclass(frozen=True, slots=True)
class Position:
    """Where the body stands.

    It leans by the half-angle ``hypot(pitch, roll)`` at the phase ``atan2(roll, pitch)``: it is turned about
    the pivot by Rz(phase) Ry(half-angle) Rz(-phase). A precession is a circle in the plane of pitch and roll.
    Before that it was moved along x and y, and turned about its own axis by the twist.

    Attributes
    ----------
    travel : float
        How far the body is lowered, mm, positive down.
    pitch, roll : float
        Radians: half-angle times the cosine and the sine of the phase.
    x, y : float
        How far the body was moved sideways, mm.
    twist : float
        Radians that it was turned about its axis, counter-clockwise as its camera sees it.

    Examples
    --------
    >>> Position(1.0, pitch=0.03, roll=0.04).tilt
    0.05
    """

    travel: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    x: float = 0.0
    y: float = 0.0
    twist: float = 0.0

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
    x, y, twist : (float, float)
        Least and greatest of each, mm and radians; only 0 of a stage without that axis.
    """

    travel: tuple[float, float]
    tilt: float
    press: float
    x: tuple[float, float] = (0.0, 0.0)
    y: tuple[float, float] = (0.0, 0.0)
    twist: tuple[float, float] = (0.0, 0.0)

    def check(self, position: Position, name: str) -> None:
        """Refuse a place beyond the limits: an InputError names the limit, and the stage by `name`."""
        travel, tilt, (low, high) = position.travel, position.tilt, self.travel
        if not math.isfinite(travel):
            raise InputError(
                f"{name}: a travel of {travel} mm is no place; give a finite number of millimetres"
            )
        if not low - _ROUNDING <= travel <= high + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm is beyond the axis, which goes from {low:.9g} to "
                f"{high:.9g} mm; stay within, or correct the rig file's limits, or $130 to $135"
            )
        if travel > self.press + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm presses deeper than the {self.press:.9g} mm that "
                "the rig file allows; press less, or raise its press"
            )
        if not math.isfinite(tilt):
            raise InputError(f"{name}: a tilt of {tilt} is no angle; give a finite one")
        if tilt > self.tilt + _ROUNDING:
            raise InputError(
                f"{name}: a tilt of {math.degrees(tilt):.9g} degrees is beyond the greatest, "
                f"{math.degrees(self.tilt):.9g}; tilt less, or correct the rig file's pitch and roll"
            )
        for motion, unit, scale in _SIDEWAYS:
            self._check_sideways(getattr(position, motion) * scale, motion, unit, scale, name)

    def excess(self, position: Position) -> float:
        """Return how far a place lies beyond the limits: mm or degrees, whichever are more; 0 within."""
        low, high = self.travel
        lean = math.degrees(position.tilt - self.tilt)
        beyond = [low - position.travel, position.travel - min(high, self.press), lean]
        for motion, _, scale in _SIDEWAYS:
            (least, greatest), value = getattr(self, motion), getattr(position, motion)
            beyond += [(least - value) * scale, (value - greatest) * scale]
        return max(0.0, *beyond)

    def nearest(self, position: Position) -> Position:
        """Return the upright place within the limits that is nearest to another."""
        low, high = self.travel
        bounds = {"travel": (low, min(high, self.press)), "x": self.x, "y": self.y, "twist": self.twist}
        return Position(
            **{
                motion: min(max(getattr(position, motion), least), greatest)
                for motion, (least, greatest) in bounds.items()
            }
        )

    def way_up(self, position: Position) -> list[Position]:
        """Return where to go from a place: upright, straight up to the least travel, and to the middle."""
        upright, high = self.nearest(position), self.travel[0]
        ways = [upright] if position.tilt > _UPRIGHT else []
        return list(dict.fromkeys([*ways, replace(upright, travel=high), Position(high)]))

    def _check_sideways(self, value: float, motion: str, unit: str, scale: float, name: str) -> None:
        """Refuse a move along x or y, mm, or a twist, degrees, beyond its limits."""
        low, high = (limit * scale for limit in getattr(self, motion))
        if low - _ROUNDING <= value <= high + _ROUNDING:
            return
        if low == high:
            raise InputError(
                f"{name}: it has no axis of {motion}, which was to go to {value:.9g} {unit}; "
                f"add [stage.{motion}] to the rig file"
            )
        raise InputError(
            f"{name}: {value:.9g} {unit} of {motion} are beyond the axis, which goes from {low:.9g} to "
            f"{high:.9g} {unit}; stay within, or correct the rig file's limits"
        )


class Stage(Protocol):
    """A stage that is open, and moves the body.

    All of it may be used from any thread. What cannot be done is an `InputError`, raised before anything
    moves; what goes wrong afterwards is a `HardwareError`. A stage that failed or was stopped says so in
    ``error`` and to every call.
    """

    @property
    def name(self) -> str:
        """What to call it in messages."""

    @property
    def limits(self) -> Limits:
        """How far the body may go."""

    @property
    def error(self) -> HardwareError | None:
        """What is wrong with it; None while all is well."""

    def report(self) -> Report:
        """Return what it said last; it is asked all the time."""

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports later than a time, oldest first; those of the last minutes are kept."""

    def home(self) -> None:
        """Find the switches of its axes; asked for only where the rig file says that it has some."""

    def check_way(self, start: Position, place: Position, speed: float | None) -> None:
        """Refuse a sweep that it cannot do at a speed, mm/s or rad/s."""

    def check_turns(self, tilt: float, turns: float, rate: float) -> None:
        """Refuse a precession of a half-angle, radians, at a rate, turns a second."""

    def move(self, place: Position, speed: float | None = None) -> None:
        """Begin to go to a place in a straight line, as fast as it goes unless a speed is given."""

    def follow(self, places: Sequence[Position], speed: float | None = None) -> None:
        """Begin to go to some places, one after the other; see ``move``."""

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> None:
        """Begin to go round at a half-angle from a phase, where the body stands; see `GrblStage.precess`."""

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until all is done, and return a report of rest; what interrupts the wait stops the body."""

    def stop(self) -> None:
        """Stop the body at once, as often as anyone likes; raises nothing."""

    def close(self) -> None:
        """Stop the body if it moves, and let the hardware go."""
