"""What the twin needs to know of an object: its surface, and which way the surface faces."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats


class Object(Protocol):
    """A solid under the sheet, seen from above: the interface of everything the twin can press on.

    ``z = 0`` is the sheet's rest plane, so no height is above it; the highest point touches at travel 0.
    Coordinates are millimetres from the picture's centre, x to the right and y up the picture.
    """

    @property
    def name(self) -> str:
        """What to call it in a recording's title."""

    @property
    def radius(self) -> float:
        """Radius of the circle about the origin that holds the object, not a table that it lies on; mm."""

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return the surface's z, mm, float64, shaped as x and y broadcast; NaN where there is no object."""

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy, float64, shaped as x and y broadcast; NaN where there is no object."""


def difference_slope(
    height: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, step: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Differentiate a height function by central differences, one-sided where the object ends.

    Parameters
    ----------
    height : callable
        Height in mm at (x, y); NaN where there is no object.
    x, y : ndarray, float64
        Where, mm.
    step : (float, float)
        Distance to the neighbours on either side along x and y, mm.

    Returns
    -------
    dz_dx, dz_dy : ndarray, float64
        NaN where the height is, and where both neighbours along that axis are missing.
    """
    centre = height(x, y)
    dx, dy = step
    dz_dx = _mean_of_known(height(x + dx, y) - centre, centre - height(x - dx, y)) / dx
    dz_dy = _mean_of_known(height(x, y + dy) - centre, centre - height(x, y - dy)) / dy
    return dz_dx, dz_dy


def zenith_azimuth(dz_dx: Floats, dz_dy: Floats) -> tuple[Floats, Floats]:
    """Turn slopes into the angles of the normal, which is proportional to (-dz/dx, -dz/dy, 1).

    Parameters
    ----------
    dz_dx, dz_dy : ndarray, float64
        Slopes; dz_dy is along y, up the picture.

    Returns
    -------
    zenith : ndarray, float64
        Radians from the camera's axis.
    azimuth : ndarray, float64
        Radians in (-pi, pi], counter-clockwise from x; NaN where the surface is level and has none.
    """
    zenith = np.arctan(np.hypot(dz_dx, dz_dy))
    # 0.0 - s, not -s: a negative zero would put the azimuth at -pi.
    azimuth = np.arctan2(0.0 - dz_dy, 0.0 - dz_dx)
    return zenith, np.where(zenith > 0, azimuth, np.nan)


def _mean_of_known(a: Floats, b: Floats) -> Floats:
    mean: Floats = np.where(np.isnan(a), b, np.where(np.isnan(b), a, (a + b) / 2))
    return mean
