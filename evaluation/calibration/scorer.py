"""Errors of a calibrated sensor's answers, and their limits.

It shares no code with mirrorskin. All is float64, from first principles, and written to be read:

- millimetres and radians; x to the right, y up the picture, z towards the camera; the origin lies under the
  picture's centre, z = 0 where the untouched sheet rests, and all places are told in the body's frame;
- a surface faces the camera with its normal (sin zenith cos azimuth, sin zenith sin azimuth, cos zenith);
- an object is known by its closed form. Its highest point touches the sheet at travel 0;
- light goes from 0 to 1. It is traced: from the camera to the mirror, on to the cylindrical wall, and to what
  is printed there. The bounds are Cramer and Rao's, by differences of that light.

An answer counts where the truth says that it could be had: in contact in every frame, away from creases, with
all of its light from the printed wall. There a missing answer counts against the sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Map = NDArray[np.float64]

ALLOWED = 1.2  # times the bound that an RMS error may be
ANSWERED = 0.9  # of what could be answered in a cell, so that leaving out what is hard does not help
POOR = 3.0  # times what the bounds allow that an answer may expect of itself, and still be one
FEWEST = 30  # pixels of a cell that is judged
ZENITHS = (0, 10, 15, 20, 25, 30, 35, 40, 50)  # ends of the bins, degrees

_STEP = 1e-5  # of an angle, to differentiate by
_ROUNDS = 60  # of the search for where a line of sight meets an object
_TABLE = 20_001  # angles at which a pinhole's lines of sight are worked out


@dataclass(frozen=True, slots=True)
class Rig:
    """The sensor as it truly is.

    ``dark_zenith`` and ``light_zenith`` are what a mirror at the centre has where the print lets nothing and
    all through: in between it goes with the zenith, to the power ``gamma``. ``span`` is the counts from dark
    to full light, ``spread`` one sigma of a sample, counts, with what rounding adds. ``distance`` is the
    pinhole's above the sheet.
    """

    tilt: float
    phase: tuple[float, ...]
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 17.5
    rim: float = 40.0
    index: float = 1.41
    distance: float = np.inf
    scatter: float = 0.0
    asymmetry: float = 0.0
    lamp_azimuth: float = 0.0
    dark_zenith: float = 0.0
    light_zenith: float = np.pi / 4
    gamma: float = 1.0
    span: float = 208.0
    spread: float = 1.0


class Surface(NamedTuple):
    """An object in closed form.

    Functions of x and y, arrays: height, mm, at most 0, NaN where there is none; slopes dz/dx and dz/dy; how
    far the next crease is, mm. ``reach`` is the radius of the circle about the origin that holds it.
    """

    name: str
    height: Callable[[Map, Map], Map]
    slope: Callable[[Map, Map], tuple[Map, Map]]
    clearance: Callable[[Map, Map], Map]
    reach: float


class Seen(NamedTuple):
    """What each pixel sees of the object in the mean pose, upright: maps of (H, W)."""

    x: Map  # of the point, mm
    y: Map
    z: Map  # above the rest plane, mm; NaN where the object does not reach it
    zenith: Map
    azimuth: Map
    clearance: Map


class Bound(NamedTuple):
    """The least standard errors that an unbiased estimate can have, radians, (H, W); NaN out of range."""

    zenith: Map
    azimuth: Map


class Part(NamedTuple):
    """One of the two angles, by cell or by bin; degrees but for the ratio."""

    rms: Map
    bias: Map
    bound: Map
    ratio: Map  # RMS of the errors in units of their bounds


class Table(NamedTuple):
    """Scores by cell, (n, n), row 0 the picture's upper edge, or by bin of zenith, (bins,)."""

    expected: NDArray[np.intp]  # answers that could be had
    answered: Map  # share of them
    zenith: Part
    azimuth: Part


@dataclass(frozen=True, slots=True)
class Score:
    """How good the normals of one or more objects are."""

    cells: Table
    bins: Table

    @property
    def zenith_share(self) -> float:
        """Share of the field's cells whose zenith is good enough."""
        return self._share(self.cells.zenith)

    @property
    def azimuth_share(self) -> float:
        """Share of the field's cells whose azimuth is good enough."""
        return self._share(self.cells.azimuth)

    @property
    def zenith_bias(self) -> float:
        """Mean error of the zenith over all answers, degrees."""
        cells = self.cells
        weight = np.where(cells.expected > 0, cells.expected * cells.answered, 0)
        return float(np.nansum(weight * cells.zenith.bias) / weight.sum()) if weight.sum() else np.nan

    def _share(self, part: Part) -> float:
        judged = self.cells.expected >= FEWEST
        if not judged.any():
            raise ValueError("no cell of the field has enough to judge: press on more of it")
        good = (self.cells.answered >= ANSWERED) & (part.ratio <= ALLOWED)
        return float(np.mean(good[judged]))


