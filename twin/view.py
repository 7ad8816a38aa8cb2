"""The direction of the camera's lines of sight inside the body, at each pixel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats, InputError, pixel_axes
from mirrorskin.twin.body import Body

_ITERATIONS_MAX = 100


class View:
    """The camera's lines of sight inside the body.

    The pixel grid is in the sheet's rest plane: pixel (x, y) sees all points ``(x + z slope_x, y + z slope_y,
    z)``. An orthographic camera looks straight down everywhere. A pinhole on the body's axis looks through
    the body's flat top, where each line is refracted: with the pinhole h above the top, the line that meets
    the rest plane at distance r from the axis has tan(air) = w and tan(inside) = v where ::

        h w + height v = r,     sin(air) = index sin(inside)

    and its slope is v towards the axis.

    Attributes
    ----------
    shape, pixel_size : as given
    x, y : (H, W), where a pixel meets the rest plane, mm
    on_body : (H, W), whether that is on the body: there is no sheet beyond it
    slope_x, slope_y : (H, W), by how much its line of sight moves along x and y for each millimetre of z
    orthographic : whether all slopes are zero
    """

    shape: tuple[int, int]
    pixel_size: tuple[float, float]
    x: Floats
    y: Floats
    slope_x: Floats
    slope_y: Floats

    def __init__(
        self, shape: tuple[int, int], pixel_size: tuple[float, float], body: Body, distance: float = math.inf
    ) -> None:
        if not distance > body.height:
            raise InputError(
                f"a camera {distance} mm above the sheet is not above the body: use more than "
                f"{body.height} mm, or infinity"
            )
        self.shape, self.pixel_size = shape, pixel_size
        self.x, self.y = np.meshgrid(*pixel_axes(shape, pixel_size))
        self.on_body: NDArray[np.bool_] = np.hypot(self.x, self.y) <= body.radius
        self.orthographic: bool = math.isinf(distance)
        self.slope_x, self.slope_y = np.zeros((2, *shape))
        if not self.orthographic:
            away = np.sqrt(self.x**2 + self.y**2)
            towards = -_tangent_inside(away, body, distance - body.height)
            per_length = towards / np.where(away > 0, away, 1)
            self.slope_x, self.slope_y = self.x * per_length, self.y * per_length


def _tangent_inside(away: Floats, body: Body, above: float) -> Floats:
    """Return the tangents of the lines inside the body by their distance from the axis in the rest plane.

    Newton's iteration for the tangent w in air. The distance is a concave function of it, so the iteration
    converges from 0 monotonically.
    """
    index = body.index
    tangent = np.zeros_like(away)
    for _ in range(_ITERATIONS_MAX):
        under = 1 / np.sqrt(index**2 + (index**2 - 1) * tangent**2)
        missing = away - above * tangent - body.height * tangent * under
        step = missing / (above + body.height * index**2 * under**3)
        tangent += step
        if (np.abs(step) <= 1e-15 * (1 + tangent)).all():
            break
    return np.asarray(tangent / np.sqrt(index**2 + (index**2 - 1) * tangent**2))
