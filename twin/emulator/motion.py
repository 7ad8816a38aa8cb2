"""The motion of emulated axes: lines and arcs with trapezoidal speed, and their history.

Simplifications compared with the firmware:

- Time is continuous: there are no steps, and the position is exact at any time.
- A move starts when it is added; the firmware first waits for more lines.
- The axes stop where two moves meet at an angle; the firmware rounds the corner slightly.
- An arc is one move, whose speed is limited such that the centripetal acceleration stays within the axes'
  limits; the firmware divides it into short lines, whose corners allow slightly more.
- Stopping without deceleration loses no steps.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

Place = tuple[float, ...]

BLOCKS = 15  # moves that the firmware's planner can hold
_ARC_STEP = math.radians(1.0)  # resolution at which an arc is tested for leaving a box
_FACE_TOLERANCE = 1e-9  # axis units; closer positions count as on the face of the box
_STRAIGHT = 1e-6  # 1 - cos(angle); below it two moves count as collinear
_TINY = 1e-12  # shorter distances and times count as 0
_FORGET = 1024  # number of spans that are dropped at a time


@dataclass(frozen=True, slots=True)
class Line:
    """A straight line between two places that differ; distances are in axis units, mm or degrees."""

    start: Place
    end: Place
    samples = 1  # number of parts into which a path is divided so that each is nearly straight

    @property
    def length(self) -> float:
        """Distance over all axes."""
        return math.dist(self.start, self.end)

    def point(self, distance: float) -> Place:
        """Return the position after a distance, clipped to the ends."""
        part = min(max(distance / self.length, 0.0), 1.0)
        if part == 1:
            return self.end
        return tuple(a + (b - a) * part for a, b in zip(self.start, self.end, strict=True))

    def tangent(self, distance: float) -> Place:
        """Return the unit vector of the direction."""
        length = self.length
        return tuple((b - a) / length for a, b in zip(self.start, self.end, strict=True))

    def limits(
        self, feed: float, rates: Sequence[float], accelerations: Sequence[float]
    ) -> tuple[float, float]:
        """Return the maximum speed, up to a feed, and acceleration within the limits of all axes."""
        unit = self.tangent(0.0)
        return min(feed, _largest_multiple(rates, unit)), _largest_multiple(accelerations, unit)


@dataclass(frozen=True, slots=True)
class Arc:
    """A circular arc in the plane of two axes; a positive sweep, radians, turns from the first to the second.

    If rounding in the program makes the distances of the two ends from the centre differ, the radius changes
    linearly between them.
    """

    start: Place
    end: Place
    plane: tuple[int, int]
    centre: tuple[float, float]
    sweep: float

    @property
    def length(self) -> float:
        """Length of the arc."""
        return abs(self._radius * self.sweep)

    @property
    def samples(self) -> int:
        """One per degree."""
        return max(1, math.ceil(abs(self.sweep) / _ARC_STEP))

    def point(self, distance: float) -> Place:
        """Return the position after a distance on the arc."""
        part = min(max(distance / self.length, 0.0), 1.0)
        if part in (0, 1):
            return self.end if part else self.start
        first, second = self._radius_at(self.start), self._radius_at(self.end)
        radius, angle = first + (second - first) * part, self._angle(part)
        place = list(self.start)
        place[self.plane[0]] = self.centre[0] + radius * math.cos(angle)
        place[self.plane[1]] = self.centre[1] + radius * math.sin(angle)
        return tuple(place)

    def tangent(self, distance: float) -> Place:
        """Return the direction there, assuming a constant radius."""
        angle, sense = self._angle(distance / self.length), math.copysign(1.0, self.sweep)
        unit = [0.0] * len(self.start)
        unit[self.plane[0]] = -sense * math.sin(angle)
        unit[self.plane[1]] = sense * math.cos(angle)
        return tuple(unit)

    def limits(
        self, feed: float, rates: Sequence[float], accelerations: Sequence[float]
    ) -> tuple[float, float]:
        """Return the limits that are valid along the whole arc.

        The centripetal acceleration at the maximum speed may use 1/sqrt(2) of the acceleration of the weaker
        axis; the rest, added in quadrature, remains for the acceleration along the arc.
        """
        weaker = min(accelerations[axis] for axis in self.plane)
        turning = math.sqrt(weaker / math.sqrt(2.0) * self._radius)
        speed = min(feed, turning, *(rates[axis] for axis in self.plane))
        inwards = speed**2 / self._radius
        return speed, math.sqrt(max(0.0, weaker * weaker - inwards * inwards))

    @property
    def _radius(self) -> float:
        return (self._radius_at(self.start) + self._radius_at(self.end)) / 2

    def _angle(self, part: float) -> float:
        a, b = self.plane
        return math.atan2(self.start[b] - self.centre[1], self.start[a] - self.centre[0]) + self.sweep * part

    def _radius_at(self, place: Place) -> float:
        a, b = self.plane
        return math.hypot(place[a] - self.centre[0], place[b] - self.centre[1])


Path = Line | Arc


def _largest_multiple(limits: Sequence[float], direction: Sequence[float]) -> float:
    """Return the largest multiple of a direction within the limits of all axes, inf if unlimited."""
    return min(
        (limit / abs(part) for limit, part in zip(limits, direction, strict=True) if part), default=math.inf
    )


def stays_inside(path: Path, low: Place, high: Place) -> bool:
    """Return whether a path ends in a box and does not leave it; one that starts outside may enter.

    Of an arc, excursions of less than a degree may be missed.
    """
    was_inside = False
    for number in range(path.samples + 1):
        place = path.end if number == path.samples else path.point(path.length * number / path.samples)
        is_inside = all(
            a - _FACE_TOLERANCE <= p <= b + _FACE_TOLERANCE for p, a, b in zip(place, low, high, strict=True)
        )
        if was_inside and not is_inside:
            return False
        was_inside = is_inside
    return was_inside


def shifted(path: Path, by: Place) -> Path:
    """Return a path translated by a vector."""
    start, end = (tuple(a + b for a, b in zip(p, by, strict=True)) for p in (path.start, path.end))
    if isinstance(path, Line):
        return Line(start, end)
    x, y = (c + by[axis] for c, axis in zip(path.centre, path.plane, strict=True))
    return replace(path, start=start, end=end, centre=(x, y))


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A path with the maximum speed and acceleration along it, units/s and units/s^2."""

    path: Path
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class _Span:
    """An interval of constant acceleration on one move."""

    start: float
    end: float
    move: Move
    distance: float
    speed: float
    acceleration: float

    def distance_at(self, at: float) -> float:
        time = min(max(at, self.start), self.end) - self.start
        return self.distance + time * (self.speed + time * self.acceleration / 2)

    def speed_at(self, at: float) -> float:
        time = min(max(at, self.start), self.end) - self.start
        return max(0.0, self.speed + time * self.acceleration)


