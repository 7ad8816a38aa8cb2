"""When a controller is where: moves with trapezoidal speed, holds and stops, kept as a history.

What is simpler here than in the firmware:

- Time is continuous: there are no steps, and the motion is exact at any time.
- A move begins when it is added; the firmware first looks whether more lines wait.
- Where two moves meet at an angle the speed is limited as the firmware does (the junction deviation: the
  speed on a circle that touches both and stays that near the corner), and the direction changes at once.
- An arc is one move, whose speed is limited so that the acceleration towards the centre stays within the
  axes' limits; the firmware makes short lines of it, whose corners allow some more.
- What halts at once loses no steps.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

BLOCKS = 15  # moves that the firmware's planner has room for
_STRAIGHT = 1e-6  # 1 - cos(angle) below which a corner counts as none
_TINY = 1e-12  # distances and times that are none
_FORGET = 1024  # spans that are dropped at a time


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """One way to go, and how.

    Attributes
    ----------
    path : Path
    speed, acceleration : float
        The greatest along the path, units/s and units/s^2, above 0.
    leave : float, optional
        The distance at which a limit switch is met.
    """

    path: Path
    speed: float
    acceleration: float
    leave: float | None = None


@dataclass(frozen=True, slots=True)
class _Span:
    """A time of constant acceleration on one move."""

    start: float
    end: float
    move: Move
    distance: float
    speed: float
    acceleration: float

    def gone(self, at: float) -> float:
        time = min(max(at, self.start), self.end) - self.start
        return self.distance + time * (self.speed + time * self.acceleration / 2)

    def speed_at(self, at: float) -> float:
        time = min(max(at, self.start), self.end) - self.start
        return max(0.0, self.speed + time * self.acceleration)

    def reaches(self, distance: float) -> float:
        """Return when a distance that lies in the span is reached."""
        way = distance - self.distance
        root = math.sqrt(max(0.0, self.speed * self.speed + 2 * self.acceleration * way))
        return self.start + (2 * way / (self.speed + root) if way > 0 else 0.0)


class Planner:
    """A queue of moves, and where it has led and will lead.

    Times are seconds of any steady clock, and must not run backwards from call to call, except where a place
    or a speed is asked for. ``advance`` must be called at every time that ``next_event`` names.

    Parameters
    ----------
    place : tuple of float
        Where the axes stand.
    memory : float
        For how many seconds what has been is kept.
    """

    def __init__(self, place: Place, memory: float = 600.0) -> None:
        self._first = place
        self._memory = memory
        self._spans: list[_Span] = []
        self._starts: list[float] = []
        self._moves: list[Move] = []
        self._corners: list[float] = []  # the greatest speed at the begin of each queued move
        self._ends: list[float] = []  # when the queued moves end, as far as is planned
        self._stop: float | None = None  # when a hold comes, or came, to rest
        self._switch: float | None = None  # when a limit switch is met
        self._seen = -math.inf

    @property
    def free(self) -> int:
        """How many moves there is room for."""
        return BLOCKS - len(self._moves)

    @property
    def busy(self) -> bool:
        """Whether moves are queued or under way."""
        return bool(self._moves)

    @property
    def holding(self) -> bool:
        """Whether a hold is under way or has come to rest."""
        return self._stop is not None

    @property
    def rest(self) -> float | None:
        """When a hold comes, or came, to rest; None without a hold."""
        return self._stop

    def held(self, now: float) -> bool:
        """Tell whether a hold has come to rest."""
        return self._stop is not None and now >= self._stop

    def at_switch(self, now: float) -> bool:
        """Tell whether a limit switch is met."""
        return self._switch is not None and now >= self._switch

    def next_event(self) -> float:
        """Return when a move ends, a hold comes to rest or a switch is met next, inf for never."""
        stop = [] if self._stop is None else [self._stop]
        switch = [] if self._switch is None else [self._switch]
        coming = [time for time in self._ends[:1] + stop if time > self._seen]
        return min(coming + switch, default=math.inf)

    def advance(self, now: float) -> None:
        """Drop the moves that have ended."""
        self._seen = now
        while self._ends and self._ends[0] <= now:
            del self._ends[0], self._moves[0], self._corners[0]

    def place(self, at: float) -> Place:
        """Return where the axes are at a time: past, or as planned."""
        span = self._span(at)
        return self._first if span is None else span.move.path.point(span.gone(at))

    def speed(self, at: float) -> float:
        """Return the speed along the path, units/s."""
        span = self._span(at)
        return 0.0 if span is None or at >= span.end else span.speed_at(at)

    def moving(self, at: float) -> bool:
        """Tell whether the axes move at a time."""
        span = self._span(at)
        return span is not None and span.start <= at < span.end

    def add(self, move: Move, now: float, deviation: float, accelerations: Sequence[float]) -> None:
        """Queue a move.

        Parameters
        ----------
        move : Move
            It begins where the one before ends. There must be room.
        now : float
        deviation : float
            The junction deviation, units.
        accelerations : sequence of float
            The axes' limits, units/s^2, for the corner with the move before.
        """
        self.advance(now)
        corner = _corner_speed(self._moves[-1], move, deviation, accelerations) if self._moves else 0.0
        self._moves.append(move)
        self._corners.append(corner)
        if not self.holding:
            self._plan(now)
            self.advance(now)

    def hold(self, now: float) -> None:
        """Slow down along the path, until the axes rest."""
        if self.holding:
            return
        self.advance(now)
        distance, speed = self._cut(now)
        time = now
        for move in self._moves:
            if speed <= 0:
                break
            left = move.path.length - distance
            if speed * speed <= 2 * move.acceleration * left:
                time = self._append(
                    time, speed / move.acceleration, move, distance, speed, -move.acceleration
                )
                break
            slower = math.sqrt(speed * speed - 2 * move.acceleration * left)
            time = self._append(time, 2 * left / (speed + slower), move, distance, speed, -move.acceleration)
            self._ends.append(time)
            distance, speed = 0.0, slower
        self._stop = time

    def resume(self, now: float) -> None:
        """Go on after a hold."""
        self._stop = None
        self._plan(now)
        self.advance(now)

    def halt(self, now: float) -> None:
        """Stop dead and forget what is queued; the place is kept."""
        self._cut(now)
        self._moves.clear()
        self._corners.clear()
        self._stop = None

    def _span(self, at: float) -> _Span | None:
        index = bisect_right(self._starts, at) - 1
        return self._spans[max(index, 0)] if self._spans else None

    def _cut(self, now: float) -> tuple[float, float]:
        """Forget what was planned beyond now; return the distance gone on the first move, and the speed."""
        kept = bisect_right(self._starts, now)
        del self._spans[kept:], self._starts[kept:]
        self._ends.clear()
        self._switch = None
        old = bisect_left(self._starts, now - self._memory) - 1
        if old >= _FORGET:
            del self._spans[:old], self._starts[:old]
        if not self._spans:
            return 0.0, 0.0
        last = self._spans[-1]
        under_way = now < last.end
        self._spans[-1] = last = replace(last, end=min(now, last.end))
        if not self._moves or last.move is not self._moves[0]:
            return 0.0, 0.0
        return last.gone(now), last.speed_at(now) if under_way else 0.0

    def _plan(self, now: float) -> None:
        """Plan the speed of all that is queued: as fast as the limits and a stop at the end allow."""
        distance, speed = self._cut(now)
        squares = [corner * corner for corner in self._corners] + [0.0]
        for index in range(len(self._moves) - 1, 0, -1):
            move = self._moves[index]
            squares[index] = min(
                squares[index], squares[index + 1] + 2 * move.acceleration * move.path.length
            )
        time = now
        for move, leaves in zip(self._moves, squares[1:], strict=True):
            left = move.path.length - distance
            leaves = min(leaves, speed * speed + 2 * move.acceleration * left)
            time = self._ramp(time, move, distance, speed, math.sqrt(leaves))
            self._ends.append(time)
            distance, speed = 0.0, math.sqrt(leaves)

    def _ramp(self, time: float, move: Move, distance: float, enters: float, leaves: float) -> float:
        """Append a trapezoid: faster, even, slower; return when it ends."""
        left = move.path.length - distance
        peak = math.sqrt(move.acceleration * left + (enters * enters + leaves * leaves) / 2)
        # Rounding may leave less than it takes to slow down: then it is done a trifle harder.
        peak = max(min(peak, move.speed), enters, leaves)
        faster = (peak * peak - enters * enters) / (2 * move.acceleration)
        slower = min((peak * peak - leaves * leaves) / (2 * move.acceleration), left - faster)
        for way, begin, end in (
            (faster, enters, peak),
            (left - faster - slower, peak, peak),
            (slower, peak, leaves),
        ):
            if way > _TINY:
                duration = 2 * way / (begin + end)
                time = self._append(time, duration, move, distance, begin, (end - begin) / duration)
                distance += way
        return time

    def _append(
        self, time: float, duration: float, move: Move, distance: float, speed: float, acceleration: float
    ) -> float:
        span = _Span(time, time + duration, move, distance, speed, acceleration)
        if duration > 0:
            self._spans.append(span)
            self._starts.append(time)
        leave = move.leave
        if leave is None or self._switch is not None:
            return span.end
        if distance - _TINY <= leave < span.gone(span.end) + _TINY:
            self._switch = span.reaches(leave)
        return span.end


def _corner_speed(before: Move, after: Move, deviation: float, accelerations: Sequence[float]) -> float:
    """Return the greatest speed between two moves: v^2 = a r, with a circle that cuts the corner.

    A circle of radius r that touches two lines at an angle theta between them comes within
    r (1/sin(theta/2) - 1) of the corner; that distance is the junction deviation.
    """
    arrives = before.path.tangent(before.path.length)
    departs = after.path.tangent(0.0)
    together = sum(a * b for a, b in zip(arrives, departs, strict=True))
    top = min(before.speed, after.speed)
    if 1 - together < _STRAIGHT:
        return top
    sine = math.sqrt(max(0.0, (1 + together) / 2))
    change = [b - a for a, b in zip(arrives, departs, strict=True)]
    size = math.hypot(*change)
    acceleration = share(accelerations, [part / size for part in change])
    return min(top, math.sqrt(acceleration * deviation * sine / (1 - sine)))


Place = tuple[float, ...]

_ARC_STEP = math.radians(1.0)  # how closely an arc is looked at where it might leave a box
_SAME = 1e-9  # axis units below which a place counts as on the box's face


class Path(Protocol):
    """A way from one place to another; distances along it are in axis units (mm or degrees)."""

    @property
    def length(self) -> float:
        """The whole distance, above 0."""

    @property
    def end(self) -> Place:
        """The last place."""

    @property
    def samples(self) -> int:
        """In how many parts each part is as good as straight."""

    def point(self, distance: float, /) -> Place:
        """Return the place after a distance; beyond the ends, the end."""

    def tangent(self, distance: float, /) -> Place:
        """Return the unit vector of the direction there."""

    def limits(
        self, feed: float, rates: Sequence[float], accelerations: Sequence[float], /
    ) -> tuple[float, float]:
        """Return the greatest speed, up to a feed, and acceleration that no axis' limit forbids."""


