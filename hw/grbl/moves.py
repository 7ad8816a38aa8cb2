"""From where the body shall stand to the words of G-code, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mirrorskin.hw.rig_file import StageSettings
from mirrorskin.hw.stage import Position
from mirrorskin.io import InputError

SLOWEST = 1.0
"""Machine units a minute: GRBL goes no slower, whatever the feed."""

SLOWEST_STEPS = 30.52
"""Steps a second of the axis that makes most of them: the timer of an 8-bit controller counts no longer."""

_STRAIGHT = "G53G1"  # in the machine's coordinates
_PLANES = {("X", "Y"): "G17", ("Z", "X"): "G18", ("Y", "Z"): "G19"}
_CENTRES = {"X": "I", "Y": "J", "Z": "K"}
_NO_TRAVEL = 1e-3  # mm that count as none where the body turns as well
_SHORT_ARC = math.radians(1)  # of an arc that is as good as straight
_ROUNDING = 1e-9  # of a half turn
_TURNS_MAX = 10_000  # turns at a time, since all their lines are made beforehand
_HOURS_MAX = 24.0  # of a precession, for the same reason

PIECE = 0.25
"""Seconds of motion in one line at most: what was sent cannot be revoked when this program is killed."""


@dataclass(frozen=True, slots=True)
class Command:
    """A line of G-code.

    Attributes
    ----------
    line : str
    duration : float
        Seconds that its motion takes; 0 if nothing moves.
    ramp : float
        Seconds in which the axes reach its speed from rest.
    """

    line: str
    duration: float = 0.0
    ramp: float = 0.0


class Axes:
    """The axes of a stage, as the rig file gives them: which letter moves what."""

    def __init__(self, settings: StageSettings, name: str, straight: str = _STRAIGHT) -> None:
        self._axes = settings.axes
        self._name = name
        self._straight = straight  # what a line of a straight move begins with
        self.speeds: dict[str, float] = {motion: axis.top_speed for motion, axis in self._axes.items()}
        self._steps = dict.fromkeys(self.letters.values(), math.inf)
        self._accelerations = dict.fromkeys(self.letters.values(), math.inf)

    @property
    def letters(self) -> dict[str, str]:
        """The letter of each motion."""
        return {motion: axis.letter for motion, axis in self._axes.items()}

    def machine(self, place: Position) -> dict[str, float]:
        """Return the machine's coordinates of a place, by letter: zero + direction * value."""
        return {
            axis.letter: axis.coordinate(float(getattr(place, motion))) for motion, axis in self._axes.items()
        }

    def place(self, machine: Mapping[str, float]) -> Position:
        """Return the place of machine coordinates; KeyError if they lack an axis."""
        return Position(**{motion: axis.value(machine[axis.letter]) for motion, axis in self._axes.items()})

    def limit(self, motion: str, rate: float) -> None:
        """Lower the greatest speed of a motion to what the controller allows, machine units a second."""
        self.speeds[motion] = min(self.speeds[motion], rate / self._axes[motion].scale)

    def limit_steps(self, motion: str, steps: float) -> None:
        """Refuse speeds that are too low for a controller whose axis makes so many steps a machine unit."""
        self._steps[self._axes[motion].letter] = steps

    def limit_acceleration(self, motion: str, acceleration: float) -> None:
        """Set the acceleration of a motion, machine units/s^2; it is infinite unless it is set."""
        self._accelerations[self._axes[motion].letter] = acceleration

    def distance(self, one: Position, other: Position) -> float:
        """Return by how much two places differ in the axis where they differ most, machine units."""
        a, b = self.machine(one), self.machine(other)
        return max(abs(a[letter] - b[letter]) for letter in a)

    def straight(self, start: Position, place: Position, speed: float | None) -> Command | None:
        """Return the straight move from one place to another, None if it is none.

        The speed is in mm/s, or rad/s if the body only turns; None for the greatest. The line of GRBL names
        the machine's coordinates, whatever the work coordinates are.
        """
        commands = self._straight_pieces(start, place, speed, math.inf)
        return commands[0] if commands else None

    def pieces(self, start: Position, place: Position, speed: float | None) -> list[Command]:
        """Return the straight move from one place to another in pieces of `PIECE` seconds; see ``straight``.

        The controller joins them without a halt, since they have one direction and one speed.
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
        way = {letter: after[letter] - before[letter] for letter in after}
        steps = max(self._steps[letter] * abs(way[letter]) for letter in way)
        self._check_steps(steps / duration, length / duration)
        count = _count(duration, longest)
        ends = [
            {letter: after[letter] - way[letter] * (1 - number / count) for letter in way}
            for number in range(1, count + 1)
        ]
        ramp = max(abs(way[letter]) / duration / self._accelerations[letter] for letter in way)
        lines = [f"{self._straight}{_words(end)}{feed}" for end in ends]
        return _timed(lines, duration, ramp)

    def check_way(self, start: Position, place: Position, speed: float | None) -> None:
        """Refuse a straight move that is too fast, or too slow for the controller; see ``straight``."""
        self.straight(start, place, speed)

    def check_turns(self, tilt: float, turns: float, rate: float) -> None:
        """Refuse a precession that cannot be, wherever the work coordinates begin; see ``arcs``."""
        self.arcs(tilt, turns, rate, 0.0, self.machine(Position()))

    def arcs(
        self, tilt: float, turns: float, rate: float, start: float, offset: Mapping[str, float]
    ) -> list[Command]:
        """Return the arcs of a precession, after the choice of their plane.

        Each is half a turn at most, and takes `PIECE` seconds at most.

        It turns from phase `start`, counter-clockwise if `turns` are positive, `rate` times a second;
        `offset` is where the work coordinates begin, in machine units.
        """
        plane, sense = self._plane()
        self._check_rate(tilt, turns, rate)
        radius = tilt * self._axes["pitch"].scale
        along = math.tau * rate * radius
        feed = self._feed(along)
        steps = min(self._steps[self._axes[motion].letter] for motion in ("pitch", "roll"))
        self._check_steps(steps * along / math.sqrt(2), along)  # where both axes go alike
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
        """Return the words of an arc about the upright body: GRBL takes its end in work coordinates only."""
        centre = self._lean(0.0, 0.0)
        return _words({x: end[x] - offset[x] for x in end}) + _words(
            {_CENTRES[x]: centre[x] - begin[x] for x in centre}
        )

    def _lean(self, tilt: float, phase: float) -> dict[str, float]:
        """Return the machine's coordinates of pitch and roll alone."""
        machine = self.machine(Position(0.0, tilt * math.cos(phase), tilt * math.sin(phase)))
        return {letter: machine[letter] for letter in (self._axes["pitch"].letter, self._axes["roll"].letter)}

    def _plane(self) -> tuple[str, int]:
        """Return the plane's word, and 1 if pitch to roll turns as a G3 does in it, -1 as a G2."""
        pitch, roll = self._axes.get("pitch"), self._axes.get("roll")
        if pitch is None or roll is None:
            raise InputError(f"{self._name}: it cannot lean; name the axes of pitch and roll in the rig file")
        if pitch.unit != roll.unit:
            raise InputError(f"{self._name}: arcs need pitch and roll in the same unit; go in steps")
        sense = pitch.direction * roll.direction
        for letters, way in (((pitch.letter, roll.letter), sense), ((roll.letter, pitch.letter), -sense)):
            if letters in _PLANES:
                return _PLANES[letters], way
        raise InputError(
            f"{self._name}: GRBL has no arcs in the axes {pitch.letter} and {roll.letter}; put pitch and "
            "roll on two of X, Y and Z, or go in steps"
        )

    def _check_rate(self, tilt: float, turns: float, rate: float) -> None:
        if not (math.isfinite(rate) and rate > 0 and math.isfinite(turns) and turns != 0 and tilt > 0):
            raise InputError(
                f"{self._name}: {turns:g} turns at {rate:g} a second with a tilt of {math.degrees(tilt):g} "
                "degrees are no precession; tilt and rate must be positive, and the turns not 0"
            )
        if abs(turns) > _TURNS_MAX:
            raise InputError(
                f"{self._name}: {turns:g} turns are too many; go round {_TURNS_MAX} times at most"
            )
        hours = abs(turns) / rate / 3600
        if hours > _HOURS_MAX:
            raise InputError(
                f"{self._name}: {turns:g} turns at {rate:g} a second take {hours:.3g} hours; go round for "
                f"{_HOURS_MAX:g} hours at most"
            )
        greatest = min(self.speeds["pitch"], self.speeds["roll"]) / (math.tau * tilt)
        if rate > greatest * (1 + _ROUNDING):
            raise InputError(
                f"{self._name}: {rate:.4g} turns a second at {math.degrees(tilt):.4g} degrees are more than "
                f"pitch and roll go; at most {greatest:.4g}"
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
            raise InputError(f"{self._name}: a speed of {speed:g} is none; give a positive one")
        turn, shift = (
            math.hypot(*(changes.get(motion, 0.0) for motion in motions))
            for motions in (("pitch", "roll", "twist"), ("travel", "x", "y"))
        )
        path = turn if turn > 0 and shift < _NO_TRAVEL else shift
        if path / speed < times[slowest] * (1 - _ROUNDING):
            unit = "mm/s" if path != turn else "rad/s"
            raise InputError(
                f"{self._name}: at {speed:.4g} {unit} the axis of {slowest} is too fast; at most "
                f"{path / times[slowest]:.4g} {unit}"
            )
        return path / speed

    def _check_steps(self, steps: float, speed: float) -> None:
        """Refuse a move that would be faster than asked for: steps and machine units a second."""
        if steps < SLOWEST_STEPS:
            least = speed * SLOWEST_STEPS / steps
            raise InputError(
                f"{self._name}: {speed:.4g} mm/s (or degrees/s) are {steps:.3g} steps a second, and the"
                f" controller makes no fewer than {SLOWEST_STEPS:g}; go {least:.3g} or faster, or in steps"
            )

    def _feed(self, speed: float) -> str:
        """Return the feed word of a speed in machine units a second."""
        if speed * 60 < SLOWEST:
            raise InputError(
                f"{self._name}: the controller goes no slower than {SLOWEST:g} mm (or degree) a minute, and "
                f"{speed * 60:.4g} was asked for; go faster, or in steps"
            )
        return f"F{speed * 60:.4f}"


def _count(duration: float, longest: float) -> int:
    """Return into how many parts a duration is divided so that none is longer than allowed."""
    return max(1, math.ceil(duration / longest - _ROUNDING))


def _timed(lines: list[str], duration: float, ramp: float) -> list[Command]:
    """Return the commands of a motion from rest to rest, in lines of equal length.

    The motion takes `duration` at its speed. Speeding up and slowing down take a ramp longer in all; on a way
    that is shorter than both, the speed is not reached.
    """
    added = ramp if ramp <= duration else 2 * math.sqrt(ramp * duration) - duration
    seconds = [duration / len(lines)] * len(lines)
    seconds[0] += added / 2
    seconds[-1] += added / 2
    return [Command(line, part, ramp) for line, part in zip(lines, seconds, strict=True)]


def _words(values: Mapping[str, float]) -> str:
    return "".join(f"{letter}{value:.5f}" for letter, value in values.items())
