"""The mirror sheet on an object: conforming, or on an elastic body."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.twin.body import Body
from mirrorskin.twin.elastic import Contact, HalfSpace, press
from mirrorskin.twin.movement import Pose, pose_at_press
from mirrorskin.twin.objects import Object
from mirrorskin.twin.obstacle import meet
from mirrorskin.twin.view import View


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """The mirror in one frame, in the body's frame, at the points that the pixels see.

    Attributes
    ----------
    height : ndarray, (H, W), float64
        Millimetres above the rest plane, 0 or more.
    dz_dx, dz_dy : ndarray, (H, W), float64
        Its slopes along the body's x and y.
    contact : ndarray, (H, W), bool
        Whether sheet and object touch there.
    force : float
        Normal force, N; NaN without contact mechanics.
    """

    height: Floats
    dz_dx: Floats
    dz_dy: Floats
    contact: NDArray[np.bool_]
    force: float = math.nan


class Conform:
    """Equation 1 of the paper, F = f H(-vt - f): the object's shape where it is above the rest plane."""

    def __init__(self, thing: Object, view: View) -> None:
        self._thing = thing
        self._view = view

    def drape(self, pose: Pose) -> Sheet:
        """Return the sheet on the object in a pose."""
        obstacle = meet(self._thing, pose, self._view)
        contact = np.isfinite(obstacle.height) & self._view.on_body
        height, dz_dx, dz_dy = (np.where(contact, values, 0.0) for values in obstacle)
        return Sheet(height, dz_dx, dz_dy, contact)


_POINTS_MAX = 4_000_000
_COARSE = 97  # samples across the body at which the object's height above the rest plane is tested
_VIEW_ROUNDS = 6  # fixed-point iterations along an oblique ray; each gains a factor of slope times lean


