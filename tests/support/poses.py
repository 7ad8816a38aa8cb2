"""An object's position in a moved sensor body's frame, and its picture, independent of the code under test.

It shares no code with mirrorskin. All is float64, from first principles, and written to be read; millimetres
and radians, x to the right, y up the picture, z towards the camera.

- In the world's frame z = 0 is where the untouched sheet rests before any travel; objects stand below it.
- The body's frame goes with sheet, lights and camera: z = 0 is the sheet's rest plane, its centre the origin.
- A pose takes points from the world's frame to the body's: ``body = turn @ world + shift``.
- A sheet that takes the object's shape lies on it where it stands above the rest plane, else on that plane.
- An object is known by its upper side, within an edge. A body that leans, or a pinhole, may look at what is
  below that edge; the book only tells where (`Seen.below`).
- Each pixel looks along a line ``(x, y, 0) + height * (view_x, view_y, 1)`` of the body's frame.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Pose(NamedTuple):
    """From the world's frame to the body's."""

    turn: Map  # (3, 3), a rotation
    shift: Map  # (3,), mm

    def to_body(self, points: Map) -> Map:
        """Return points (..., 3) of the world as the body has them."""
        return points @ self.turn.T + self.shift

    def to_world(self, points: Map) -> Map:
        """Return points (..., 3) of the body's frame as the world has them."""
        return (points - self.shift) @ self.turn


def lowered(press: float) -> Pose:
    """Return the body lowered by so many millimetres: what it is pressed on rises in its frame."""
    return Pose(np.eye(3), np.array([0.0, 0.0, press]))


def rotation_z(angle: float) -> Map:
    """Return the rotation about z, counter-clockwise seen from the camera."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def rotation_y(angle: float) -> Map:
    """Return the rotation about y that takes z towards x."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def leaning(phase: float, tilt: float, press: float, pivot: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
    """Return the body lowered, then leaning by the tilt, away from the phase, about a pivot that came along.

    In the body's frame the object leans the other way. A normal at zenith t and azimuth p gets the zenith t'
    with cos t' = cos t cos d - sin t sin d cos(p - phase): eq. 10 of the paper, for one point of the object.
    """
    turn = rotation_z(phase) @ rotation_y(tilt) @ rotation_z(-phase)
    centre = np.asarray(pivot, dtype=float)
    return Pose(turn, turn @ (np.array([0.0, 0.0, press]) - centre) + centre)


def moved_aside(displacement: ArrayLike, press: float) -> Pose:
    """Return the body lowered and moved by (dx, dy): the object moves the other way in its frame."""
    aside_x, aside_y = np.asarray(displacement, dtype=float)
    return Pose(np.eye(3), np.array([-aside_x, -aside_y, press]))


def twisted(twist: float, press: float) -> Pose:
    """Return the body lowered and twisted counter-clockwise about z: in its frame the object turns back."""
    return Pose(rotation_z(-twist), np.array([0.0, 0.0, press]))


class Solid(Protocol):
    """The upper side of a convex object in the world's frame."""

    radius: float  # mm, of its edge as seen from above

    def strike(self, start: Map, along: Map) -> Map:
        """Return t of the last point of rising rays ``start + t * along`` on the surface; NaN without one."""

    def under(self, points: Map) -> Mask:
        """Return which points (..., 3) are below the surface, or below what continues it over the edge."""

    def leave(self, start: Map, along: Map) -> Map:
        """Return t where rising lines go out over the edge as seen from above; NaN where they do not."""

    def normal(self, points: Map) -> Map:
        """Return the unit normals (..., 3) of points (..., 3) on the surface."""

    def sharp(self, points: Map, hair: float) -> Mask:
        """Return which points lie within a hair of an edge or a tip of the surface."""


class Ball:
    """A ball whose top touches the untouched sheet's centre; its edge is the equator."""

    def __init__(self, radius: float = 5.0) -> None:
        self.radius = radius
        self.centre = np.array([0.0, 0.0, -radius])

    def strike(self, start: Map, along: Map) -> Map:
        """Solve ``|start + t along - centre| = radius``."""
        from_centre = start - self.centre
        linear = _dot(from_centre, along)
        square = _dot(along, along)
        discriminant = linear**2 - square * (_dot(from_centre, from_centre) - self.radius**2)
        t = (np.sqrt(_or_nan(discriminant, discriminant >= 0)) - linear) / square
        return _or_nan(t, start[..., 2] + t * along[..., 2] > self.centre[2])

    def under(self, points: Map) -> Mask:
        """Tell what is in the ball, or below the plane of the equator."""
        return np.asarray(
            (np.linalg.norm(points - self.centre, axis=-1) < self.radius) | (points[..., 2] < self.centre[2])
        )

    def leave(self, start: Map, along: Map) -> Map:
        """Cut the line with the upright cylinder."""
        return _in_cylinder(start, along, self.radius)[1]

    def normal(self, points: Map) -> Map:
        """Point away from the centre."""
        return np.asarray((points - self.centre) / self.radius)

    def sharp(self, points: Map, hair: float) -> Mask:
        """Tell what is near the equator."""
        return np.asarray(np.hypot(points[..., 0], points[..., 1]) > self.radius - hair)


