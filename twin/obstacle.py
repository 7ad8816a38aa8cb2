"""The surface of an object in the frame of the sensor's body, along the camera's lines of sight."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.twin.movement import TILT_MAX, Pose
from mirrorskin.twin.objects import Object
from mirrorskin.twin.view import View

STEEP = 1e6  # slope at the very edge of an object, where it is undefined; no mirror shows it

_FAR_BELOW = 1e3  # "far below", mm, where there is no object
_PRECISION = 1e-9  # tolerance of a height, mm
_RAYS = 32768  # rays processed at a time, so that their data fit into the processor's cache
_SECANTS = 5  # secant steps that reduce an error of a millimetre to the tolerance on a smooth surface
_JUMP = 1e-6  # larger than G can be at the tolerance on any slope up to STEEP / 1000


class Obstacle(NamedTuple):
    """The part of an object above the sheet's rest plane, maps of (H, W), float64.

    ``height`` and the slopes are NaN elsewhere.
    """

    height: Floats
    dz_dx: Floats
    dz_dy: Floats


class _Vectors(NamedTuple):
    """A vector for each ray; a component that is the same for all is one number."""

    x: Any
    y: Any
    z: Any

    def of(self, rays: NDArray[np.intp]) -> _Vectors:
        """Return the vectors of some rays, numbered in C order."""
        return _Vectors(*(part if np.ndim(part) == 0 else part.ravel()[rays] for part in self))


class _End(NamedTuple):
    """Heights on some rays, and G there."""

    height: Floats
    gap: Floats


def meet(thing: Object, pose: Pose, view: View) -> Obstacle:
    """Return the uppermost point of the object on each ray, where it is above the rest plane.

    In the object's frame a ray is a straight line. It meets a surface ``z = f(x, y)`` where ::

        G(l) = z(l) - f(x(l), y(l)) = 0

    with l the height in the body's frame. Rays that are vertical there need no search. The others are
    followed downwards from the object's highest point in steps of at most a pixel to the first change of sign
    of G, which is then refined to 1e-9 mm by secants, or, where these do not converge, by Chandrupatla's
    method. Where G jumps, the ray meets a vertical side of the object. Intersections shorter than a pixel are
    missed.
    """
    inside, sideways = np.zeros(view.shape, bool), 0.0
    for first in range(0, inside.size, _RAYS):
        some = slice(first, first + _RAYS)
        origin, lean = _rays(pose, view, some)
        inside.ravel()[some] = _gap(thing, origin, lean, np.zeros(1)) <= 0
        sideways = max(sideways, float(np.max(-origin.z / lean.z * np.sqrt(lean.x**2 + lean.y**2))))
    maps = np.full((3, *view.shape), np.nan)
    reach = math.ceil(sideways / min(view.pixel_size)) if sideways > 0 else 0
    near = np.flatnonzero(_spread(inside, reach) if reach else inside)
    for first in range(0, near.size, _RAYS):
        pixels = near[first : first + _RAYS]
        _meet(thing, pose, *_rays(pose, view, pixels), reach, pixels, maps.reshape(3, -1))
    return Obstacle(*maps)


def _rays(pose: Pose, view: View, pixels: NDArray[np.intp] | slice) -> tuple[_Vectors, _Vectors]:
    """Return start and direction of the rays of some pixels in the object's frame."""
    right, down = view.x.ravel()[pixels] - pose.shift[0], view.y.ravel()[pixels] - pose.shift[1]
    # Row vectors times the rotation are vectors in the inverse rotation.
    origin = (right * to[0] + down * to[1] - pose.shift[2] * to[2] for to in pose.rotation.T)
    if view.orthographic:
        return _Vectors(*origin), _Vectors(*pose.rotation[2])
    away, up = view.slope_x.ravel()[pixels], view.slope_y.ravel()[pixels]
    return _Vectors(*origin), _Vectors(*(away * to[0] + up * to[1] + to[2] for to in pose.rotation.T))


