"""Conversion of positions and moves of the body to G-code, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mirrorskin.hw.base.rig_file import StageSettings
from mirrorskin.hw.base.stage import Position
from mirrorskin.io import InputError

SLOWEST = 1.0
"""Machine units per minute: GRBL moves no slower, whatever the feed."""

SLOWEST_STEPS = 30.52
"""Steps per second of the fastest axis: the timer of an 8-bit controller allows no fewer."""

_STRAIGHT = "G53G1"  # in the machine's coordinates
_PLANES = {("X", "Y"): "G17", ("Z", "X"): "G18", ("Y", "Z"): "G19"}
_CENTRES = {"X": "I", "Y": "J", "Z": "K"}
_NO_TRAVEL = 1e-3  # mm that count as no travel if the body also rotates
_SHORT_ARC = math.radians(1)  # an arc shorter than this is treated as straight
_ROUNDING = 1e-9  # of a half turn
_TURNS_MAX = 10_000  # all lines of a precession are generated in advance
_HOURS_MAX = 24.0  # the same for its duration

PIECE = 0.25
"""Maximum seconds of motion in one line: lines cannot be revoked when this program is killed."""


@dataclass(frozen=True, slots=True)
class Command:
    """A line of G-code.

    Attributes
    ----------
    line : str
    duration : float
        Duration of its motion, seconds; 0 if nothing moves.
    ramp : float
        Acceleration time from rest to its speed, seconds.
    """

    line: str
    duration: float = 0.0
    ramp: float = 0.0


class Axes:
    """The axes of a stage as in the rig file: the letter of each motion."""

    def __init__(self, settings: StageSettings, name: str, straight: str = _STRAIGHT) -> None:
        self._axes = settings.axes
        self._name = name
        self._straight = straight  # start of the line of a straight move
        self.speeds: dict[str, float] = {motion: axis.top_speed for motion, axis in self._axes.items()}
        self._steps = dict.fromkeys(self.letters.values(), math.inf)
        self._accelerations = dict.fromkeys(self.letters.values(), math.inf)

    @property
    def letters(self) -> dict[str, str]:
        """The letter of each motion."""
        return {motion: axis.letter for motion, axis in self._axes.items()}

    def machine(self, place: Position) -> dict[str, float]:
        """Return the machine coordinates of a position, by letter: zero + direction * value."""
        return {
            axis.letter: axis.coordinate(float(getattr(place, motion))) for motion, axis in self._axes.items()
        }

    def place(self, machine: Mapping[str, float]) -> Position:
        """Return the position at machine coordinates; KeyError if an axis is missing."""
        return Position(**{motion: axis.value(machine[axis.letter]) for motion, axis in self._axes.items()})

    def limit(self, motion: str, rate: float) -> None:
        """Reduce the maximum speed of a motion to that of the controller, machine units per second."""
        self.speeds[motion] = min(self.speeds[motion], rate / self._axes[motion].scale)

    def limit_steps(self, motion: str, steps: float) -> None:
        """Refuse speeds that are too low for an axis with this many steps per machine unit."""
        self._steps[self._axes[motion].letter] = steps

    def limit_acceleration(self, motion: str, acceleration: float) -> None:
        """Set the acceleration of a motion, machine units/s^2; the default is infinite."""
        self._accelerations[self._axes[motion].letter] = acceleration

    def distance(self, start: Position, other: Position) -> float:
        """Return the largest difference of two positions over the axes, machine units."""
        a, b = self.machine(start), self.machine(other)
        return max(abs(a[letter] - b[letter]) for letter in a)

    def straight(self, start: Position, place: Position, speed: float | None) -> Command | None:
        """Return the straight move between two positions, None if they are equal.

        The speed is in mm/s, or rad/s if the body only rotates; None for the maximum. The line uses machine
        coordinates, independent of the work coordinates.
        """
        commands = self._straight_pieces(start, place, speed, math.inf)
        return commands[0] if commands else None

    def pieces(self, start: Position, place: Position, speed: float | None) -> list[Command]:
        """Return the straight move between two positions in pieces of `PIECE` seconds; see ``straight``.

        The controller joins them without stopping, since they have the same direction and speed.
        """
        return self._straight_pieces(start, place, speed, PIECE)

    def _straight_pieces(
        self, start: Position, place: Position, speed: float | None, longest: float
    ) -> list[Command]:
        before, after = self.machine(start), self.machine(place)
        length = math.dist(list(before.values()), list(after.values()))
        if length < 1e-6:
            return []
        duration = self._duration(start, place, speed)
        feed = self._feed(length / duration)
        delta = {letter: after[letter] - before[letter] for letter in after}
        steps = max(self._steps[letter] * abs(delta[letter]) for letter in delta)
        self._check_steps(steps / duration, length / duration)
        count = _count(duration, longest)
        ends = [
            {letter: after[letter] - delta[letter] * (1 - number / count) for letter in delta}
            for number in range(1, count + 1)
        ]
        ramp = max(abs(delta[letter]) / duration / self._accelerations[letter] for letter in delta)
        lines = [f"{self._straight}{_words(end)}{feed}" for end in ends]
        return _timed(lines, duration, ramp)

    def check_move(self, start: Position, place: Position, speed: float | None) -> None:
        """Refuse a straight move that is too fast, or too slow for the controller; see ``straight``."""
        self.straight(start, place, speed)

    def check_precession(self, tilt: float, turns: float, rate: float) -> None:
        """Refuse a precession that is impossible for any origin of the work coordinates; see ``arcs``."""
        self.arcs(tilt, turns, rate, 0.0, self.machine(Position()))

    def arcs(
        self, tilt: float, turns: float, rate: float, start: float, offset: Mapping[str, float]
    ) -> list[Command]:
        """Return the arcs of a precession, preceded by the selection of their plane.

        Each arc is at most half a turn and takes at most `PIECE` seconds. The precession starts at phase
        `start`, turns counter-clockwise if `turns` are positive, `rate` times per second; `offset` is the
        origin of the work coordinates, in machine units.
        """
        plane, sense = self._plane()
        self._check_rate(tilt, turns, rate)
        radius = tilt * self._axes["pitch"].scale
        along = math.tau * rate * radius
        feed = self._feed(along)
        steps = min(self._steps[self._axes[motion].letter] for motion in ("pitch", "roll"))
        self._check_steps(steps * along / math.sqrt(2), along)  # where both axes are equally fast
        duration = abs(turns) / rate
        count = max(math.ceil(2 * abs(turns) - _ROUNDING), _count(duration, PIECE))
        step = math.tau * turns / count
        word = "G3" if step * sense > 0 else "G2"
        lines = []
        for k in range(count):
            ends = [self._lean(tilt, start + step * number) for number in (k, k + 1)]
            if abs(step) < _SHORT_ARC:
                line = f"{_STRAIGHT}{_words(ends[1])}{feed}"
            else:
                line = f"{word}{self._arc(ends[0], ends[1], offset)}{feed}"
            lines.append(line)
        weakest = min(self._accelerations[self._axes[motion].letter] for motion in ("pitch", "roll"))
        return [Command(plane), *_timed(lines, duration, along / weakest)]

    def _arc(self, begin: Mapping[str, float], end: Mapping[str, float], offset: Mapping[str, float]) -> str:
        """Return the words of an arc about the upright body; GRBL takes its end in work coordinates only."""
        centre = self._lean(0.0, 0.0)
        return _words({x: end[x] - offset[x] for x in end}) + _words(
            {_CENTRES[x]: centre[x] - begin[x] for x in centre}
        )

    def _lean(self, tilt: float, phase: float) -> dict[str, float]:
        """Return the machine's coordinates of pitch and roll alone."""
        machine = self.machine(Position(0.0, tilt * math.cos(phase), tilt * math.sin(phase)))
        return {letter: machine[letter] for letter in (self._axes["pitch"].letter, self._axes["roll"].letter)}

    def _plane(self) -> tuple[str, int]:
        """Return the plane's word, and 1 if G3 in this plane turns from pitch to roll, -1 if G2 does."""
        pitch, roll = self._axes.get("pitch"), self._axes.get("roll")
        if pitch is None or roll is None:
            raise InputError(
                f"{self._name}: the stage cannot lean; describe the axes of pitch and roll in the rig file"
            )
        if pitch.unit != roll.unit:
            raise InputError(f"{self._name}: arcs need pitch and roll in the same unit; use steps instead")
        sense = pitch.direction * roll.direction
        for letters, sign in (((pitch.letter, roll.letter), sense), ((roll.letter, pitch.letter), -sense)):
            if letters in _PLANES:
                return _PLANES[letters], sign
        raise InputError(
            f"{self._name}: GRBL does not support arcs in the axes {pitch.letter} and "
            f"{roll.letter}; put pitch and roll on two of X, Y and Z, or use steps"
        )

    def _check_rate(self, tilt: float, turns: float, rate: float) -> None:
        if not (math.isfinite(rate) and rate > 0 and math.isfinite(turns) and turns != 0 and tilt > 0):
            raise InputError(
                f"{self._name}: a precession with turns = {turns:g}, rate = {rate:g}/s and "
                f"tilt = {math.degrees(tilt):g} degrees is not possible; tilt and rate must be "
                "positive, and the turns not 0"
            )
        if abs(turns) > _TURNS_MAX:
            raise InputError(f"{self._name}: {turns:g} turns are too many; the maximum is {_TURNS_MAX}")
        hours = abs(turns) / rate / 3600
        if hours > _HOURS_MAX:
            raise InputError(
                f"{self._name}: {turns:g} turns at {rate:g} per second take {hours:.3g} hours; "
                f"the maximum is {_HOURS_MAX:g} hours"
            )
        greatest = min(self.speeds["pitch"], self.speeds["roll"]) / (math.tau * tilt)
        if rate > greatest * (1 + _ROUNDING):
            raise InputError(
                f"{self._name}: {rate:.4g} turns per second at {math.degrees(tilt):.4g} degrees "
                f"are too fast for pitch and roll; the maximum is {greatest:.4g}"
            )

    def _duration(self, start: Position, place: Position, speed: float | None) -> float:
        changes: dict[str, float] = {
            motion: abs(getattr(place, motion) - getattr(start, motion)) for motion in self._axes
        }
        times = {motion: change / self.speeds[motion] for motion, change in changes.items()}
        slowest = max(times, key=lambda motion: times[motion])
        if speed is None:
            return times[slowest]
        if not (math.isfinite(speed) and speed > 0):
            raise InputError(f"{self._name}: a speed of {speed:g} is not possible; give a positive one")
        turn, shift = (
            math.hypot(*(changes.get(motion, 0.0) for motion in motions))
            for motions in (("pitch", "roll", "twist"), ("travel", "x", "y"))
        )
        path = turn if turn > 0 and shift < _NO_TRAVEL else shift
        if path / speed < times[slowest] * (1 - _ROUNDING):
            unit = "mm/s" if path != turn else "rad/s"
            raise InputError(
                f"{self._name}: {speed:.4g} {unit} is too fast for the axis of {slowest}; the "
                f"maximum is {path / times[slowest]:.4g} {unit}"
            )
        return path / speed

    def _check_steps(self, steps: float, speed: float) -> None:
        """Refuse a move that the controller would make too fast: steps and machine units per second."""
        if steps < SLOWEST_STEPS:
            slowest = speed * SLOWEST_STEPS / steps
            raise InputError(
                f"{self._name}: {speed:.4g} mm/s (or degrees/s) are {steps:.3g} steps per second, "
                f"but the controller's minimum is {SLOWEST_STEPS:g}; use {slowest:.3g} or more, or "
                "steps"
            )

    def _feed(self, speed: float) -> str:
        """Return the feed word for a speed in machine units per second."""
        if speed * 60 < SLOWEST:
            raise InputError(
                f"{self._name}: {speed * 60:.4g} mm (or degrees) per minute is too slow for the "
                f"controller; the minimum is {SLOWEST:g}; move faster, or in steps"
            )
        return f"F{speed * 60:.4f}"


def _count(duration: float, longest: float) -> int:
    """Return the number of parts into which a duration is divided so that none is too long."""
    return max(1, math.ceil(duration / longest - _ROUNDING))


def _timed(lines: list[str], duration: float, ramp: float) -> list[Command]:
    """Return the commands of a motion from rest to rest, in lines of equal length.

    The motion takes `duration` at constant speed, and `ramp` longer because of acceleration and deceleration.
    If the distance is too short for both, the speed is not reached.
    """
    added = ramp if ramp <= duration else 2 * math.sqrt(ramp * duration) - duration
    seconds = [duration / len(lines)] * len(lines)
    seconds[0] += added / 2
    seconds[-1] += added / 2
    return [Command(line, part, ramp) for line, part in zip(lines, seconds, strict=True)]


def _words(values: Mapping[str, float]) -> str:
    return "".join(f"{letter}{value:.5f}" for letter, value in values.items())