class Cone:
    """A cone that falls from its tip at the untouched sheet's centre; its edge is the base."""

    def __init__(self, zenith: float = np.radians(30), radius: float = 5.0) -> None:
        self.zenith, self.radius = zenith, radius

    def strike(self, start: Map, along: Map) -> Map:
        """Solve ``z^2 = tan^2(zenith) (x^2 + y^2)`` for z <= 0: the double cone without its upper half."""
        scale = np.array([np.tan(self.zenith), np.tan(self.zenith), 1.0])
        flip = np.array([-1.0, -1.0, 1.0])
        place, ray = start * scale, along * scale
        square, linear, constant = (
            np.sum(flip * first * second, axis=-1)
            for first, second in ((ray, ray), (ray, place), (place, place))
        )
        # A ray steeper than the cone's sides meets each half once; rounding may leave less than 0 at the tip.
        assert np.all(square > 0)
        root = np.sqrt(np.maximum(linear**2 - square * constant, 0.0))
        t = (-linear - root) / square
        points = start + t[..., np.newaxis] * along
        return _or_nan(t, np.hypot(points[..., 0], points[..., 1]) <= self.radius)

    def under(self, points: Map) -> Mask:
        """Tell what is in the endless cone."""
        distance = np.hypot(points[..., 0], points[..., 1])
        return np.asarray(points[..., 2] < -np.tan(self.zenith) * distance)

    def leave(self, start: Map, along: Map) -> Map:
        """Cut the line with the upright cylinder."""
        return _in_cylinder(start, along, self.radius)[1]

    def normal(self, points: Map) -> Map:
        """Lean outwards by the zenith; no direction can be given at the tip."""
        azimuth = np.arctan2(points[..., 1], points[..., 0])
        return _direction(np.full_like(azimuth, self.zenith), azimuth)

    def sharp(self, points: Map, hair: float) -> Mask:
        """Tell what is near the tip or the rim of the base."""
        distance = np.hypot(points[..., 0], points[..., 1])
        return np.asarray((distance < hair) | (distance > self.radius - hair))


class Plate:
    """A tilted flat plate, round from above; what of it would be above the untouched sheet is cut off."""

    def __init__(
        self,
        zenith: float = np.radians(20),
        azimuth: float = np.radians(30),
        reach: float = 5.0,
        radius: float = 15.0,
    ) -> None:
        self.reach, self.radius = reach, radius
        self.facing = _direction(np.float64(zenith), np.float64(azimuth))
        # The straight edge passes the centre at that distance, on the side that the plate faces away from.
        self.downhill = np.array([np.cos(azimuth), np.sin(azimuth)])
        self.anchor = np.array([*(-reach * self.downhill), 0.0])

    def strike(self, start: Map, along: Map) -> Map:
        """Solve ``facing . (start + t along - anchor) = 0``."""
        t = _dot(self.anchor - start, self.facing) / _dot(along, self.facing)
        return _or_nan(t, self._inside(start + t[..., np.newaxis] * along) >= 0)

    def under(self, points: Map) -> Mask:
        """Tell what is behind the endless plane."""
        return np.asarray((points - self.anchor) @ self.facing < 0)

    def leave(self, start: Map, along: Map) -> Map:
        """Cut the line with the upright cylinder, and with the upright plane through the straight edge."""
        first, last = _in_cylinder(start, along, self.radius)
        depth, speed = start[..., :2] @ self.downhill + self.reach, along[..., :2] @ self.downhill
        crossing = -depth / np.where(speed == 0, np.nan, speed)
        first = np.where(speed > 0, np.fmax(first, crossing), first)
        last = np.where(speed < 0, np.fmin(last, crossing), last)
        # A line beside the straight edge never meets it, and stays on its side.
        return _or_nan(last, (first < last) & ((speed != 0) | (depth > 0)))

    def normal(self, points: Map) -> Map:
        """Face one way everywhere."""
        return np.broadcast_to(self.facing, points.shape)

    def sharp(self, points: Map, hair: float) -> Mask:
        """Tell what is near the edges."""
        return np.asarray(self._inside(points) < hair)

    def _inside(self, points: Map) -> Map:
        """Return how far inside the edges points are as seen from above, mm."""
        round_edge = self.radius - np.hypot(points[..., 0], points[..., 1])
        return np.asarray(np.minimum(round_edge, points[..., :2] @ self.downhill + self.reach))


