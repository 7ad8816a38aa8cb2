"""The ways that a controller drives along: straight lines and arcs, by the distance gone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

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