@dataclass(frozen=True, slots=True)
class Line:
    """A straight line.

    Attributes
    ----------
    start, end : tuple of float
        Places that differ.
    """

    start: Place
    end: Place

    @property
    def length(self) -> float:
        """The distance over all axes."""
        return math.dist(self.start, self.end)

    @property
    def samples(self) -> int:
        """One."""
        return 1

    def point(self, distance: float, /) -> Place:
        """Return the place after a distance."""
        part = distance / self.length
        if part <= 0:
            return self.start
        if part >= 1:
            return self.end
        return tuple(a + (b - a) * part for a, b in zip(self.start, self.end, strict=True))

    def tangent(self, distance: float, /) -> Place:
        """Return the direction, the same all along."""
        length = self.length
        return tuple((b - a) / length for a, b in zip(self.start, self.end, strict=True))

    def limits(
        self, feed: float, rates: Sequence[float], accelerations: Sequence[float], /
    ) -> tuple[float, float]:
        """Return what the axis allows that is the first to reach its limit."""
        unit = self.tangent(0.0)
        return min(feed, share(rates, unit)), share(accelerations, unit)


@dataclass(frozen=True, slots=True)
class Arc:
    """A circular arc in the plane of two axes; the other axes go along evenly.

    Where the ends' distances from the centre differ (by the rounding of the numbers in the program), the
    radius changes evenly from the one to the other.

    Attributes
    ----------
    start, end : tuple of float
    plane : (int, int)
        The numbers of the plane's axes; a positive sweep turns from the first to the second.
    centre : (float, float)
        In the plane.
    sweep : float
        Radians, not 0; beyond a whole turn is allowed.
    """

    start: Place
    end: Place
    plane: tuple[int, int]
    centre: tuple[float, float]
    sweep: float

    @property
    def length(self) -> float:
        """The distance: of a helix where other axes go along."""
        along = [b - a for a, b in zip(self.start, self.end, strict=True)]
        for axis in self.plane:
            along[axis] = 0.0
        return math.hypot(self._radius * self.sweep, *along)

    @property
    def samples(self) -> int:
        """One a degree."""
        return max(1, math.ceil(abs(self.sweep) / _ARC_STEP))

    @property
    def _radius(self) -> float:
        return (self._radius_at(self.start) + self._radius_at(self.end)) / 2

    def point(self, distance: float, /) -> Place:
        """Return the place after a distance, on the circle."""
        part = distance / self.length
        if part <= 0:
            return self.start
        if part >= 1:
            return self.end
        place = [a + (b - a) * part for a, b in zip(self.start, self.end, strict=True)]
        first, second = self._radius_at(self.start), self._radius_at(self.end)
        radius = first + (second - first) * part
        angle = self._angle(part)
        place[self.plane[0]] = self.centre[0] + radius * math.cos(angle)
        place[self.plane[1]] = self.centre[1] + radius * math.sin(angle)
        return tuple(place)

    def tangent(self, distance: float, /) -> Place:
        """Return the direction there; the radius counts as constant."""
        length = self.length
        angle = self._angle(distance / length)
        share = self._radius * self.sweep / length
        unit = [(b - a) / length for a, b in zip(self.start, self.end, strict=True)]
        unit[self.plane[0]] = -share * math.sin(angle)
        unit[self.plane[1]] = share * math.cos(angle)
        return tuple(unit)

    def limits(
        self, feed: float, rates: Sequence[float], accelerations: Sequence[float], /
    ) -> tuple[float, float]:
        """Return the limits that hold all along: those of a direction that points along every axis.

        The acceleration towards the centre at the greatest speed may take 1/sqrt(2) of what the plane's
        weaker axis can do; the rest, as the sides of a right triangle, is left for the one along the arc.
        """
        length = self.length
        worst = [(b - a) / length for a, b in zip(self.start, self.end, strict=True)]
        in_plane = abs(self._radius * self.sweep) / length
        for axis in self.plane:
            worst[axis] = in_plane
        weaker = min(accelerations[axis] for axis in self.plane)
        turning = math.sqrt(weaker / math.sqrt(2.0) * self._radius) / in_plane
        speed = min(feed, share(rates, worst), turning)
        inwards = (speed * in_plane) ** 2 / self._radius
        left = list(accelerations)
        for axis in self.plane:
            left[axis] = math.sqrt(max(0.0, weaker * weaker - inwards * inwards))
        return speed, share(left, worst)

    def _angle(self, part: float) -> float:
        a, b = self.plane
        return math.atan2(self.start[b] - self.centre[1], self.start[a] - self.centre[0]) + self.sweep * part

    def _radius_at(self, place: Place) -> float:
        a, b = self.plane
        return math.hypot(place[a] - self.centre[0], place[b] - self.centre[1])


