"""Exact geometry of a ball, a cone and a plane under the sensor, independent of the code under test.

It shares no code with mirrorskin, so that what it says of the twin and of the engine is a second opinion.
All is float64, from first principles, and written to be read:

- millimetres and radians; x to the right, y up the picture, z towards the camera; the origin lies under the
  picture's centre, z = 0 where the untouched sheet rests;
- a surface faces the camera with its normal (sin zenith cos azimuth, sin zenith sin azimuth, cos zenith).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float64]

# Counts without light and in full light, by the type of a sample.
LEVELS = {"uint8": (16, 224), "uint16": (256, 3584), "float32": (16, 224)}

SPHERE_RADIUS = 5.0
CONE_STEEPNESS, CONE_BASE_RADIUS = np.radians(30), 5.0
PLANE_ZENITH, PLANE_AZIMUTH = np.radians(20), np.radians(30)


class Surface(NamedTuple):
    """A surface at the pixel centres, maps of (H, W); NaN where there is none."""

    height: Map
    zenith: Map
    azimuth: Map  # NaN also where the surface is level


def pixel_centres(shape: tuple[int, int], pixel_size: float) -> tuple[Map, Map]:
    """Return the x and y of each pixel's centre, maps of (H, W)."""
    rows, columns = shape
    row, column = np.indices(shape, dtype=float)
    # The picture's centre lies at the middle of its outermost pixels' centres.
    return (column - 0.5 * (columns - 1)) * pixel_size, (0.5 * (rows - 1) - row) * pixel_size


def sphere(shape: tuple[int, int], pixel_size: float) -> Surface:
    """Return a ball of 10 mm: at distance q from its axis the normal leans outwards by asin(q / r)."""
    x, y = pixel_centres(shape, pixel_size)
    distance = np.hypot(x, y)
    distance[distance >= SPHERE_RADIUS] = np.nan
    zenith = np.arcsin(distance / SPHERE_RADIUS)
    return Surface(SPHERE_RADIUS * (np.cos(zenith) - 1), zenith, _outwards(x, y, distance))


def cone(shape: tuple[int, int], pixel_size: float) -> Surface:
    """Return a cone that falls 30 degrees steeply to a base of 5 mm radius; its very tip counts as level."""
    x, y = pixel_centres(shape, pixel_size)
    distance = np.hypot(x, y)
    distance[distance > CONE_BASE_RADIUS] = np.nan
    zenith = CONE_STEEPNESS * np.sign(distance)
    return Surface(-distance * np.tan(CONE_STEEPNESS), zenith, _outwards(x, y, distance))


def plane(shape: tuple[int, int], pixel_size: float) -> Surface:
    """Return a plane facing 20 degrees off the camera, towards 30 degrees, that touches the field's corner.

    That is the lower left corner, half a pixel beyond the last centre: the plane falls to the upper right.
    """
    x, y = pixel_centres(shape, pixel_size)
    corner_x, corner_y = -0.5 * shape[1] * pixel_size, -0.5 * shape[0] * pixel_size
    normal = (
        np.sin(PLANE_ZENITH) * np.cos(PLANE_AZIMUTH),
        np.sin(PLANE_ZENITH) * np.sin(PLANE_AZIMUTH),
        np.cos(PLANE_ZENITH),
    )
    # Points p of a plane through the corner: normal . (p - corner) = 0.
    height = -(normal[0] * (x - corner_x) + normal[1] * (y - corner_y)) / normal[2]
    return Surface(height, np.full(shape, PLANE_ZENITH), np.full(shape, PLANE_AZIMUTH))


SURFACES: dict[str, Callable[[tuple[int, int], float], Surface]] = {
    "sphere": sphere,
    "cone": cone,
    "plane": plane,
}


def response(zenith: Map) -> Map:
    """Return the share of full light, 0 to 1, that a sheet of this zenith sends to the camera; 0 for NaN.

    The camera looks straight down, so a mirror leaning by t shows what lies 2 t off the axis. The lit wall is
    a cylinder 35 mm across and 40 mm high. Seen from the centre of its floor it spans from its rim,
    atan(17.5 / 40) off the axis, to the horizon, 90 degrees off it. The mirror blurs evenly over 6 degrees:
    the camera gets the share of a fan, from 2 t - 3 to 2 t + 3 degrees, that falls on the wall. That share
    rises and falls in straight lines: 0 until the fan touches the rim, 1 once all of it is past; likewise at
    the horizon.
    """
    rim, horizon, blur = np.degrees(np.arctan(17.5 / 40)), 90.0, 3.0
    ray = 2 * np.degrees(zenith)
    fraction: Map = np.interp(
        ray, [rim - blur, rim + blur, horizon - blur, horizon + blur], [0.0, 1.0, 1.0, 0.0]
    )
    return np.where(np.isnan(zenith), 0.0, fraction)


def light_level(zenith: Map, dark: float, bright: float) -> Map:
    """Return the counts, free of noise and not rounded, of a sheet that lies on a surface of this zenith."""
    return dark + (bright - dark) * response(zenith)


def first_contact(height: Map, travel: Map) -> NDArray[np.intp]:
    """Return the first frame whose travel has reached the surface; len(travel) where none has.

    The sheet, lowered by s, has come down to z = -s wherever nothing has met it (eq. 1 and 2 of the paper).
    """
    reached = travel[:, np.newaxis, np.newaxis] >= -height  # False for NaN
    return np.where(reached.any(axis=0), reached.argmax(axis=0), len(travel))


def first_light(surface: Surface, travel: Map, threshold: float = 0.5) -> NDArray[np.intp]:
    """Return the first frame that is light, free of noise; len(travel) where none is.

    Light is a response of at least the threshold: surfaces too level or too steep stay dark in contact.
    """
    light = response(surface.zenith) >= threshold
    return np.where(light, first_contact(surface.height, travel), len(travel))


def _outwards(x: Map, y: Map, distance: Map) -> Map:
    return np.where(distance > 0, np.arctan2(y, x), np.nan)