class Seen(NamedTuple):
    """What pixels see, maps of the pixels' shape; an untouched sheet lies level at height 0."""

    height: Map  # mm above the rest plane, 0 or more
    zenith: Map
    azimuth: Map  # NaN where the sheet is level
    contact: Mask
    normal: Map  # (..., 3), unit, body's frame
    place: Map  # (..., 3): the object's point in the world's frame, NaN without contact
    below: Mask  # no contact, but the line goes on to what is below the object's edge


def see(solid: Solid, pose: Pose, x: Map, y: Map, view: tuple[ArrayLike, ArrayLike] = (0.0, 0.0)) -> Seen:
    """Return what the camera sees along the lines ``(x, y, 0) + height * (view_x, view_y, 1)``."""
    x, y, view_x, view_y = np.broadcast_arrays(x, y, *(np.asarray(part, dtype=float) for part in view))
    on_plane = np.stack([x, y, np.zeros_like(x)], axis=-1)
    along = np.stack([view_x, view_y, np.ones_like(x)], axis=-1)
    start, ray = pose.to_world(on_plane), along @ pose.turn
    struck = solid.strike(start, ray)  # the body's frame has z = t on such a line
    contact = struck >= 0  # False for NaN
    place = _or_nan(start + struck[..., np.newaxis] * ray, contact[..., np.newaxis])
    # Coming down, the line passes the edge as seen from above, and is already below the surface there.
    last = solid.leave(start, ray)
    below = (last >= 0) & solid.under(start + last[..., np.newaxis] * ray) & ~contact
    upright = np.array([0.0, 0.0, 1.0])
    normal = np.where(contact[..., np.newaxis], solid.normal(place) @ pose.turn.T, upright)
    zenith, azimuth = angles(normal)
    return Seen(np.where(contact, struck, 0.0), zenith, azimuth, contact, normal, place, below)


def clear(
    solid: Solid,
    pose: Pose,
    x: Map,
    y: Map,
    view: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    *,
    hair: float,
    edge: float,
) -> Mask:
    """Return which pixels are more than a hair from where contact ends, and so far from the object's edges.

    Brute force: five lines of sight, moved by a hair, touch or not as the pixel's own does. What sees
    something below the object's edge is not clear either.
    """
    sight = see(solid, pose, x, y, view)
    fine = ~(sight.contact & solid.sharp(sight.place, edge)) & ~sight.below
    for angle in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        beside = see(solid, pose, x + hair * np.cos(angle), y + hair * np.sin(angle), view)
        fine &= (beside.contact == sight.contact) & ~beside.below
    return np.asarray(fine)


def angles(normal: Map) -> tuple[Map, Map]:
    """Return zenith and azimuth of normals (..., 3); the azimuth of an upright one is NaN."""
    level = np.hypot(normal[..., 0], normal[..., 1])
    azimuth = np.arctan2(normal[..., 1], normal[..., 0])
    return np.arctan2(level, normal[..., 2]), _or_nan(azimuth, level > 0)


def between(first: Map, second: Map) -> Map:
    """Return the angle between vectors (..., 3); exact for small angles, too."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, _dot(first, second)))


def normals(dz_dx: Map, dz_dy: Map) -> Map:
    """Return the unit normals (..., 3) of a surface with these slopes."""
    steep = np.stack([-dz_dx, -dz_dy, np.ones_like(dz_dx)], axis=-1)
    return np.asarray(steep / np.linalg.norm(steep, axis=-1, keepdims=True))


def _direction(zenith: Map | np.float64, azimuth: Map | np.float64) -> Map:
    parts = (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith))
    return np.stack(parts, axis=-1)


def _in_cylinder(start: Map, along: Map, radius: float) -> tuple[Map, Map]:
    """Return t where lines enter an upright cylinder round the z axis and leave it; NaN where they do not."""
    square = np.sum(along[..., :2] ** 2, axis=-1)
    linear = np.sum(start[..., :2] * along[..., :2], axis=-1)
    discriminant = linear**2 + square * (radius**2 - np.sum(start[..., :2] ** 2, axis=-1))
    root = np.sqrt(_or_nan(discriminant, discriminant > 0))  # 0 for upright lines
    return (-linear - root) / _or_nan(square, square > 0), (-linear + root) / _or_nan(square, square > 0)


def _dot(first: Map, second: Map) -> Map:
    return np.asarray(np.sum(first * second, axis=-1))


def _or_nan(values: Map, where: Mask) -> Map:
    return np.where(where, values, np.nan)
