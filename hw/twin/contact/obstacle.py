"""The object as the sensor's body meets it: its surface in the body's frame, along the camera's view."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import elementwise

from mirrorskin.hw.twin.movement import Pose
from mirrorskin.hw.twin.objects import Object
from mirrorskin.hw.twin.view import View
from mirrorskin.io.types import Floats

STEEP = 1e6  # a slope that no mirror shows, for the very edge of an object, where it has none

_NOWHERE = 1e3  # "far below", in mm, for where there is no object
_PRECISION = 1e-9  # of a height, mm
_JUMP = 1e-6  # more than G can be, by the precision, on any slope up to STEEP / 1000


class Obstacle(NamedTuple):
    """What of the object stands above the sheet's rest plane, maps of (H, W), float64.

    ``height`` is NaN where nothing does, and so are the slopes there.
    """

    height: Floats
    dz_dx: Floats
    dz_dy: Floats


def meet(thing: Object, pose: Pose, view: View) -> Obstacle:
    """Find the uppermost point of the object on each ray, where that is above the rest plane.

    In the object's frame a ray is a straight line, which a surface ``z = f(x, y)`` meets where ::

        G(l) = z(l) - f(x(l), y(l)) = 0

    with l the height in the body's frame. Rays that are upright there need no search. The others are followed
    down from the object's highest point by steps of at most a pixel to the first change of sign of G, which
    is then narrowed down to 1e-9 mm (Chandrupatla's method). Where G jumps, the ray meets an upright side of
    the object, which is as steep as can be. What a ray meets and leaves again within a pixel it misses.

    Parameters
    ----------
    thing : Object
    pose : Pose
    view : View
        The rays; its pixels tell what no part of the object is smaller than.

    Returns
    -------
    Obstacle
    """
    # Row vectors times the rotation are vectors turned back, into the object's frame.
    start = _stack(view.x, view.y, np.zeros_like(view.x)) - pose.shift
    foot = start @ pose.rotation
    lean = _stack(view.slope_x, view.slope_y, np.ones_like(view.x)) @ pose.rotation
    x, y, z = foot[..., 0], foot[..., 1], foot[..., 2]
    if lean[..., :2].any():
        height, side = _search(thing, foot, lean, min(view.pixel_size))
        x, y = x + height * lean[..., 0], y + height * lean[..., 1]
    else:
        height, side = (thing.height(x, y) - z) / lean[..., 2], np.zeros(x.shape, bool)
    here = height >= 0
    slopes = _slopes(thing, pose, np.where(here, x, np.nan), np.where(here, y, np.nan))
    dz_dx, dz_dy = (np.where(here, np.where(side, STEEP, slope), np.nan) for slope in slopes)
    return Obstacle(np.where(here, height, np.nan), dz_dx, dz_dy)


def _stack(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.stack([x, y, z], axis=-1)


def _above(thing: Object, x: Floats, y: Floats, z: Floats) -> Floats:
    """Tell how far a point is above the surface, mm; far, where there is no object."""
    distance = z - thing.height(x, y)
    return np.where(np.isnan(distance), _NOWHERE, distance)


def _search(thing: Object, foot: Floats, lean: Floats, pixel: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Find the uppermost height above 0 at which each ray meets the object, and whether at an upright side.

    The height is NaN where a ray does not meet it.
    """
    shape, foot, lean = foot.shape[:-1], foot.reshape(-1, 3), lean.reshape(-1, 3)
    top = -foot[:, 2] / lean[:, 2]  # the object's highest point is at z = 0 of its own frame
    found, side = np.full(len(foot), np.nan), np.zeros(len(foot), bool)
    rays = np.flatnonzero(top > 0)
    if rays.size == 0:
        return found.reshape(shape), side.reshape(shape)
    sideways = float(np.max(top[rays] * np.hypot(lean[rays, 0], lean[rays, 1])))
    steps = max(1, math.ceil(sideways / pixel))

    def gap(height: Floats, *ray: Floats) -> Floats:
        x, y, z, lean_x, lean_y, lean_z = ray
        return _above(thing, x + height * lean_x, y + height * lean_y, z + height * lean_z)

    upper = top[rays]
    for step in range(1, steps + 1):
        lower = top[rays] * (1 - step / steps)
        line = (*foot[rays].T, *lean[rays].T)
        inside = gap(lower, *line) <= 0
        hit = elementwise.find_root(
            gap,
            (lower[inside], upper[inside]),
            args=tuple(part[inside] for part in line),
            tolerances={"xatol": _PRECISION, "fatol": 0.0},
        )
        found[rays[inside]] = hit.x
        side[rays[inside]] = np.abs(hit.f_x) > _JUMP
        rays, upper = rays[~inside], lower[~inside]
    return found.reshape(shape), side.reshape(shape)


def _slopes(thing: Object, pose: Pose, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the slopes in the body's frame at points of the object's own."""
    along_x, along_y = thing.slope(x, y)
    if pose.upright:
        return _known(along_x), _known(along_y)
    normal = _stack(-_known(along_x), -_known(along_y), np.ones_like(x)) @ pose.rotation.T
    facing = np.maximum(normal[..., 2], 1 / STEEP)  # what faces away is as steep as can be
    return -normal[..., 0] / facing, -normal[..., 1] / facing


def _known(slope: Floats) -> Floats:
    return np.nan_to_num(slope, nan=STEEP, posinf=STEEP, neginf=-STEEP)
