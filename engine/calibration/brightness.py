"""Brightness as a function of the normal: linear in the zenith, or by a calibrated wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.response import shade
from mirrorskin.io import Header, InputError, WallResponse, pixel_axes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.response import sight_slopes, wall_light

Mask = NDArray[np.bool_]
Pixels = NDArray[np.intp]

_ZENITH_PER_DEPTH = 0.01  # radians per mm: typical apparent change of the zenith with a mirror's height
_END = 0.06  # share of the range, at both ends, where scatter makes the linear pattern nonlinear


@dataclass(frozen=True, slots=True, eq=False)
class LinearBrightness:
    """Brightness that is linear in the zenith, converted to radians of zenith."""

    offset: Doubles  # (H * W,): counts at zenith 0
    gain: Doubles  # (H * W,): counts per radian
    low: Doubles  # (H * W,): zenith without light
    high: Doubles  # (H * W,): zenith in full light

    @classmethod
    def of_header(cls, header: Header, shape: tuple[int, int]) -> LinearBrightness:
        """Return the brightness from the zenith gain and offset of a recording, within its references."""
        if header.zenith_gain is None or header.zenith_offset is None:
            raise InputError(
                "the recording has no zenith gain and offset: calibrate the zenith first, or give both"
            )
        gain, offset = _per_pixel(header.zenith_gain, shape), _per_pixel(header.zenith_offset, shape)
        gain = np.where(np.isfinite(gain) & (gain != 0), gain, np.nan)
        ends = [np.full_like(gain, -np.inf), np.full_like(gain, np.inf)]
        if header.dark is not None and header.bright is not None:
            ends = [(_per_pixel(level, shape) - offset) / gain for level in (header.dark, header.bright)]
        return cls(offset, gain, np.fmin(*ends), np.fmax(*ends))

    depth_sigma: ClassVar[float] = 0.0
    """Common standard deviation of all depths, mm: 0, because this light does not determine depths."""

    def sight(self, pixels: Pixels) -> Doubles:
        """Return zeros: pixels look straight down."""
        return np.zeros((2, len(pixels)))

    def of_counts(self, counts: NDArray[Any], pixels: Pixels) -> Doubles:
        """Return the zeniths of counts of pixels, (..., n), radians; NaN if clipped or unknown."""
        return (_unclipped(counts) - self.offset[pixels]) / self.gain[pixels]

    def of_normals(self, normals: Doubles, z: Doubles, pixels: Pixels) -> tuple[Doubles, Mask]:
        """Return the zeniths of normals, (N, n, 3), and whether the pattern is linear there."""
        zenith = np.arctan2(np.hypot(normals[..., 0], normals[..., 1]), normals[..., 2])
        low, high = self.low[pixels], self.high[pixels]
        with np.errstate(invalid="ignore"):
            margin = np.where(np.isfinite(high - low), _END * (high - low), 0.0)
            return zenith, (zenith > low + margin) & (zenith < high - margin)


@dataclass(frozen=True, slots=True, eq=False)
class WallBrightness:
    """Brightness under a calibrated cylindrical wall, as a share of full light."""

    wall: WallResponse
    place: Doubles  # (2, H * W): of the pixels, mm from the wall's axis
    dark: Doubles  # (H * W,): counts without light
    span: Doubles  # (H * W,): difference of the counts in full light; NaN if unknown

    @classmethod
    def of_pixels(
        cls,
        wall: WallResponse,
        dark: ArrayLike | None,
        bright: ArrayLike | None,
        shape: tuple[int, int],
        pixel_size: tuple[float, float],
    ) -> WallBrightness:
        """Combine a graded response and references."""
        if dark is None or bright is None:
            raise InputError(
                "there are no dark and bright references: make them first with"
                " 'mirrorskin calibrate references'"
            )
        if wall.pattern != "graded":
            raise InputError("the response is of a uniform pattern, without zeniths: leave it out")
        x, y = (axis.ravel() for axis in np.meshgrid(*pixel_axes(shape, pixel_size)))
        place = np.stack([x - wall.axis[0], y - wall.axis[1]])
        level = _per_pixel(dark, shape)
        span = (_per_pixel(bright, shape) - level) * shade(wall, *place)
        with np.errstate(invalid="ignore"):
            usable = (span > 0) & (np.sum(place**2, axis=0) < wall.radius**2)
        return cls(wall, place, level, np.where(usable, span, np.nan))

    @property
    def depth_sigma(self) -> float:
        """Standard deviation of depths due to the error of the response's zenith, mm."""
        sigma = self.wall.zenith_sigma[np.isfinite(self.wall.zenith_sigma)]
        return float(np.median(sigma)) / _ZENITH_PER_DEPTH if sigma.size else 0.0

    def sight(self, pixels: Pixels) -> Doubles:
        """Return the displacement of lines of sight along x and y per mm of z, (2, n)."""
        return sight_slopes(self.place[:, pixels], self.wall.sight)

    def of_counts(self, counts: NDArray[Any], pixels: Pixels) -> Doubles:
        """Return the light of counts of pixels, (..., n), as a share; NaN if clipped or unknown."""
        return (_unclipped(counts) - self.dark[pixels]) / self.span[pixels]

    def of_normals(self, normals: Doubles, z: Doubles, pixels: Pixels) -> tuple[Doubles, Mask]:
        """Return the light of normals, (N, n, 3), at heights z, (N, n), mm, and whether it is valid."""
        wall = self.wall
        place = np.stack(np.broadcast_arrays(*self.place[:, pixels], z, *self.sight(pixels)))
        geometry = wall.radius, wall.rim, wall.scatter
        return wall_light(place, normals, geometry, wall.lamps, wall.curve, wall.reach)


Brightness = LinearBrightness | WallBrightness
"""Brightness of a mirror for each pixel of a picture; pixels are numbered row by row."""


def _per_pixel(values: ArrayLike, shape: tuple[int, int]) -> Doubles:
    return np.broadcast_to(np.asarray(values, np.float64), shape).ravel()


def _unclipped(counts: NDArray[Any]) -> Doubles:
    """Return counts as float64, NaN at the ends of an integer type."""
    values = np.asarray(counts, np.float64)
    if counts.dtype.kind != "u":
        return values
    return np.where((counts == 0) | (counts == np.iinfo(counts.dtype).max), np.nan, values)