class Heights(NamedTuple):
    """How good heights are, mm."""

    bias: float
    rms: float
    answered: float


# --- objects ---------------------------------------------------------------------------------------------


def ball(diameter: float, at: tuple[float, float] = (0.0, 0.0)) -> Surface:
    """Return a ball whose top is at a place."""
    radius = diameter / 2

    def rise(x: Map, y: Map) -> Map:
        square = radius**2 - (x - at[0]) ** 2 - (y - at[1]) ** 2
        return np.sqrt(np.where(square > 0, square, np.nan))

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        above = rise(x, y)
        return (at[0] - x) / above, (at[1] - y) / above

    def height(x: Map, y: Map) -> Map:
        return rise(x, y) - radius

    name = f"ball of {diameter:g} mm at {at[0]:g}, {at[1]:g}"
    return Surface(name, height, slope, _nothing_near, float(np.hypot(*at)) + radius)


def cone(zenith: float, radius: float, at: tuple[float, float] = (0.0, 0.0)) -> Surface:
    """Return a cone, its tip up at a place."""

    def away(x: Map, y: Map) -> Map:
        distance = np.hypot(x - at[0], y - at[1])
        return np.where(distance <= radius, distance, np.nan)

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        fall = -np.tan(zenith) / np.maximum(away(x, y), 1e-12)
        return fall * (x - at[0]), fall * (y - at[1])

    def height(x: Map, y: Map) -> Map:
        return np.asarray(-np.tan(zenith) * away(x, y))

    def clearance(x: Map, y: Map) -> Map:
        distance = np.hypot(x - at[0], y - at[1])
        return np.minimum(distance, np.abs(radius - distance))

    name = f"cone of {np.degrees(zenith):g} deg, {radius:g} mm at {at[0]:g}, {at[1]:g}"
    return Surface(name, height, slope, clearance, float(np.hypot(*at)) + radius)


def facets(zenith: float, pitch: float, turned: float, aside: float, reach: float) -> Surface:
    """Return roofs side by side: flat faces of one zenith that look four ways, within a circle.

    ``turned`` is the azimuth of one set of ridges; ``aside`` the angle by which faces look aside from it.
    """
    steep = np.tan(zenith) * np.array([np.cos(aside), np.sin(aside)])
    to = np.array([[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]])

    def from_ridge(x: Map, y: Map) -> Map:
        along = np.stack([to[0, 0] * x + to[0, 1] * y, to[1, 0] * x + to[1, 1] * y])
        return along - pitch * np.round(along / pitch)

    def height(x: Map, y: Map) -> Map:
        fall = -(steep[:, np.newaxis] * np.abs(from_ridge(x, y)).reshape(2, -1)).sum(axis=0)
        return np.where(np.hypot(x, y) <= reach, fall.reshape(np.shape(x)), np.nan)

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        side = np.where(from_ridge(x, y) < 0, -1.0, 1.0)
        here = np.where(np.hypot(x, y) <= reach, 1.0, np.nan)
        along, across = -steep[0] * side[0] * here, -steep[1] * side[1] * here
        return to[0, 0] * along + to[1, 0] * across, to[0, 1] * along + to[1, 1] * across

    def clearance(x: Map, y: Map) -> Map:
        distance = np.abs(from_ridge(x, y))
        nearest = np.minimum(distance, pitch / 2 - distance).min(axis=0)
        return np.asarray(np.minimum(nearest, reach - np.hypot(x, y)))

    angles = ", ".join(f"{np.degrees(angle):g}" for angle in (zenith, turned, aside))
    return Surface(f"facets of {angles} deg, {pitch:g} mm", height, slope, clearance, reach)


def waves(depth: float, pitch: float, turned: float, reach: float) -> Surface:
    """Return an egg crate, ``depth (cos k u + cos k v - 2)``, k = 2 pi / pitch, within a circle."""
    wave = 2 * np.pi / pitch
    cos, sin = np.cos(turned), np.sin(turned)

    def height(x: Map, y: Map) -> Map:
        u, v = cos * x + sin * y, cos * y - sin * x
        crate = depth * (np.cos(wave * u) + np.cos(wave * v) - 2)
        return np.where(np.hypot(x, y) <= reach, crate, np.nan)

    def slope(x: Map, y: Map) -> tuple[Map, Map]:
        u, v = cos * x + sin * y, cos * y - sin * x
        here = np.where(np.hypot(x, y) <= reach, 1.0, np.nan)
        along, across = (-here * depth * wave * np.sin(wave * part) for part in (u, v))
        return cos * along - sin * across, sin * along + cos * across

    def clearance(x: Map, y: Map) -> Map:
        return reach - np.hypot(x, y)

    name = f"egg crate of {depth:g} mm, {pitch:g} mm, {np.degrees(turned):g} deg"
    return Surface(name, height, slope, clearance, reach)