_start = attrgetter("start")


class Planner:
    """A queue of moves, with their past and planned motion.

    Times are seconds of any steady clock. They must not decrease from call to call, except for queries of a
    position or a speed. ``advance`` must be called at each time that ``next_event`` returns. The history of
    the last ``memory`` seconds is kept.
    """

    def __init__(self, place: Place, memory: float = 600.0) -> None:
        self._first = place
        self._memory = memory
        self._spans: list[_Span] = []
        self._moves: list[Move] = []
        self._corners: list[float] = []  # maximum speed at the start of each queued move
        self._ends: list[float] = []  # times at which the queued moves end, as planned
        self._stop: float | None = None  # time at which a hold is at rest
        self._now = -math.inf

    @property
    def free(self) -> int:
        """Number of moves that can be added."""
        return BLOCKS - len(self._moves)

    @property
    def busy(self) -> bool:
        """Whether moves are queued or in progress."""
        return bool(self._moves)

    @property
    def holding(self) -> bool:
        """Whether a hold is in progress or at rest."""
        return self._stop is not None

    def held(self, now: float) -> bool:
        """Return whether a hold is at rest."""
        return self._stop is not None and now >= self._stop

    def next_event(self) -> float:
        """Return the time at which a move ends or a hold is at rest next, inf if there is none."""
        stop = [] if self._stop is None else [self._stop]
        return min((time for time in self._ends[:1] + stop if time > self._now), default=math.inf)

    def advance(self, now: float) -> None:
        """Drop the moves that have ended."""
        self._now = now
        while self._ends and self._ends[0] <= now:
            del self._ends[0], self._moves[0], self._corners[0]

    def place(self, at: float) -> Place:
        """Return the position of the axes at a time, past or planned."""
        span = self._span(at)
        return self._first if span is None else span.move.path.point(span.distance_at(at))

    def speed(self, at: float) -> float:
        """Return the speed along the path, units/s."""
        span = self._span(at)
        return 0.0 if span is None or at >= span.end else span.speed_at(at)

    def moving(self, at: float) -> bool:
        """Return whether the axes move at a time."""
        span = self._span(at)
        return span is not None and span.start <= at < span.end

    def add(self, move: Move, now: float) -> None:
        """Queue a move that starts at the end of the previous one; there must be room."""
        self.advance(now)
        self._corners.append(_corner_speed(self._moves[-1], move) if self._moves else 0.0)
        self._moves.append(move)
        if not self.holding:
            self._plan(now)
            self.advance(now)

    def hold(self, now: float) -> None:
        """Decelerate along the path until the axes are at rest."""
        if self.holding:
            return
        self.advance(now)
        distance, speed = self._cut(now)
        time = now
        for move in self._moves:
            if speed <= 0:
                break
            slowing, remaining = -move.acceleration, move.path.length - distance
            if speed * speed <= 2 * move.acceleration * remaining:
                time = self._append(time, speed / move.acceleration, move, distance, speed, slowing)
                break
            slower = math.sqrt(speed * speed - 2 * move.acceleration * remaining)
            time = self._append(time, 2 * remaining / (speed + slower), move, distance, speed, slowing)
            self._ends.append(time)
            distance, speed = 0.0, slower
        self._stop = time

    def resume(self, now: float) -> None:
        """Continue after a hold."""
        self._stop = None
        self._plan(now)
        self.advance(now)

    def halt(self, now: float) -> None:
        """Stop without deceleration and clear the queue, keeping the position."""
        self._cut(now)
        self._moves.clear()
        self._corners.clear()
        self._stop = None

    def _span(self, at: float) -> _Span | None:
        index = bisect_right(self._spans, at, key=_start) - 1
        return self._spans[max(index, 0)] if self._spans else None

    def _cut(self, now: float) -> tuple[float, float]:
        """Discard the plan after now; return the distance travelled on the first move, and the speed."""
        del self._spans[bisect_right(self._spans, now, key=_start) :]
        self._ends.clear()
        old = bisect_left(self._spans, now - self._memory, key=_start) - 1
        if old >= _FORGET:
            del self._spans[:old]
        if not self._spans:
            return 0.0, 0.0
        last = self._spans[-1]
        under_way = now < last.end
        self._spans[-1] = last = replace(last, end=min(now, last.end))
        if not self._moves or last.move is not self._moves[0]:
            return 0.0, 0.0
        return last.distance_at(now), last.speed_at(now) if under_way else 0.0

    def _plan(self, now: float) -> None:
        """Plan the speed of all queued moves: as fast as the limits and a stop at the end allow."""
        distance, speed = self._cut(now)
        squares = [corner * corner for corner in self._corners] + [0.0]
        for index in range(len(self._moves) - 1, 0, -1):
            move = self._moves[index]
            reached = squares[index + 1] + 2 * move.acceleration * move.path.length
            squares[index] = min(squares[index], reached)
        time = now
        for move, leaves in zip(self._moves, squares[1:], strict=True):
            remaining = move.path.length - distance
            leaves = min(leaves, speed * speed + 2 * move.acceleration * remaining)
            time = self._ramp(time, move, distance, speed, math.sqrt(leaves))
            self._ends.append(time)
            distance, speed = 0.0, math.sqrt(leaves)

    def _ramp(self, time: float, move: Move, distance: float, enters: float, leaves: float) -> float:
        """Append a trapezoid of acceleration, constant speed and deceleration; return the time of its end."""
        remaining = move.path.length - distance
        peak = math.sqrt(move.acceleration * remaining + (enters * enters + leaves * leaves) / 2)
        # Rounding may leave slightly less than the braking distance: deceleration is then slightly higher.
        peak = max(min(peak, move.speed), enters, leaves)
        faster = (peak * peak - enters * enters) / (2 * move.acceleration)
        slower = min((peak * peak - leaves * leaves) / (2 * move.acceleration), remaining - faster)
        for sense, begin, end in (
            (faster, enters, peak),
            (remaining - faster - slower, peak, peak),
            (slower, peak, leaves),
        ):
            if sense > _TINY:
                duration = 2 * sense / (begin + end)
                time = self._append(time, duration, move, distance, begin, (end - begin) / duration)
                distance += sense
        return time

    def _append(
        self, time: float, duration: float, move: Move, distance: float, speed: float, acceleration: float
    ) -> float:
        if duration > 0:
            self._spans.append(_Span(time, time + duration, move, distance, speed, acceleration))
        return time + duration


def _corner_speed(before: Move, after: Move) -> float:
    """Return the maximum speed at the junction of two moves: 0, unless they are collinear."""
    arrives, departs = before.path.tangent(before.path.length), after.path.tangent(0.0)
    straight = 1 - sum(a * b for a, b in zip(arrives, departs, strict=True)) < _STRAIGHT
    return min(before.speed, after.speed) if straight else 0.0
