"""Positions, limits and reports of a stage, and its interface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.io import InputError

_ROUNDING = 1e-9  # tolerance of a limit, mm and rad
_UPRIGHT = 1e-4  # rad
# Motions that need an upright body: their units in messages, and the factor from mm or rad.
_SIDEWAYS = (("x", "mm", 1.0), ("y", "mm", 1.0), ("twist", "degrees", math.degrees(1.0)))


@dataclass(frozen=True, slots=True)
class Position:
    """A position of the body.

    The body leans by the half-angle ``hypot(pitch, roll)`` at the phase ``atan2(roll, pitch)``: it is rotated
    about the pivot by Rz(phase) Ry(half-angle) Rz(-phase). A precession is a circle in the plane of pitch and
    roll. Displacement along x and y and the twist about its own axis are applied first.

    Attributes
    ----------
    travel : float
        Distance that the body has been lowered, mm, positive down.
    pitch, roll : float
        Radians: half-angle times the cosine and the sine of the phase.
    x, y : float
        Displacement of the body, mm.
    twist : float
        Rotation about its own axis, radians, counter-clockwise as seen by the camera.

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
        """Phase of the lean, radians, from -pi to pi, counter-clockwise; 0 for an upright body."""
        return math.atan2(self.roll, self.pitch)


@dataclass(frozen=True, slots=True)
class Report:
    """A report of a stage."""

    time: float  # seconds of time.monotonic at which it was valid
    position: Position
    state: str  # idle, run, hold, jog, alarm, home, door, check or sleep


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of the body, checked before anything is sent.

    Attributes
    ----------
    travel : (float, float)
        Range of the axis, mm.
    tilt : float
        Maximum half-angle of the lean, radians; 0 for a stage that cannot lean.
    press : float
        Maximum travel that the skin tolerates, mm.
    x, y, twist : (float, float)
        Range of each, mm and radians; only 0 for a stage without that axis.
    """

    travel: tuple[float, float]
    tilt: float
    press: float
    x: tuple[float, float] = (0.0, 0.0)
    y: tuple[float, float] = (0.0, 0.0)
    twist: tuple[float, float] = (0.0, 0.0)

    def check(self, position: Position, name: str) -> None:
        """Refuse a position beyond the limits: an InputError names the limit and the stage (`name`)."""
        travel, tilt, (low, high) = position.travel, position.tilt, self.travel
        if not math.isfinite(travel):
            raise InputError(
                f"{name}: a travel of {travel} mm is not a position; give a finite number of millimetres"
            )
        if not low - _ROUNDING <= travel <= high + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm is beyond the axis, whose range is "
                f"{low:.9g} to {high:.9g} mm; stay within it, or correct the limits in the rig "
                "file, or $130 to $135"
            )
        if travel > self.press + _ROUNDING:
            raise InputError(
                f"{name}: a travel of {travel:.9g} mm exceeds the maximum of {self.press:.9g} mm "
                "in the rig file; press less, or increase press there"
            )
        if not math.isfinite(tilt):
            raise InputError(f"{name}: a tilt of {tilt} is not an angle; give a finite one")
        if tilt > self.tilt + _ROUNDING:
            raise InputError(
                f"{name}: a tilt of {math.degrees(tilt):.9g} degrees exceeds the maximum of "
                f"{math.degrees(self.tilt):.9g}; tilt less, or correct pitch and roll in the rig "
                "file"
            )
        for motion, unit, scale in _SIDEWAYS:
            self._check_sideways(getattr(position, motion) * scale, motion, unit, scale, name)

    def excess(self, position: Position) -> float:
        """Return by how much a position exceeds the limits, mm or degrees, whichever is more; 0 within."""
        low, high = self.travel
        lean = math.degrees(position.tilt - self.tilt)
        beyond = [low - position.travel, position.travel - min(high, self.press), lean]
        for motion, _, scale in _SIDEWAYS:
            (lowest, greatest), value = getattr(self, motion), getattr(position, motion)
            beyond += [(lowest - value) * scale, (value - greatest) * scale]
        return max(0.0, *beyond)

    def nearest(self, position: Position) -> Position:
        """Return the nearest upright position within the limits."""
        low, high = self.travel
        bounds = {"travel": (low, min(high, self.press)), "x": self.x, "y": self.y, "twist": self.twist}
        return Position(
            **{
                motion: min(max(getattr(position, motion), lowest), greatest)
                for motion, (lowest, greatest) in bounds.items()
            }
        )

    def retreat_path(self, position: Position) -> list[Position]:
        """Return the path of a retreat: upright, straight up to the least travel, and to the centre."""
        upright, high = self.nearest(position), self.travel[0]
        first = [upright] if position.tilt > _UPRIGHT else []
        return list(dict.fromkeys([*first, replace(upright, travel=high), Position(high)]))

    def _check_sideways(self, value: float, motion: str, unit: str, scale: float, name: str) -> None:
        """Refuse a move along x or y, mm, or a twist, degrees, beyond its limits."""
        low, high = (limit * scale for limit in getattr(self, motion))
        if low - _ROUNDING <= value <= high + _ROUNDING:
            return
        if low == high:
            raise InputError(
                f"{name}: it has no axis of {motion}, which should move to {value:.9g} {unit}; "
                f"add [stage.{motion}] to the rig file"
            )
        raise InputError(
            f"{name}: {value:.9g} {unit} of {motion} is beyond the axis, whose range is {low:.9g} "
            f"to {high:.9g} {unit}; stay within it, or correct the limits in the rig file"
        )


class Stage(Protocol):
    """An open stage that moves the body.

    All methods are thread-safe. Impossible requests are an `InputError`, raised before anything moves; later
    faults are a `HardwareError`. After a fault or a stop, ``error`` contains the reason and every call raises
    it.
    """

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def limits(self) -> Limits:
        """Limits of the body."""

    @property
    def error(self) -> HardwareError | None:
        """The fault of the stage; None if there is none."""

    def report(self) -> Report:
        """Return the newest report; reports are queried continuously."""

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports later than a time, oldest first; those of the last minutes are kept."""

    def home(self) -> None:
        """Home the axes; called only if the rig file states that there are switches."""

    def check_move(self, start: Position, place: Position, speed: float | None) -> None:
        """Refuse a sweep that is impossible at a speed, mm/s or rad/s."""

    def check_precession(self, tilt: float, turns: float, rate: float) -> None:
        """Refuse a precession of a half-angle, radians, at a rate, turns per second."""

    def move(self, place: Position, speed: float | None = None) -> None:
        """Start a straight move to a position, at a speed or the maximum speed."""

    def follow(self, places: Sequence[Position], speed: float | None = None) -> None:
        """Start a sequence of straight moves; see ``move``."""

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> None:
        """Start a precession from the current phase at a half-angle; see `GrblStage.precess`."""

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until all is done, and return a report of rest; an interruption of the wait stops the body."""

    def stop(self) -> None:
        """Stop the body at once; may be called repeatedly, and raises nothing."""

    def close(self) -> None:
        """Stop the body if it moves, and close the hardware."""