def _nothing_near(x: Map, y: Map) -> Map:
    return np.full(np.broadcast(x, y).shape, np.inf)


# --- what is seen, and how bright it is ---------------------------------------------------------------------


def pixel_grid(shape: tuple[int, int], pixel_size: float) -> tuple[Map, Map]:
    """Return the x and y at which each pixel's line of sight meets the rest plane, maps of (H, W)."""
    row, column = np.indices(shape, dtype=float)
    return (column - (shape[1] - 1) / 2) * pixel_size, ((shape[0] - 1) / 2 - row) * pixel_size


def sight(rig: Rig, x: Map, y: Map) -> tuple[Map, Map]:
    """Return by how much a line of sight moves along x and y for each millimetre that it rises.

    From the angle inside the body the angle in the air above it follows (Snell), and from both the distance
    from the axis at which the line meets the rest plane: a table, read backwards.
    """
    away = np.hypot(x, y)
    if np.isinf(rig.distance):
        return np.zeros_like(away), np.zeros_like(away)
    meets, inside = _refracted(rig.rim, rig.index, rig.distance)
    towards = np.tan(np.interp(away, meets, inside)) / np.where(away > 0, away, 1)
    return -x * towards, -y * towards


@cache
def _refracted(rim: float, index: float, distance: float) -> tuple[Map, Map]:
    inside = np.linspace(0, 0.95 * np.arcsin(1 / index), _TABLE)
    outside = np.arcsin(index * np.sin(inside))
    return rim * np.tan(inside) + (distance - rim) * np.tan(outside), inside


def see(rig: Rig, thing: Surface, x: Map, y: Map, press: float) -> Seen:
    """Return the point of an object that each pixel sees when the upright body is pressed so far.

    Each round follows the line of sight to the height found before: slopes of lines of sight are small, so
    that the error falls by ten at least.
    """
    slope, up = sight(rig, x, y)
    z = np.zeros(x.shape)
    for _ in range(_ROUNDS):
        z = press + thing.height(x + np.nan_to_num(z) * slope, y + np.nan_to_num(z) * up)
    z = np.where(z >= 0, z, np.nan)
    at_x, at_y = x + z * slope, y + z * up
    along_x, along_y = thing.slope(at_x, at_y)
    zenith = np.arctan(np.hypot(along_x, along_y))
    return Seen(at_x, at_y, z, zenith, np.arctan2(-along_y, -along_x), thing.clearance(at_x, at_y))


def turn(rig: Rig, phase: float) -> Map:
    """Return the matrix that takes a vector of the upright frame to the tilted body's, (3, 3).

    By Rodrigues' formula: the world turns about the level axis 90 degrees ahead of the phase.
    """
    axis = np.array([-np.sin(phase), np.cos(phase), 0.0])
    cross = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + np.sin(rig.tilt) * cross + (1 - np.cos(rig.tilt)) * cross @ cross)


def moved(rig: Rig, point: Map, phase: float) -> Map:
    """Return where a point (3, n) of the upright frame is in the tilted body's."""
    pivot = np.asarray(rig.pivot)[:, np.newaxis]
    return np.asarray(pivot + turn(rig, phase) @ (point - pivot))


class Stand(NamedTuple):
    """How the body stands at a phase, for points of the upright frame."""

    turned: Map  # (3, 3)
    place: Map  # (3, n), of the points in the body's frame
    looks: Map  # (3, n), unit vectors along which they are seen


def stand(rig: Rig, point: Map, phase: float) -> Stand:
    """Lean the body."""
    place = moved(rig, point, phase)
    return Stand(turn(rig, phase), place, _looking(rig, place))


def _foot(where: Stand) -> Map:
    """Return where the lines of sight of points meet the rest plane, (2, n): in which pixel they are seen."""
    return np.asarray(where.place[:2] - where.place[2] * where.looks[:2] / where.looks[2])


