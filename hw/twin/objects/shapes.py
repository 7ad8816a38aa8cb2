"""Bodies of simple shape that stand alone under the sheet: ball, cone and rod."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball under the centre of the sheet; the half below its equator is hidden.

    Attributes
    ----------
    diameter : float
        Millimetres; the paper's is 10.
    """

    diameter: float = 10.0
    name: ClassVar[str] = "sphere"

    @property
    def radius(self) -> float:
        """Half the diameter, mm."""
        return self.diameter / 2

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z = sqrt(r^2 - x^2 - y^2) - r, mm; NaN from the equator outwards."""
        return _rise(self.radius, x**2 + y**2) - self.radius

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return (-x, -y) / sqrt(r^2 - x^2 - y^2); NaN from the equator outwards."""
        rise = _rise(self.radius, x**2 + y**2)
        return -x / rise, -y / rise


@dataclass(frozen=True, slots=True)
class Cone:
    """A cone standing under the centre of the sheet, its tip up.

    Attributes
    ----------
    zenith : float
        Radians between its surface's normal and the vertical.
    radius : float
        Millimetres, of its base.
    """

    zenith: float = math.radians(30.0)
    radius: float = 5.0
    name: ClassVar[str] = "cone"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z = -tan(zenith) sqrt(x^2 + y^2), mm; NaN beyond the base."""
        return -math.tan(self.zenith) * self._distance(x, y)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -tan(zenith) times the outward direction; 0, the mean of all sides, at the very tip."""
        distance = self._distance(x, y)
        steepness = -math.tan(self.zenith) / np.where(distance == 0, 1.0, distance)
        return steepness * x, steepness * y

    def _distance(self, x: Floats, y: Floats) -> Floats:
        distance = np.hypot(x, y)
        return np.where(distance <= self.radius, distance, np.nan)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A rod lying on its side, its middle under the centre of the sheet; its ends are cut off upright.

    Attributes
    ----------
    diameter, length : float
        Millimetres.
    azimuth : float
        Radians, of its axis.
    """

    diameter: float = 10.0
    length: float = 20.0
    azimuth: float = 0.0
    name: ClassVar[str] = "cylinder"

    @property
    def radius(self) -> float:
        """Half the diagonal of the rectangle that it covers, mm."""
        return math.hypot(self.diameter, self.length) / 2

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z = sqrt(r^2 - v^2) - r with v the distance from the axis, mm; NaN beyond sides and ends."""
        return self._rise_and_across(x, y)[0] - self.diameter / 2

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -v / sqrt(r^2 - v^2) across the axis and 0 along it; NaN beyond sides and ends."""
        rise, across = self._rise_and_across(x, y)
        steepness = -across / rise
        return -steepness * math.sin(self.azimuth), steepness * math.cos(self.azimuth)

    def _rise_and_across(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        along = x * math.cos(self.azimuth) + y * math.sin(self.azimuth)
        across = y * math.cos(self.azimuth) - x * math.sin(self.azimuth)
        rise = _rise(self.diameter / 2, across**2)
        return np.where(np.abs(along) <= self.length / 2, rise, np.nan), across


def _rise(radius: float, square_distance: Floats) -> Floats:
    """Return the height of a circle above its centre; NaN where it has none."""
    square = np.asarray(radius**2 - square_distance)
    square[square <= 0] = np.nan
    return np.sqrt(square)
