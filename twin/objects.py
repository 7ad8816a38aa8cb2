"""The interface of objects for the twin, and objects of simple shape."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from mirrorskin.io.base.types import Floats


class Object(Protocol):
    """A solid under the sheet, seen from above: the interface of all objects for the twin.

    ``z = 0`` is the sheet's rest plane, so no height is above it; the highest point touches at travel 0.
    Coordinates are millimetres from the picture's centre, x to the right and y up.
    """

    @property
    def name(self) -> str:
        """Name in the title of a recording."""

    @property
    def radius(self) -> float:
        """Radius of the circle about the origin that contains the object without its table, mm."""

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return the surface's z, mm, float64, shaped as x and y broadcast; NaN where there is no object."""

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy, float64, shaped as x and y broadcast; NaN where there is no object."""


@dataclass(frozen=True, slots=True)
class Shifted:
    """An object displaced from the centre of the sheet.

    Attributes
    ----------
    thing : Object
    shift : (float, float)
        Millimetres along x and y from the picture's centre to where the object's centre lies.
    """

    thing: Object
    shift: tuple[float, float]

    @property
    def name(self) -> str:
        """Name of the object."""
        return self.thing.name

    @property
    def radius(self) -> float:
        """Radius of a circle about the picture's centre that contains the object, mm."""
        return self.thing.radius + math.hypot(*self.shift)

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return the object's z, mm; NaN where there is no object."""
        return self.thing.height(x - self.shift[0], y - self.shift[1])

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return the object's dz/dx and dz/dy; NaN where there is no object."""
        return self.thing.slope(x - self.shift[0], y - self.shift[1])