def light_of(rig: Rig, where: Stand, zenith: Map, azimuth: Map) -> tuple[Map, NDArray[np.bool_]]:
    """Return the light of mirrors (n,) that face so in the upright frame.

    Beside it whether all light comes from the wall. Scatter is a box from -scatter to scatter in the plane in
    which the height on the wall changes fastest: three points of Gauss' rule for its mean.
    """
    facing = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    normal, place, looks = where.turned @ facing, where.place, where.looks
    ray = looks - 2 * (looks * normal).sum(axis=0) * normal
    steepest = _steepest(rig, place, ray)
    total = np.zeros(place.shape[1:])
    for node, weight in ((-np.sqrt(0.6), 5 / 18), (0.0, 8 / 18), (np.sqrt(0.6), 5 / 18)):
        total += weight * _printed(rig, *_meets(rig, place, _lean(ray, steepest, node * rig.scatter)))
    ends = [_meets(rig, place, _lean(ray, steepest, side * 1.1 * rig.scatter))[2] for side in (-1, 1)]
    inside = np.all([(end >= 0) & (end <= rig.rim) for end in ends], axis=0)
    return total, inside & (place[2] >= 0)


def _looking(rig: Rig, place: Map) -> Map:
    """Return the unit vectors along which points inside the body are seen, (3, n).

    A point off the rest plane is seen along the line through it: found by following that line down.
    """
    x, y, z = place
    foot_x, foot_y = x, y
    for _ in range(5):
        slope, up = sight(rig, foot_x, foot_y)
        foot_x, foot_y = x - z * slope, y - z * up
    return _unit(np.stack([-slope, -up, -np.ones_like(x)]))


def _meets(rig: Rig, place: Map, ray: Map) -> tuple[Map, Map, Map]:
    """Return where rays from points meet the cylinder: cosine and sine of the azimuth there, and height."""
    level = ray[0] ** 2 + ray[1] ** 2
    half = place[0] * ray[0] + place[1] * ray[1]
    chord = rig.radius**2 - place[0] ** 2 - place[1] ** 2
    length = (np.sqrt(half**2 + level * chord) - half) / level
    at = place + length * ray
    return at[0] / rig.radius, at[1] / rig.radius, at[2]


def _printed(rig: Rig, cos: Map, sin: Map, height: Map) -> Map:
    """Return the light of the wall at a place: its print, and the lamps behind it."""
    zenith = np.arctan2(rig.radius, height) / 2
    fraction = (zenith - rig.dark_zenith) / (rig.light_zenith - rig.dark_zenith)
    lamps = 1 + rig.asymmetry * (cos * np.cos(rig.lamp_azimuth) + sin * np.sin(rig.lamp_azimuth))
    return np.asarray(np.clip(fraction, 0, 1) ** rig.gamma * lamps / (1 + abs(rig.asymmetry)))


def _steepest(rig: Rig, place: Map, ray: Map) -> Map:
    """Return the unit vector across a ray towards which its height on the wall rises fastest."""
    first = _unit(np.stack([-ray[1], ray[0], np.zeros_like(ray[0])]))
    second = np.cross(ray, first, axis=0)
    rises = [
        _meets(rig, place, _lean(ray, side, _STEP))[2] - _meets(rig, place, _lean(ray, side, -_STEP))[2]
        for side in (first, second)
    ]
    return _unit(rises[0] * first + rises[1] * second)


def _lean(ray: Map, towards: Map, angle: float) -> Map:
    return np.asarray(np.cos(angle) * ray + np.sin(angle) * towards)


def _unit(vectors: Map) -> Map:
    return np.asarray(vectors / np.sqrt((vectors**2).sum(axis=0)))


# --- what can be known --------------------------------------------------------------------------------------


def bounds(rig: Rig, view: Seen, away: float, edges: tuple[float, float] = (np.inf, np.inf)) -> Bound:
    """Return the bounds of zenith and azimuth where both can be known, each with the other unknown too.

    The point's place is taken for known. ``away`` is how far from a crease, and from where contact ends, a
    pixel must be, mm, and so far inside of the picture its point must stay: ``edges`` are half its width and
    height.
    """
    good, point, zenith, azimuth = _points(rig, view)
    steps = ((_STEP, 0.0), (0.0, _STEP))
    fisher = np.zeros((len(zenith), 2, 2))
    inside = view.clearance[good] >= away
    for phase in rig.phase:
        slopes, here = [], stand(rig, point, phase)
        for up, along in steps:
            ahead, _ = light_of(rig, here, zenith + up, azimuth + along)
            behind, within = light_of(rig, here, zenith - up, azimuth - along)
            slopes.append((ahead - behind) / (2 * _STEP) * rig.span / rig.spread)
        gradient = np.stack(slopes, axis=-1)
        fisher += gradient[:, :, np.newaxis] * gradient[:, np.newaxis, :]
        inside &= within & (here.place[2] >= away * np.tan(zenith))
        for distance, edge in zip(_foot(here), edges, strict=True):
            inside &= np.abs(distance) <= edge - away
    spread = np.full((2, *view.x.shape), np.nan)
    inverse = np.linalg.inv(fisher[inside])
    spread.reshape(2, -1)[:, np.flatnonzero(good)[inside]] = np.sqrt(inverse[:, [0, 1], [0, 1]].T)
    return Bound(*spread)