def share(limits: Sequence[float], direction: Sequence[float]) -> float:
    """Return the greatest multiple of a direction that no axis' limit forbids, inf for none."""
    return min(
        (limit / abs(part) for limit, part in zip(limits, direction, strict=True) if part), default=math.inf
    )


def inside(place: Place, low: Place, high: Place) -> bool:
    """Tell whether a place lies in a box, its faces included."""
    return all(a - _SAME <= p <= b + _SAME for p, a, b in zip(place, low, high, strict=True))


def leaving(path: Path, low: Place, high: Place) -> float | None:
    """Return the distance at which a path goes out of a box, None where it never does.

    A path that begins outside counts from where it has been inside. Of an arc, what is out for less than
    a degree may be missed.
    """
    before = 0.0
    was_inside = inside(path.point(0.0), low, high)
    for number in range(1, path.samples + 1):
        after = path.length * number / path.samples
        is_inside = inside(path.point(after), low, high)
        if was_inside and not is_inside:
            return _last_inside(path, before, after, low, high)
        before, was_inside = after, is_inside
    return None


def _last_inside(path: Path, before: float, after: float, low: Place, high: Place) -> float:
    for _ in range(60):
        middle = (before + after) / 2
        if inside(path.point(middle), low, high):
            before = middle
        else:
            after = middle
    return before


def shifted(path: Path, by: Place) -> Path:
    """Return a path moved by a vector."""
    if not any(by):
        return path
    assert isinstance(path, Line | Arc)
    start = tuple(a + b for a, b in zip(path.start, by, strict=True))
    end = tuple(a + b for a, b in zip(path.end, by, strict=True))
    if isinstance(path, Line):
        return Line(start, end)
    first, second = path.plane
    return replace(
        path, start=start, end=end, centre=(path.centre[0] + by[first], path.centre[1] + by[second])
    )
