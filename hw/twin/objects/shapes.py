"""The objects that the twin knows by name, and those of simple shape."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mirrorskin.hw.twin.objects.coin import Coin
from mirrorskin.hw.twin.objects.heightmap import DEFAULT_SCALE, HEIGHT_MAP_SUFFIXES, load_height_map
from mirrorskin.io.types import Floats, InputError

if TYPE_CHECKING:
    from mirrorskin.hw.twin.objects.surface import Object

OBJECT_NAMES = ("sphere", "coin", "plane", "cone")


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

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z = sqrt(r^2 - x^2 - y^2) - r, mm; NaN from the equator outwards."""
        return self._rise(x, y) - self.diameter / 2

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return (-x, -y) / sqrt(r^2 - x^2 - y^2); NaN from the equator outwards."""
        rise = self._rise(x, y)
        return -x / rise, -y / rise

    def _rise(self, x: Floats, y: Floats) -> Floats:
        square = (self.diameter / 2) ** 2 - x**2 - y**2
        return np.sqrt(np.where(square > 0, square, np.nan))


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
class Plane:
    """A tilted plate that ends where it would pass above the sheet's rest plane.

    Attributes
    ----------
    zenith, azimuth : float
        Radians, of its normal.
    reach : float
        Millimetres from the picture's centre to the upper edge, against the azimuth; the edge is at z = 0.
    """

    zenith: float = math.radians(20.0)
    azimuth: float = math.radians(30.0)
    reach: float = 5.0
    name: ClassVar[str] = "plane"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return -tan(zenith) (reach + x cos(azimuth) + y sin(azimuth)), mm; NaN beyond the upper edge."""
        return -math.tan(self.zenith) * self._below_edge(x, y)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return -tan(zenith) (cos(azimuth), sin(azimuth)); NaN beyond the upper edge."""
        steepness = np.where(np.isnan(self._below_edge(x, y)), np.nan, -math.tan(self.zenith))
        return steepness * math.cos(self.azimuth), steepness * math.sin(self.azimuth)

    def _below_edge(self, x: Floats, y: Floats) -> Floats:
        distance = self.reach + x * math.cos(self.azimuth) + y * math.sin(self.azimuth)
        return np.where(distance >= 0, distance, np.nan)


_CENTRED: dict[str, Object] = {"sphere": Sphere(), "coin": Coin(), "cone": Cone()}


def make_object(
    name: str | Path,
    shape: tuple[int, int],
    pixel_size: tuple[float, float],
    *,
    scale: float = DEFAULT_SCALE,
) -> Object:
    """Make the object that a user asked for, as it lies in a given field of view.

    Parameters
    ----------
    name : str or Path
        "sphere" (10 mm), "coin" (5 yen), "plane" (20 degrees steep, its upper edge through the field's
        highest corner), "cone" (30 degrees steep), or the path of a height map: .npy, .png, .tif or .tiff.
    shape : (int, int)
        Rows and columns of the field.
    pixel_size : (float, float)
        Millimetres along x and y; those of a height map too.
    scale : float
        Millimetres a count of a 16-bit height map.

    Returns
    -------
    Object
        Its highest point touches the sheet at travel 0.

    Raises
    ------
    InputError
        The name is none of these, or the file cannot be used.
    """
    if str(name) == "plane":
        return _plane_in_field(shape, pixel_size)
    if str(name) in _CENTRED:
        return _CENTRED[str(name)]
    if Path(name).suffix.lower() in HEIGHT_MAP_SUFFIXES:
        return load_height_map(name, pixel_size, scale=scale)
    raise InputError(
        f"object {str(name)!r} is unknown: take {', '.join(OBJECT_NAMES)}"
        f" or the path of a height map ({', '.join(HEIGHT_MAP_SUFFIXES)})"
    )


def _plane_in_field(shape: tuple[int, int], pixel_size: tuple[float, float]) -> Plane:
    half_width, half_height = shape[1] * pixel_size[0] / 2, shape[0] * pixel_size[1] / 2
    azimuth = Plane().azimuth
    return Plane(reach=half_width * abs(math.cos(azimuth)) + half_height * abs(math.sin(azimuth)))
