"""Objects with known creases, and the accuracy of lines drawn on a map of normals.

It shares no code with mirrorskin. All is float64: millimetres, x to the right, y up the picture, z to the
camera; places on the picture are (row, column) of pixel centres. The objects are heights and slopes by
formula, piece by piece, so that the twin can be pressed on them, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from poses import Pose, leaning
from scipy.spatial import cKDTree

from mirrorskin.evaluation.scenes.rotations import between

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
Touch = Callable[[Map, Map], Mask]

JUMP = np.radians(10)


class Relief(Protocol):
    """An object made of smooth pieces; its highest point is at z = 0."""

    name: str
    radius: float  # of the circle that holds it
    tips: tuple[tuple[float, float], ...]  # x, y of points round which the normal turns at once

    def height(self, x: Map, y: Map) -> Map:
        """Return z; NaN where there is nothing."""

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        """Return dz/dx and dz/dy."""

    def piece(self, x: Map, y: Map) -> NDArray[np.intp]:
        """Return the number of the piece."""


@dataclass(frozen=True)
class Facets:
    """The lowest of some planes through the top, down to a level floor.

    Each plane falls in a direction (its azimuth) at a steepness (its zenith), both in degrees.
    """

    planes: tuple[tuple[float, float], ...]
    floor: float
    name: str = "facets"
    radius: float = 8.0
    tips: tuple[tuple[float, float], ...] = ()

    def _all(self, x: Map, y: Map) -> tuple[Map, Map]:
        zenith, azimuth = np.radians(np.array(self.planes)).T
        falls = np.tan(zenith)[:, np.newaxis] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        falls = np.concatenate([-falls, np.zeros((1, 2))])
        heights = [along * x + across * y for along, across in falls[:-1]]
        return np.stack(heights), falls

    def piece(self, x: Map, y: Map) -> NDArray[np.intp]:
        """Number the planes, then the floor."""
        heights, _ = self._all(x, y)
        return np.where(heights.min(axis=0) < -self.floor, len(self.planes), heights.argmin(axis=0))

    def height(self, x: Map, y: Map) -> Map:
        """Return the lowest plane, not below the floor."""
        heights, _ = self._all(x, y)
        return np.maximum(heights.min(axis=0), -self.floor)

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        """Return that of the piece."""
        _, falls = self._all(x, y)
        along, across = np.moveaxis(falls[self.piece(x, y)], -1, 0)
        return along, across


@dataclass(frozen=True)
class Profile:
    """Straight pieces from node to node (place, height), turned round the centre or drawn along a direction.

    ``azimuth`` in degrees is the way across the ridges; None turns the profile. It goes on as it ends.
    """

    nodes: tuple[tuple[float, float], ...]
    azimuth: float | None = None
    name: str = "profile"
    radius: float = 8.0
    tips: tuple[tuple[float, float], ...] = ()
    ends: bool = False  # whether nothing is beyond the last node

    def _place(self, x: Map, y: Map) -> tuple[Map, Map, Map]:
        """Return the place on the profile, and the direction in which it grows."""
        if self.azimuth is None:
            place = np.hypot(x, y)
            far = np.where(place == 0, 1.0, place)
            return place, x / far, y / far
        cosine, sine = np.cos(np.radians(self.azimuth)), np.sin(np.radians(self.azimuth))
        return x * cosine + y * sine, np.full_like(x, cosine), np.full_like(x, sine)

    def piece(self, x: Map, y: Map) -> NDArray[np.intp]:
        """Number the pieces along the profile."""
        places = np.array(self.nodes)[:, 0]
        return np.searchsorted(places[1:-1], self._place(x, y)[0])

    def height(self, x: Map, y: Map) -> Map:
        """Follow the piece's straight line."""
        nodes = np.array(self.nodes)
        place, _, _ = self._place(x, y)
        number = self.piece(x, y)
        height = nodes[number, 1] + self._steepness()[number] * (place - nodes[number, 0])
        return np.where(self.ends & (place > nodes[-1, 0]), np.nan, height)

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        """Return the piece's steepness along the profile's direction."""
        _, cosine, sine = self._place(x, y)
        steepness = self._steepness()[self.piece(x, y)]
        return steepness * cosine, steepness * sine

    def _steepness(self) -> Map:
        places, heights = np.array(self.nodes).T
        return np.asarray(np.diff(heights) / np.diff(places))


@dataclass(frozen=True)
class Dome:
    """A cap of a ball on a level plate."""

    ball: float
    base: float  # radius of the cap's foot
    name: str = "dome"
    radius: float = 8.0
    tips: tuple[tuple[float, float], ...] = ()

    def piece(self, x: Map, y: Map) -> NDArray[np.intp]:
        """Number the cap 0, the plate 1."""
        return (np.hypot(x, y) > self.base).astype(np.intp)

    def height(self, x: Map, y: Map) -> Map:
        """Return the ball's height within the foot, that of the foot beyond."""
        within = np.minimum(np.hypot(x, y), self.base)
        return np.sqrt(self.ball**2 - within**2) - self.ball

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        """Point outwards on the cap."""
        rise = np.where(self.piece(x, y) == 0, self.height(x, y) + self.ball, np.inf)
        return -x / rise, -y / rise


def fall(*pieces: tuple[float, float], start: float = 0.0) -> tuple[tuple[float, float], ...]:
    """Return the nodes of pieces (width, zenith in degrees, negative uphill); the highest is at 0."""
    places = start + np.cumsum([0.0, *(width for width, _ in pieces)])
    heights = -np.cumsum([0.0, *(width * np.tan(np.radians(zenith)) for width, zenith in pieces)])
    return tuple(zip(places.tolist(), (heights - heights.max()).tolist(), strict=True))


