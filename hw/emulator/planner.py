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

from mirrorskin.hw.emulator.grbl_paths import Path, Place, share

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