def _points(rig: Rig, view: Seen) -> tuple[NDArray[np.bool_], Map, Map, Map]:
    """Return which pixels see the object on the body, with their points (3, n), zeniths and azimuths."""
    good = np.isfinite(view.z) & np.isfinite(view.zenith) & (np.hypot(view.x, view.y) < 0.98 * rig.radius)
    good &= (view.zenith > 1e-3) & (view.zenith < np.radians(60))
    point = np.stack([view.x[good], view.y[good], view.z[good]])
    return good, point, view.zenith[good], view.azimuth[good]


# --- judging ------------------------------------------------------------------------------------------------


@dataclass
class Judge:
    """Collects answers of one or more objects, and tells how good they are over the field and over zenith.

    The field is cut into so many cells a side.
    """

    cells: int = 8
    _kept: list[Map] = field(default_factory=list)

    def add(self, zenith: Map, azimuth: Map, view: Seen, bound: Bound, sigma: ArrayLike = 0.0) -> None:
        """Add what was found of an object, maps of (H, W), radians.

        NaN is no answer, and nor is one whose own ``sigma``, the RMS angle between it and the truth that it
        expects, is several times what the bounds allow: it says that it is not to be believed.
        """
        if not zenith.shape == azimuth.shape == view.x.shape:
            raise ValueError(f"maps of {zenith.shape} do not fit the truth's {view.x.shape}")
        row, column = (
            self.cells * place // size
            for place, size in zip(np.indices(view.x.shape), view.x.shape, strict=True)
        )
        here = np.isfinite(bound.zenith)
        around = azimuth - view.azimuth
        poor = np.asarray(sigma) > POOR * np.hypot(bound.zenith, np.sin(view.zenith) * bound.azimuth)
        level = np.where(poor, np.nan, np.asarray(zenith, float) - view.zenith)
        error = level, np.arctan2(np.sin(around), np.cos(around))
        parts = row * self.cells + column, view.zenith, *error, *bound
        self._kept.append(np.stack([np.asarray(part, float)[here] for part in parts]))

    def score(self) -> Score:
        """Return the score of all that was added."""
        kept = np.concatenate(self._kept, axis=1)
        cell, zenith = kept[0].astype(np.intp), np.degrees(kept[1])
        number = np.clip(np.digitize(zenith, ZENITHS) - 1, 0, len(ZENITHS) - 2)
        square = self.cells, self.cells
        return Score(_table(kept[2:], cell, square), _table(kept[2:], number, (len(ZENITHS) - 1,)))


def score_heights(heights: Map, true: Map, where: NDArray[np.bool_]) -> Heights:
    """Return bias and RMS error of heights, mm, where they are asked for."""
    if not where.any():
        raise ValueError("there is no height to judge")
    error = (np.asarray(heights, float) - true)[where]
    finite = error[np.isfinite(error)]
    if finite.size == 0:
        return Heights(np.nan, np.nan, 0.0)
    return Heights(float(finite.mean()), float(np.sqrt(np.mean(finite**2))), finite.size / error.size)


def _table(values: Map, group: NDArray[np.intp], shape: Sequence[int]) -> Table:
    zenith, azimuth, zenith_bound, azimuth_bound = values
    expected = np.bincount(group, minlength=int(np.prod(shape))).reshape(shape)
    finite = np.isfinite(zenith) & np.isfinite(azimuth)
    kept = group[finite]
    answered = np.bincount(kept, minlength=expected.size).reshape(shape)
    parts = [
        _part(error[finite], best[finite], kept, shape)
        for error, best in ((zenith, zenith_bound), (azimuth, azimuth_bound))
    ]
    return Table(expected, answered / np.where(expected > 0, expected, 1), *parts)


def _part(error: Map, best: Map, group: NDArray[np.intp], shape: Sequence[int]) -> Part:
    count = np.bincount(group, minlength=int(np.prod(shape)))

    def mean(part: Map) -> Map:
        total = np.bincount(group, part, minlength=count.size)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)

    rms, smallest = (np.degrees(np.sqrt(mean(part**2))) for part in (error, best))
    return Part(rms, np.degrees(mean(error)), smallest, np.sqrt(mean((error / best) ** 2)))
