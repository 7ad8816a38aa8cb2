"""Where a stage can place the body, how far it may go, and what it reports."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
        travel, tilt, (low, high) = position.travel, position.tilt, self.travel
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
        if not math.isfinite(tilt):
            raise InputError(f"{name}: a tilt of {tilt} is no angle; give a finite one")
        if tilt > self.tilt + _ROUNDING:
            raise InputError(
                f"{name}: a tilt of {math.degrees(tilt):.9g} degrees is beyond the greatest, "
                f"{math.degrees(self.tilt):.9g}; tilt less, or correct the rig file's pitch and roll"
            )

    def excess(self, position: Position) -> float:
        """Return how far a place lies beyond the limits: mm or degrees, whichever are more; 0 within."""
        low, high = self.travel
        lean = math.degrees(position.tilt - self.tilt)
        return max(0.0, low - position.travel, position.travel - min(high, self.press), lean)