def _spread(inside: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Add to the rays that start inside the object those near them, and those near the picture's edge.

    No other ray can meet it: everything below a point of the surface is inside the object, including the
    point of the rest plane vertically below it, which is at most as far away as the lateral shift of a ray.
    """
    import cv2

    far = math.ceil(reach / math.cos(TILT_MAX)) + 1
    square = np.ones((2 * far + 1, 2 * far + 1), np.uint8)
    near = cv2.dilate(inside.view(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(near, bool)


def _meet(
    thing: Object,
    pose: Pose,
    origin: _Vectors,
    lean: _Vectors,
    steps: int,
    pixels: NDArray[np.intp],
    maps: Floats,
) -> None:
    """Write height and slopes of some pixels, where defined, to maps of (3, H x W)."""
    if steps:
        height, side = _search(thing, origin, lean, steps)
    else:
        height = (thing.height(origin.x, origin.y) - origin.z) / lean.z
        side = np.zeros(height.shape, bool)
    here = np.flatnonzero(height >= 0)
    height, side, pixels = height[here], side[here], pixels[here]
    origin, lean = origin.of(here), lean.of(here)
    maps[0, pixels] = height
    slopes = _slopes(thing, pose, origin.x + height * lean.x, origin.y + height * lean.y)
    for slope, values in zip(maps[1:], slopes, strict=True):
        slope[pixels] = np.where(side, STEEP, values)


def _above(thing: Object, x: Floats, y: Floats, z: Floats) -> Floats:
    """Return the height of a point above the surface, mm; a large value where there is no object."""
    distance = z - thing.height(x, y)
    distance[np.isnan(distance)] = _FAR_BELOW
    return distance


def _search(thing: Object, origin: _Vectors, lean: _Vectors, steps: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the uppermost height above 0 of the object on each ray, and whether it is a vertical side.

    The height is NaN where a ray does not meet it.
    """
    top = -origin.z / lean.z  # the object's highest point is at z = 0 of its own frame
    heights, side = np.full(top.shape, np.nan), np.zeros(top.shape, bool)
    rays = np.flatnonzero(top > 0)
    upper = top[rays]
    over = _gap(thing, origin.of(rays), lean.of(rays), upper)
    for step in range(1, steps + 1):
        lower = top[rays] * (1 - step / steps)
        under = _gap(thing, origin.of(rays), lean.of(rays), lower)
        met, missed = np.flatnonzero(under <= 0), np.flatnonzero(under > 0)
        if met.size:
            ends = _End(lower[met], under[met]), _End(upper[met], over[met])
            heights[rays[met]], side[rays[met]] = _narrow(
                thing, origin.of(rays[met]), lean.of(rays[met]), *ends
            )
        rays, upper, over = rays[missed], lower[missed], under[missed]
    return heights, side


def _gap(thing: Object, origin: _Vectors, lean: _Vectors, height: Floats) -> Floats:
    """Return G at a height on each ray."""
    return _above(thing, origin.x + height * lean.x, origin.y + height * lean.y, origin.z + height * lean.z)


def _narrow(
    thing: Object, origin: _Vectors, lean: _Vectors, lower: _End, upper: _End
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the height between two at which G changes its sign, and whether it jumps there."""
    then, now = lower, upper
    for _ in range(_SECANTS):
        rise = now.gap - then.gap
        step = np.divide(now.gap * (now.height - then.height), rise, out=np.zeros_like(rise), where=rise != 0)
        height = np.clip(now.height - step, lower.height, upper.height)
        then, now = now, _End(height, _gap(thing, origin, lean, height))
        if np.abs(now.height - then.height).max() <= _PRECISION:
            break
    at = now.height
    below, above = (_gap(thing, origin, lean, at + part * _PRECISION) for part in (-0.5, 0.5))
    unclear = np.flatnonzero((below > 0) | (above <= 0) | (above - below > _JUMP))
    side = np.zeros(at.shape, bool)
    if unclear.size:
        from scipy.optimize import elementwise

        origin, lean = origin.of(unclear), lean.of(unclear)
        hit = elementwise.find_root(
            lambda height, number: _gap(thing, origin.of(number), lean.of(number), height),
            (lower.height[unclear], upper.height[unclear]),
            args=(np.arange(unclear.size),),
            tolerances={"xatol": _PRECISION, "fatol": 0.0},
        )
        at[unclear] = np.where(hit.success, hit.x, at[unclear])
        side[unclear] = np.abs(hit.f_x) > _JUMP
    return at, side


def _slopes(thing: Object, pose: Pose, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the slopes in the body's frame at points in the object's frame."""
    along_x, along_y = map(_known, thing.slope(x, y))
    if pose.upright:
        return along_x, along_y
    # The normal in the object's frame is (-along_x, -along_y, 1).
    across, up, facing = (to[2] - along_x * to[0] - along_y * to[1] for to in pose.rotation)
    facing = np.maximum(facing, 1 / STEEP)  # surfaces that face away get the maximum slope
    return -across / facing, -up / facing


def _known(slope: Floats) -> Floats:
    return np.nan_to_num(slope, nan=STEEP, posinf=STEEP, neginf=-STEEP)