def difference_slope(
    height: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, step: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return the slope of a height function by central differences, one-sided at the object's edge.

    NaN where the height is NaN, and where both neighbours along that axis are missing; ``step`` is the
    distance to these.
    """
    centre = height(x, y)
    dx, dy = step
    dz_dx = _mean_of_known(height(x + dx, y) - centre, centre - height(x - dx, y)) / dx
    dz_dy = _mean_of_known(height(x, y + dy) - centre, centre - height(x, y - dy)) / dy
    return dz_dx, dz_dy


def zenith_azimuth(dz_dx: Floats, dz_dy: Floats) -> tuple[Floats, Floats]:
    """Return zenith and azimuth of the normal, which is proportional to (-dz/dx, -dz/dy, 1).

    The azimuth, in (-pi, pi], is NaN where the surface is level.
    """
    zenith = np.arctan(np.hypot(dz_dx, dz_dy))
    # 0.0 - s instead of -s: a negative zero would give an azimuth of -pi.
    azimuth = np.arctan2(0.0 - dz_dy, 0.0 - dz_dx)
    return zenith, np.where(zenith > 0, azimuth, np.nan)


def _mean_of_known(a: Floats, b: Floats) -> Floats:
    mean: Floats = np.where(np.isnan(a), b, np.where(np.isnan(b), a, (a + b) / 2))
    return mean


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball under the centre of the sheet; the half below its equator is not visible.

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
    """A cone under the centre of the sheet with its tip up.

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
        """Return -tan(zenith) times the outward direction; at the tip 0, the mean of all sides."""
        distance = self._distance(x, y)
        steepness = -math.tan(self.zenith) / np.where(distance == 0, 1.0, distance)
        return steepness * x, steepness * y

    def _distance(self, x: Floats, y: Floats) -> Floats:
        distance = np.hypot(x, y)
        return np.where(distance <= self.radius, distance, np.nan)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A horizontal rod, centred under the sheet, with vertical end faces.

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


PLATE_RADIUS = 15.0


@dataclass(frozen=True, slots=True)
class Plane:
    """A tilted plate that ends where it would rise above the sheet's rest plane.

    Attributes
    ----------
    zenith, azimuth : float
        Radians, of its normal.
    reach : float
        Millimetres from the picture's centre to the upper edge, against the azimuth; the edge is at z = 0.
    radius : float
        Millimetres, of the plate as seen from above.
    """

    zenith: float = math.radians(20.0)
    azimuth: float = math.radians(30.0)
    reach: float = 5.0
    radius: float = PLATE_RADIUS
    name: ClassVar[str] = "plane"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return -tan(zenith) (reach + x cos(azimuth) + y sin(azimuth)), mm; NaN beyond the edges."""
        return -math.tan(self.zenith) * self._below_edge(x, y)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -tan(zenith) (cos(azimuth), sin(azimuth)); NaN beyond the edges."""
        steepness = np.where(np.isnan(self._below_edge(x, y)), np.nan, -math.tan(self.zenith))
        return steepness * math.cos(self.azimuth), steepness * math.sin(self.azimuth)

    def _below_edge(self, x: Floats, y: Floats) -> Floats:
        distance = self.reach + _along(self.azimuth, x, y)
        return np.where((distance >= 0) & _on_plate(self.radius, x, y), distance, np.nan)


@dataclass(frozen=True, slots=True)
class Step:
    """Two levels separated by a straight ramp that the sensor can see.

    Attributes
    ----------
    drop : float
        Millimetres from the upper level, at z = 0, to the lower.
    zenith, azimuth : float
        Radians, of the ramp's normal; the ramp's middle goes through the centre, and it is 0.6 mm wide
        by default.
    radius : float
        Millimetres, of the plate.
    """

    drop: float = 0.5
    zenith: float = math.radians(40.0)
    azimuth: float = 0.0
    radius: float = PLATE_RADIUS
    name: ClassVar[str] = "step"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return -drop / 2 - tan(zenith) u within 0 and -drop, mm, u along the azimuth; NaN off the plate."""
        ramp = -self.drop / 2 - math.tan(self.zenith) * self._downhill(x, y)
        return np.clip(ramp, -self.drop, 0.0)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -tan(zenith) (cos(azimuth), sin(azimuth)) on the ramp, 0 elsewhere; NaN off the plate."""
        downhill = self._downhill(x, y)
        level = np.abs(downhill) > self.drop / 2 / math.tan(self.zenith)
        steepness = np.where(np.isnan(downhill), np.nan, np.where(level, 0.0, -math.tan(self.zenith)))
        return steepness * math.cos(self.azimuth), steepness * math.sin(self.azimuth)

    def _downhill(self, x: Floats, y: Floats) -> Floats:
        return np.where(_on_plate(self.radius, x, y), _along(self.azimuth, x, y), np.nan)


@dataclass(frozen=True, slots=True)
class Texture:
    """A plate with sinusoidal ridges, one of them through the centre.

    Attributes
    ----------
    wavelength : float
        Millimetres from ridge to ridge.
    amplitude : float
        Half the millimetres from ridge to furrow; by default the flanks' steepest part is at 32 degrees.
    azimuth : float
        Radians, of the direction across the ridges.
    radius : float
        Millimetres, of the plate.
    """

    wavelength: float = 2.0
    amplitude: float = 0.2
    azimuth: float = 0.0
    radius: float = PLATE_RADIUS
    name: ClassVar[str] = "texture"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return amplitude (cos(2 pi u / wavelength) - 1), mm, u along the azimuth; NaN off the plate."""
        return self.amplitude * (np.cos(self._phase(x, y)) - 1)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -(2 pi / wavelength) amplitude sin(2 pi u / wavelength) along u; NaN off the plate."""
        steepness = -2 * math.pi * self.amplitude / self.wavelength * np.sin(self._phase(x, y))
        return steepness * math.cos(self.azimuth), steepness * math.sin(self.azimuth)

    def _phase(self, x: Floats, y: Floats) -> Floats:
        phase = 2 * math.pi / self.wavelength * _along(self.azimuth, x, y)
        return np.where(_on_plate(self.radius, x, y), phase, np.nan)


def _along(azimuth: float, x: Floats, y: Floats) -> Floats:
    return x * math.cos(azimuth) + y * math.sin(azimuth)


def _on_plate(radius: float, x: Floats, y: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.asarray(x**2 + y**2 <= radius**2)
