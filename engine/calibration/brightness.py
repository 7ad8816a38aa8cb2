"""What counts tell of normals: the response of a sensor, in one form for all kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.response import shade
from mirrorskin.io import Header, InputError, WallResponse, pixel_axes
from mirrorskin.kernels.response import wall_light

Doubles = NDArray[np.float64]

_PER_DEPTH = 0.01  # radians by which the zenith seems to change for each mm of a mirror's height, about
_END = 0.06  # share of the range, at both of its ends, within which scatter bends the linear pattern's line


class Shown(Protocol):
    """How bright a mirror looks to each pixel of a picture, in units of its own."""

    @property
    def depth_sigma(self) -> float:
        """By how much all depths that light tells may be wrong together, mm: a standard deviation."""

    def sight(self, pixels: NDArray[np.intp]) -> Doubles:
        """Return by how much the sight lines of pixels, (n,), move along x and y a mm of z, (2, n)."""

    def of_counts(self, counts: NDArray[Any], pixels: NDArray[np.intp]) -> Doubles:
        """Return how bright counts of pixels, (..., n), are; NaN where a sample is clipped or unknown."""

    def of_normals(
        self, normals: Doubles, z: Doubles, pixels: NDArray[np.intp]
    ) -> tuple[Doubles, NDArray[np.bool_]]:
        """Return how bright mirrors are, (N, n), and whether that is within the range that tells them."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearShown:
    """Brightness that is linear in the zenith, and in units of it: radians."""

    offset: Doubles  # (H * W,): Counts at zenith 0, and a radian
    gain: Doubles  # (H * W,): Counts at zenith 0, and a radian
    low: Doubles  # (H * W,): Zeniths at which the light is none, and full
    high: Doubles  # (H * W,): Zeniths at which the light is none, and full

    @classmethod
    def of_header(cls, header: Header, shape: tuple[int, int]) -> LinearShown:
        """Take the scale of a recording."""
        if header.zenith_gain is None or header.zenith_offset is None:
            raise InputError(
                "the recording tells no zenith gain and offset: calibrate the zenith first, or give both"
            )
        gain, offset = _flat(header.zenith_gain, shape), _flat(header.zenith_offset, shape)
        gain = np.where(np.isfinite(gain) & (gain != 0), gain, np.nan)
        ends = [np.full_like(gain, -np.inf), np.full_like(gain, np.inf)]
        if header.dark is not None and header.bright is not None:
            ends = [(_flat(level, shape) - offset) / gain for level in (header.dark, header.bright)]
        return cls(offset, gain, np.fmin(*ends), np.fmax(*ends))

    @property
    def depth_sigma(self) -> float:
        """Nothing: light tells no depths here."""
        return 0.0

    def sight(self, pixels: NDArray[np.intp]) -> Doubles:
        """Look straight down."""
        return np.zeros((2, len(pixels)))

    def of_counts(self, counts: NDArray[Any], pixels: NDArray[np.intp]) -> Doubles:
        """Return zeniths, radians."""
        return (_whole(counts) - self.offset[pixels]) / self.gain[pixels]

    def of_normals(
        self, normals: Doubles, z: Doubles, pixels: NDArray[np.intp]
    ) -> tuple[Doubles, NDArray[np.bool_]]:
        """Return the zeniths of normals; they are told where the line is straight."""
        zenith = np.arctan2(np.hypot(normals[..., 0], normals[..., 1]), normals[..., 2])
        low, high = self.low[pixels], self.high[pixels]
        with np.errstate(invalid="ignore"):
            margin = np.where(np.isfinite(high - low), _END * (high - low), 0.0)
            return zenith, (zenith > low + margin) & (zenith < high - margin)


@dataclass(frozen=True, slots=True, eq=False)
class WallShown:
    """Brightness as a calibrated cylindrical wall gives it, as a share of full light."""

    wall: WallResponse
    place: Doubles  # (2, H * W): Of the pixels, mm from the wall's axis
    dark: Doubles  # (H * W,): Counts without light, and how many more there are in full light
    span: Doubles  # (H * W,): Counts without light, and how many more there are in full light

    @classmethod
    def of_pixels(
        cls,
        wall: WallResponse,
        dark: ArrayLike | None,
        bright: ArrayLike | None,
        shape: tuple[int, int],
        pixel_size: tuple[float, float],
    ) -> WallShown:
        """Put a response and references together."""
        if dark is None or bright is None:
            raise InputError(
                "there are no dark and bright references: make them first with"
                " 'mirrorskin calibrate references'"
            )
        if wall.pattern != "graded":
            raise InputError("the response is of a uniform pattern, which tells no zenith: go without it")
        x, y = (axis.ravel() for axis in np.meshgrid(*pixel_axes(shape, pixel_size)))
        place = np.stack([x - wall.axis[0], y - wall.axis[1]])
        level = _flat(dark, shape)
        span = (_flat(bright, shape) - level) * shade(wall, *place)
        with np.errstate(invalid="ignore"):
            usable = (span > 0) & (np.sum(place**2, axis=0) < wall.radius**2)
        return cls(wall, place, level, np.where(usable, span, np.nan))

    @property
    def depth_sigma(self) -> float:
        """What the response's error of zenith makes of depths, mm."""
        known = self.wall.zenith_sigma[np.isfinite(self.wall.zenith_sigma)]
        return float(np.median(known)) / _PER_DEPTH if known.size else 0.0

    def sight(self, pixels: NDArray[np.intp]) -> Doubles:
        """Return the slopes of the lines of sight."""
        x, y = self.place[:, pixels]
        towards = -(self.wall.sight[0] + self.wall.sight[1] * (x**2 + y**2))
        return np.stack([towards * x, towards * y])

    def of_counts(self, counts: NDArray[Any], pixels: NDArray[np.intp]) -> Doubles:
        """Return light, as a share."""
        return (_whole(counts) - self.dark[pixels]) / self.span[pixels]

    def of_normals(
        self, normals: Doubles, z: Doubles, pixels: NDArray[np.intp]
    ) -> tuple[Doubles, NDArray[np.bool_]]:
        """Return the light of normals."""
        wall = self.wall
        place = np.stack(np.broadcast_arrays(*self.place[:, pixels], z, *self.sight(pixels)))
        geometry = wall.radius, wall.rim, wall.scatter
        return wall_light(place, normals, geometry, wall.lamps, wall.curve, wall.reach)


def _flat(values: ArrayLike, shape: tuple[int, int]) -> Doubles:
    return np.broadcast_to(np.asarray(values, np.float64), shape).ravel()


def _whole(counts: NDArray[Any]) -> Doubles:
    """Return counts as float64, NaN where they are at an end of an integer type."""
    values = np.asarray(counts, np.float64)
    if counts.dtype.kind != "u":
        return values
    return np.where((counts == 0) | (counts == np.iinfo(counts.dtype).max), np.nan, values)