def normals(relief: Relief, x: Map, y: Map) -> Map:
    """Return unit normals (..., 3)."""
    along, across = relief.slope(x, y)
    steep = np.stack([-along, -across, np.ones_like(along)], axis=-1)
    return np.asarray(steep / np.linalg.norm(steep, axis=-1, keepdims=True))


def pressed(relief: Relief, press: float) -> Touch:
    """Tell what an upright body touches."""

    def touch(x: Map, y: Map) -> Mask:
        return relief.height(x, y) >= -press  # False for NaN

    return touch


def turned(relief: Relief, press: float, phases: tuple[float, ...], tilt: float) -> Touch:
    """Tell what the rotating body touches in all of its poses: the object comes up through the rest plane."""
    poses = [leaning(phase, tilt, press) for phase in phases]

    def under(pose: Pose, x: Map, y: Map) -> Mask:
        world_x, world_y, world_z = np.moveaxis(
            pose.to_world(np.stack([x, y, np.zeros_like(x)], axis=-1)), -1, 0
        )
        return np.asarray(world_z <= relief.height(world_x, world_y))

    def touch(x: Map, y: Map) -> Mask:
        return np.all([under(pose, x, y) for pose in poses], axis=0)

    return touch


class Lines(NamedTuple):
    """Where lines should be: points of (row, column), close together, and points round which all is one."""

    points: Map  # (n, 2)
    tips: Map  # (m, 2)


def edges_of(
    relief: Relief, touch: Touch, shape: tuple[int, int], pixel: float, fine: int = 4, jump: float = JUMP
) -> Lines:
    """Find where the normal jumps, or contact ends, by brute force on a grid so many times finer."""
    rows, columns = np.meshgrid(*(np.arange((size - 1) * fine + 1) / fine for size in shape), indexing="ij")
    x = (columns - 0.5 * (shape[1] - 1)) * pixel
    y = (0.5 * (shape[0] - 1) - rows) * pixel
    facing, piece, touched = normals(relief, x, y), relief.piece(x, y), touch(x, y)
    lines = []
    for first, second in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
    ):
        creased = (piece[first] != piece[second]) & (between(facing[first], facing[second]) > jump)
        line = (touched[first] & touched[second] & creased) | (touched[first] != touched[second])
        middle = [(place[first] + place[second]) / 2 for place in (rows, columns)]
        lines.append(np.stack(middle, axis=-1)[line])
    tips = np.array(
        [(0.5 * (shape[0] - 1) - y / pixel, 0.5 * (shape[1] - 1) + x / pixel) for x, y in relief.tips]
    )
    return Lines(np.concatenate(lines), tips.reshape(-1, 2))


class Agreement(NamedTuple):
    """How well drawn pixels follow lines; 1 and 1 where there is nothing and nothing was drawn."""

    recall: float  # share of the lines' points with a drawn pixel within the reach
    precision: float  # share of the drawn pixels with a point of a line within it
    thickness: float  # drawn pixels along a pixel's length of the lines


def agreement(drawn: NDArray[np.uint8], lines: Lines, reach: float = 1.0, fine: int = 4) -> Agreement:
    """Compare a map of edges with the lines; pixels within 4 of a tip are neither right nor wrong."""
    pixels = np.argwhere(drawn != 0).astype(float)
    reach += 0.5 / fine
    if len(lines.tips) and len(pixels):
        pixels = pixels[cKDTree(lines.tips).query(pixels)[0] > 4]
    if len(lines.points) == 0 or len(pixels) == 0:
        nothing = float(len(lines.points) == len(pixels))
        return Agreement(nothing, nothing, nothing)
    to_pixel, _ = cKDTree(pixels).query(lines.points)
    to_line, _ = cKDTree(lines.points).query(pixels)
    # A line at an angle crosses |cos| + |sin| rows and columns in its length: as many as there are points.
    length = len(np.unique(np.rint(lines.points).astype(int), axis=0))
    return Agreement(
        float(np.mean(to_pixel <= reach)), float(np.mean(to_line <= reach)), len(pixels) / length
    )


# Zenith jumps of 8 degrees and less are none; 12.5 and more are.
PYRAMID = Facets(((30, 20), (30, 110), (30, 200), (30, 290)), floor=1.2, name="pyramid")
HIP_ROOF = Facets(((25, 65), (38, 245), (20, 155), (33, 335)), floor=1.5, name="hip roof")
FRUSTUM = Profile(fall((1.1, 0), (1.3, 35)), name="frustum", ends=True)
CONE = Profile(fall((1.9, 25), (4.0, 0)), name="cone on a plate", tips=((0.0, 0.0),))
DOME = Dome(4.0, 2.2)
SMOOTH = Dome(9.0, 8.0, name="nothing but a ball")
WASHBOARD = Profile(
    fall((1.4, 0), (0.9, 8), (0.9, 20.5), (1.1, -8), (0.8, 0), (2.0, 7), start=-3.0),
    azimuth=33.0,
    name="washboard",
)
GENTLE = Profile(
    fall((1.6, 0), (1.2, 5), (1.0, 30), (1.0, 0), (0.8, -4), (2.0, 0), start=-3.2),
    azimuth=-62.0,
    name="gentle and steep",
)
RELIEFS = (PYRAMID, HIP_ROOF, FRUSTUM, CONE, DOME, SMOOTH, WASHBOARD, GENTLE)
