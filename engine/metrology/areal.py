"""Areal texture parameters of ISO 25178-2 of a map with holes, as plain numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_MICROMETRES = 1e3  # per mm
_CLASSES = 4001  # of the material ratio curve
_CORE = 0.4  # width of the secant whose least slope defines the core
_PEAK, _DALE = 0.1, 0.8  # material ratios p and q of the volume parameters
_DECAY = 0.2  # of the autocorrelation, at Sal
_DIRECTIONS = 90  # in which the autocorrelation is followed
_STEP = 0.5  # pixels along a direction
_MIN_OVERLAP = 0.1  # smallest share of pixels that overlap at a lag that counts
_ANGLE_SPREAD = 2  # degrees: standard deviation of the window over the angular spectrum


def height_parameters(values: Doubles) -> dict[str, float]:
    """Return the height parameters of heights above their mean, (n,) mm."""
    square = values * values
    mean_square = float(np.mean(square))
    root = math.sqrt(mean_square)
    peak, pit = float(values.max()), float(-values.min())
    skewness, kurtosis = shape_of(values, root)
    return {
        "Sa": _MICROMETRES * float(np.mean(np.abs(values))),
        "Sq": _MICROMETRES * root,
        "Sz": _MICROMETRES * (peak + pit),
        "Sp": _MICROMETRES * peak,
        "Sv": _MICROMETRES * pit,
        "Ssk": skewness,
        "Sku": kurtosis,
    }


def shape_of(values: Doubles, root: float) -> tuple[float, float]:
    """Return skewness and kurtosis of values with the mean 0 and the root mean square ``root``."""
    if not root > 0:
        return math.nan, math.nan
    unit = values / root
    square = unit * unit
    return float(np.mean(square * unit)), float(np.mean(square * square))


def functional_parameters(values: Doubles) -> dict[str, float]:
    """Return the parameters of the material ratio curve of heights above their mean, (n,) mm.

    The core is found from the secant of 40 % width with the least slope; the equivalent line is fitted to
    that part of the curve by least squares (ISO 25178-2, ISO 13565-2). Volumes use 10 % and 80 %.
    """
    ratio = np.linspace(0, 1, _CLASSES)
    ordered = np.sort(values)[::-1]
    curve = np.interp(ratio * (ordered.size - 1), np.arange(ordered.size), ordered)
    width = round(_CORE * (_CLASSES - 1))
    first = int(np.argmin(curve[:-width] - curve[width:]))
    core = slice(first, first + width + 1)
    slope, upper = np.polyfit(ratio[core], curve[core], 1)
    lower = upper + slope
    # The curve decreases, and np.interp needs values that increase.
    smr1, smr2 = (float(np.interp(-level, -curve, ratio)) for level in (upper, lower))
    # Area between the curve and a level, above or below; the last class is cut at the level.
    above = _area_above(ratio, curve, float(upper))
    below = _area_above(ratio, -curve[::-1], -float(lower))
    at = {percentile: float(np.interp(percentile, ratio, curve)) for percentile in (_PEAK, _DALE)}
    material = {percentile: _area_above(ratio, curve, at[percentile]) for percentile in at}
    void = {percentile: _area_above(ratio, -curve[::-1], -at[percentile]) for percentile in at}
    lengths = {
        "Sk": float(upper - lower),
        "Spk": 2 * above / smr1 if smr1 > 0 else 0.0,
        "Svk": 2 * below / (1 - smr2) if smr2 < 1 else 0.0,
        "Vmp": material[_PEAK],
        "Vmc": material[_DALE] - material[_PEAK],
        "Vvc": void[_PEAK] - void[_DALE],
        "Vvv": void[_DALE],
    }
    ratios = {"Smr1": 100 * smr1, "Smr2": 100 * smr2}
    return {name: _MICROMETRES * value for name, value in lengths.items()} | ratios


def _area_above(ratio: Doubles, curve: Doubles, level: float) -> float:
    """Return the area between a decreasing curve and a level below its first part."""
    return float(np.trapezoid(np.maximum(curve - level, 0.0), ratio))


@dataclass(frozen=True, slots=True)
class Slopes:
    """The neighbours and cells of a map that are measured, from which slopes are computed."""

    across: Mask  # (H, W-1): both neighbours along x are known
    along: Mask  # (H-1, W)
    cells: Mask  # (H-1, W-1): all four corners are known

    @classmethod
    def of(cls, measured: Mask) -> Slopes:
        """Find the neighbours and cells of measured pixels."""
        across, along = measured[:, 1:] & measured[:, :-1], measured[1:] & measured[:-1]
        return cls(across, along, across[1:] & across[:-1])

    def hybrid_parameters(self, values: Doubles, pixel_size: tuple[float, float]) -> dict[str, float]:
        """Return Sdq, and Sdr from two triangulations of each cell (ISO 25178-2, annex)."""
        across = np.diff(values, axis=1) / pixel_size[0]
        along = np.diff(values, axis=0) / pixel_size[1]
        if not (self.across.any() and self.along.any()):
            return {"Sdq": math.nan, "Sdr": math.nan}
        square = float(np.mean(across[self.across] ** 2) + np.mean(along[self.along] ** 2))
        if not self.cells.any():
            return {"Sdq": math.sqrt(square), "Sdr": math.nan}
        top, bottom = across[:-1][self.cells] ** 2, across[1:][self.cells] ** 2
        before, after = along[:, :-1][self.cells] ** 2, along[:, 1:][self.cells] ** 2
        # sqrt(1 + s) - 1 without cancellation.
        excess = sum(
            float(np.mean(steep / (np.sqrt(1 + steep) + 1)))
            for steep in (top + before, top + after, bottom + before, bottom + after)
        )
        return {"Sdq": math.sqrt(square), "Sdr": 100 * excess / 4}


class Autocorrelation:
    """The autocorrelation of a map with holes: sums over all pairs of measured pixels, by their lag."""

    def __init__(self, measured: Mask, pixel_size: tuple[float, float]) -> None:
        from scipy import fft

        self._size = pixel_size
        # The largest lag is half the size, and the period must not bring longer ones there.
        self._half = tuple(count // 2 for count in measured.shape)
        self._shape = tuple(
            fft.next_fast_len(count + half + 1, real=True)
            for count, half in zip(measured.shape, self._half, strict=True)
        )
        pairs = self._correlate(measured)
        self._counted = pairs > _MIN_OVERLAP * np.count_nonzero(measured)
        self._pairs = np.maximum(pairs, 1.0)

    def _correlate(self, values: NDArray[Any]) -> Doubles:
        """Return the sums of products by lag, from minus to plus half the size."""
        from scipy import fft

        wave = np.asarray(fft.rfft2(values.astype(np.float32), self._shape)).view(np.float32)
        wave *= wave
        products = fft.irfft2(wave[:, ::2] + wave[:, 1::2], self._shape)
        rows, columns = self._half
        products = np.concatenate([products[-rows:] if rows else products[:0], products[: rows + 1]])
        left = products[:, -columns:] if columns else products[:, :0]
        return np.concatenate([left, products[:, : columns + 1]], axis=1)

    def of(self, values: Doubles) -> Doubles:
        """Return the mean products by lag, with the lag 0 in the middle, of values that are 0 in holes."""
        return np.asarray(self._correlate(values) / self._pairs)

    def lengths(self, correlation: Doubles) -> dict[str, float]:
        """Return Sal and Str: the shortest decay to 0.2, and its ratio to the longest one.

        Str is NaN if a direction does not decay within the lags at which a tenth of the pixels overlap.
        """
        from scipy import ndimage

        rows, columns = self._half
        variance = correlation[rows, columns]
        if not variance > 0:
            return {"Sal": math.nan, "Str": math.nan}
        angle = np.arange(_DIRECTIONS) * (math.pi / _DIRECTIONS)
        width, height = self._size
        unit = min(width, height) * _STEP
        distance = np.arange(0, math.hypot(rows * height, columns * width), unit)
        at = np.stack(
            [
                rows - np.multiply.outer(np.sin(angle), distance) / height,
                columns + np.multiply.outer(np.cos(angle), distance) / width,
            ]
        )
        along = ndimage.map_coordinates(
            np.where(self._counted, correlation / variance, np.nan), at, order=1, cval=np.nan
        )
        below = along < _DECAY
        outside = np.isnan(along)
        ends = np.argmax(below | outside, axis=1)
        line = np.arange(_DIRECTIONS)
        decayed = below[line, ends]
        if not decayed.any():
            return {"Sal": math.nan, "Str": math.nan}
        before, after = along[line, ends - 1], along[line, ends]
        lengths = distance[ends] - unit * (_DECAY - after) / np.where(before > after, before - after, 1.0)
        shortest = float(np.min(lengths[decayed]))
        ratio = shortest / float(np.max(lengths)) if decayed.all() else math.nan
        return {"Sal": shortest, "Str": ratio}


class AngularSpectrum:
    """The direction of the strongest waves of a map (ISO 25178-2, angular amplitude density)."""

    def __init__(self, measured: Mask, pixel_size: tuple[float, float]) -> None:
        from scipy import fft

        self._known = measured
        rows, columns = measured.shape
        across = fft.rfftfreq(columns, pixel_size[0])[np.newaxis]
        up = -fft.fftfreq(rows, pixel_size[1])[:, np.newaxis]  # rows run down
        radius = np.hypot(across, up)
        self._inside = (radius > 0) & (radius <= 0.5 / max(pixel_size))
        angle = np.degrees(np.arctan2(up, across)) % 180
        self._bin = np.rint(angle[self._inside]).astype(np.intp) % 180
        self._count = self._smooth(np.bincount(self._bin, minlength=180).astype(np.float64))

    @staticmethod
    def _smooth(values: Doubles) -> Doubles:
        from scipy import ndimage

        return np.asarray(ndimage.gaussian_filter1d(values, _ANGLE_SPREAD, mode="wrap"))

    def direction(self, values: Doubles) -> float:
        """Return Std: the angle of the waves with the largest amplitude, degrees counter-clockwise from x."""
        from scipy import fft

        if not self._inside.any():
            return math.nan
        wave = np.abs(fft.rfft2(np.where(self._known, values, 0.0).astype(np.float32)))[self._inside]
        amount = self._smooth(np.bincount(self._bin, wave, 180).astype(np.float64))
        density = amount / np.where(self._count > 0, self._count, np.inf)
        top = int(np.argmax(density))
        before, middle, after = density[[top - 1, top, (top + 1) % 180]]
        bend = before - 2 * middle + after
        return float((top + (0.5 * (before - after) / bend if bend < 0 else 0.0)) % 180)