class Elastic:
    """Frictionless contact of the rigid object with the body, approximated as an incompressible half-space.

    The pressure is computed on the pixel grid, extended by all that the object can reach in the given poses.
    The mirror is below the surface by the thickness of the sheet. Each pose is solved independently, so a
    frame does not depend on those read before. Slides and twists of a body at the ``deepest`` travel start
    from the pressure of that press, moved along with the object.
    """

    def __init__(
        self,
        thing: Object,
        poses: Iterable[Pose],
        view: View,
        body: Body,
        compliance: float = 0.0,
        deepest: float = 0.0,
    ) -> None:
        self._thing = thing
        self._view = view
        self._compliance, self._deepest = compliance, deepest
        rows, columns = view.shape
        grow_y, grow_x = _margin(thing, poses, view, body)
        shape = rows + 2 * grow_y, columns + 2 * grow_x
        if shape[0] * shape[1] > _POINTS_MAX:
            raise InputError(
                f"elastic contact of the {thing.name} needs {shape[0]} x {shape[1]} points, but "
                f"the maximum is {_POINTS_MAX}: use larger pixels or contact 'conform'"
            )
        self._grid = View(shape, view.pixel_size, body)
        self._field = np.s_[grow_y : grow_y + rows, grow_x : grow_x + columns]
        self.space: HalfSpace = HalfSpace(shape, view.pixel_size, body.modulus, body.sheet)

    def solve(self, pose: Pose) -> Contact:
        """Return pressure and force in a pose, on the extended grid."""
        if pose.shift[2] != self._deepest or pose.rotation[2, 2] != 1:
            return self._press(pose)
        if pose.upright and not pose.shift[:2].any():
            return self._pressed
        return self._press(pose, self._moved_along(pose))

    def _press(self, pose: Pose, start: Floats | None = None) -> Contact:
        height = meet(self._thing, pose, self._grid).height
        obstacle = np.where(self._grid.on_body, height, np.nan)
        return press(self.space, obstacle, start=start, compliance=self._compliance)

    @functools.cached_property
    def _pressed(self) -> Contact:
        return self._press(pose_at_press(self._deepest))

    def _moved_along(self, pose: Pose) -> Floats:
        """Return the pressure of the deepest press, moved with the object by a slide or a twist."""
        from scipy.ndimage import map_coordinates

        grid, (along_x, along_y) = self._grid, self._grid.pixel_size
        places = np.stack([grid.x - pose.shift[0], grid.y - pose.shift[1]])
        x, y = np.tensordot(pose.rotation[:2, :2].T, places, 1)
        rows, columns = grid.shape
        index = np.stack([(rows - 1) / 2 - y / along_y, x / along_x + (columns - 1) / 2])
        moved: Floats = map_coordinates(self._pressed.pressure, index, order=1)
        return moved

    def drape(self, pose: Pose) -> Sheet:
        """Return the sheet pressed on the object in a pose."""
        contact = self.solve(pose)
        return replace(self.sheet(contact.pressure), force=contact.force)

    def sheet(self, pressure: Floats) -> Sheet:
        """Return the mirror under a pressure, as the camera's pixels see it."""
        from scipy.ndimage import map_coordinates

        height = self.space.mirror(pressure)
        along_x, along_y = self._view.pixel_size
        dz_dx = _slope(height, 1) / along_x
        dz_dy = -_slope(height, 0) / along_y
        at = None if self._view.orthographic else self._seen(height)

        def seen(values: NDArray[Any], order: int = 1) -> NDArray[Any]:
            if at is None:
                here = self.crop(values)
            else:
                here = map_coordinates(values, at, order=order, mode="nearest")
            return np.where(self._view.on_body, here, np.zeros_like(here))

        return Sheet(seen(height), seen(dz_dx), seen(dz_dy), seen(pressure > 0, order=0))

    @property
    def places(self) -> Floats:
        """Points at which the pixels' lines of sight meet the rest plane, x and y, (2, H, W), mm."""
        return np.stack([self._view.x, self._view.y])

    @property
    def grid_places(self) -> Floats:
        """The same on the extended grid."""
        return np.stack([self._grid.x, self._grid.y])

    def crop(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the field of view of a map on the extended grid, (..., H, W)."""
        return values[(..., *self._field)]

    def _seen(self, height: Floats) -> Floats:
        """Return the rows and columns of the points that oblique rays meet, (2, H, W)."""
        from scipy.ndimage import map_coordinates

        view, (along_x, along_y) = self._view, self._view.pixel_size
        row, column = np.indices(view.shape, dtype=np.float64)
        row, column = row + self._field[0].start, column + self._field[1].start
        at = np.stack([row, column])
        for _ in range(_VIEW_ROUNDS):
            z = map_coordinates(height, at, order=1, mode="nearest")
            at = np.stack([row - z * view.slope_y / along_y, column + z * view.slope_x / along_x])
        return at


def _slope(height: Floats, axis: int) -> Floats:
    """Return the derivative along an axis per pixel; 0 for a single pixel."""
    return np.gradient(height, axis=axis) if height.shape[axis] > 1 else np.zeros_like(height)


def _margin(thing: Object, poses: Iterable[Pose], view: View, body: Body) -> tuple[int, int]:
    """Return the rows and columns by which the field must be extended to contain all possible contact."""
    cell = 2 * body.radius / _COARSE
    coarse = View((_COARSE, _COARSE), (cell, cell), body)
    reached = np.zeros(coarse.shape, bool)
    for pose in poses:
        reached |= coarse.on_body & np.isfinite(meet(thing, pose, coarse).height)
    if not reached.any():
        return 0, 0
    grow = []
    for places, size, pixel in zip((coarse.y, coarse.x), view.shape, view.pixel_size[::-1], strict=True):
        half = min(float(np.abs(places[reached]).max()) + cell, body.radius)
        grow.append(max(0, math.ceil(half / pixel - size / 2)))
    return grow[0], grow[1]
