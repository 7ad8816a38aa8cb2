"""Round plates with a relief: an inclined one, one with a step, one with a sinusoidal texture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats

PLATE_RADIUS = 15.0


@dataclass(frozen=True, slots=True)
class Plane:
    """A tilted plate that ends where it would pass above the sheet's rest plane.

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
    """Two levels with a straight edge between them, which is a ramp that the sensor can see.

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
        """Return -tan(zenith) (cos(azimuth), sin(azimuth)) on the ramp, 0 beside it; NaN off the plate."""
        downhill = self._downhill(x, y)
        beside = np.abs(downhill) > self.drop / 2 / math.tan(self.zenith)
        steepness = np.where(np.isnan(downhill), np.nan, np.where(beside, 0.0, -math.tan(self.zenith)))
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
