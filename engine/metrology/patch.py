"""The part of a result to measure: checked, cut out, and without filled heights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.inputs import spacing
from mirrorskin.io import InputError, Region, Result
from mirrorskin.io.model.result import select_turn, zero_of_relative
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import MEDIAN_SQUARE, second_differences

Mask = NDArray[np.bool_]

_HIGH = 0.95  # quantile of heights at the upper end of their range
_USUAL, _MEAN_OF_USUAL = 0.95, 0.76  # quantile of the square of a normal variate, and its mean below it
_MOST_INTERVALS = 1 << 20  # of equal heights, which are counted
_PER_LEVEL = 4  # least number of pixels of one height, if heights are steps
_FLAT = 0.5  # share of the pixels of an interval of heights that are flat, from which it is a flat part


class CommonErrors(NamedTuple):
    """How errors of the n measured heights depend on each other, see `common_errors`."""

    share: Doubles  # (n,): of the variance that heights of one interval have in common
    flat: Doubles  # (n,): share of an interval that is flat, from 0 to 1
    interval: NDArray[np.intp]  # (n,): number of the interval
    sigma: float  # millimetres: of an error that all heights have in common


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Heights to measure, in a rectangle of the picture."""

    height: Doubles  # (H, W), float64: measured heights, mm, NaN elsewhere
    filled: Doubles  # (H, W), float64: filled heights, mm, NaN elsewhere
    sigma: Doubles | None  # (H, W), float64: standard deviations of the measured heights, mm
    contact: Mask  # (H, W), bool: the contact of the result (``contact_given``), or pixels with any height
    contact_given: bool
    secant: Doubles | None  # (H, W), float64: surface area over projected area, from the normals, or NaN
    normals_sigma: Doubles | None  # (H, W), float64: standard deviations of the normals, radians
    x: Doubles  # (W,), float64: pixel centres, mm
    y: Doubles  # (H,), float64
    pixel_size: tuple[float, float]  # millimetres along x and y
    absolute: bool  # whether heights are relative to the sheet's rest plane, not to the mean of a component
    place: tuple[slice, slice]  # of the patch in the picture
    noise_length: float  # millimetres over which errors of heights are correlated
    of_press: bool  # whether heights are those of a press, which has heights only in contact
    common: Callable[[], CommonErrors] | None  # of the measured heights, with standard deviations; kept
    notes: tuple[str, ...]  # what is omitted

    @property
    def measured(self) -> Mask:
        """Pixels with a measured height, (H, W)."""
        return np.isfinite(self.height)

    @property
    def pixel_area(self) -> float:
        """Square millimetres."""
        width, height = self.pixel_size
        return width * height

    def sigmas(self) -> Doubles:
        """Return the standard deviations of the measured heights, (n,), mm; NaN if unknown."""
        measured = self.measured
        return np.full(np.count_nonzero(measured), np.nan) if self.sigma is None else self.sigma[measured]

    def error_of_sum(self, weights: Doubles | float = 1.0) -> float:
        """Return the standard deviation, mm, of the sum of measured heights times ``weights``, (H, W).

        Errors that are correlated over a length are shared by the pixels within it. Those that a press has
        because of its steps are the same at equal heights: they cancel where heights spread over a step, but
        not on flat parts.
        """
        measured = self.measured
        if self.sigma is None or self.common is None:
            return math.nan
        weighted = np.broadcast_to(weights, measured.shape)[measured] * self.sigma[measured]
        total = float(np.sum(np.abs(weighted)))
        if math.isinf(self.noise_length):
            return total
        alike = 1 + 2 * math.pi * self.noise_length**2 / self.pixel_area
        common, flat, interval, common_sigma = self.common()
        alone = np.where(flat > _FLAT, 1 - common, 1.0) * weighted**2
        sums = np.bincount(interval, flat * np.sqrt(common) * weighted)
        own = min(math.hypot(math.sqrt(alike * float(np.sum(alone))), float(np.linalg.norm(sums))), total)
        all_at_once = np.sum(np.broadcast_to(weights, measured.shape)[measured]) * common_sigma
        return math.hypot(own, float(all_at_once))

    def common_variance(self, chosen: Mask) -> float:
        """Return the usual variance, mm^2, of chosen heights that those of equal height have in common."""
        if self.sigma is None or self.common is None:
            return math.nan
        square = float(np.median(self.sigma[chosen])) ** 2
        if math.isinf(self.noise_length):
            return square
        common = self.common()
        share = float(np.median(common.share[chosen[self.measured]]))
        return min(square, max(share * square, common.sigma**2))


def common_errors(height: Doubles, sigma: Doubles, result: Result) -> CommonErrors:
    """Return what errors of heights, (H, W) mm, have in common because a press moves in steps.

    An interval of heights is a step. It is flat if it has more pixels than those above and below. There,
    second differences show what is independent from pixel to pixel. Elsewhere, errors of steps show as
    heights that are all at the same place between two frames.
    """
    fitted, measured = result.fitted, np.isfinite(height)
    ratio = np.full(measured.shape, np.nan)
    if min(measured.shape) > 2:
        ratio[1:-1, 1:-1] = (second_differences(height) / sigma[1:-1, 1:-1]) ** 2
    values, ratio = height[measured], ratio[measured]
    places = np.asarray(fitted.frame_travel or (), np.float64)
    if fitted.event is None or len(places) < 2:
        levels = np.unique(values)
        places = levels if levels.size < values.size / _PER_LEVEL else levels[:0]
    step = abs(float(np.median(np.diff(places)))) if len(places) > 1 else 0.0
    least = max(float(np.ptp(values)) / _MOST_INTERVALS, 1e-12)
    above = (values - np.min(values)) / (step or max(math.sqrt(12) * float(np.mean(sigma[measured])), least))
    intervals = [np.rint(above + offset).astype(np.intp) for offset in (0.0, 0.3)]
    # A flat part may be at the limit of two intervals.
    flat, interval = max(((_flatness(part), part) for part in intervals), key=lambda pair: pair[0].sum())
    slope = flat <= _FLAT
    alike = abs(np.mean(np.exp(2j * np.pi * above[slope]))) if slope.any() else 0.0
    # Noise may move a few pixels of a flat part only, between one estimate of the crossing and another.
    known = ratio[~slope & np.isfinite(ratio)]
    usual = known[known <= np.quantile(known, _USUAL)] if known.size else known
    few = float(np.mean(usual)) / _MEAN_OF_USUAL if usual.size else 0.0
    share = np.where(slope, alike, max(1 - min(max(_independent(known), few), 1.0), alike))
    return CommonErrors(share, flat, interval, fitted.height_common_sigma or 0.0)


def _flatness(interval: NDArray[np.intp]) -> Doubles:
    """Return for heights in numbered intervals, (n,), the share that those above and below do not have."""
    count = np.pad(np.bincount(interval), 1)
    flat = 1 - (count[:-2] + count[2:]) / (2 * np.maximum(count[1:-1], 1))
    return np.asarray(np.clip(flat, 0, 1)[interval])


def step_share(height: Doubles, sigma: Doubles) -> float:
    """Return half a step over the range of heights, (n,) mm, at most 1; a step is up to sqrt(12) sigmas.

    The range is that between 5 % and 95 % of the heights.
    """
    step = math.sqrt(12) * float(np.mean(sigma)) if sigma.size else 0.0
    extent = float(np.subtract(*np.quantile(height, [_HIGH, 1 - _HIGH]))) if height.size else 0.0
    return 1.0 if 2 * extent <= step else step / (2 * extent)


def independent_share(height: Doubles, sigma: Doubles) -> float:
    """Return the share of the variance of heights, (H, W) mm, that is independent from pixel to pixel.

    Second differences along both axes show it, as surfaces hardly have any.
    """
    if min(height.shape) < 3:
        return 1.0
    return _independent((second_differences(height) / sigma[1:-1, 1:-1]) ** 2)


def _independent(ratio: Doubles) -> float:
    """Return this share from squares of second differences over variances."""
    known = ratio[np.isfinite(ratio)]
    return min(1.0, float(np.median(known)) / MEDIAN_SQUARE) if known.size else 1.0


def heights_of(result: Result) -> NDArray[np.float32]:
    """Return the heights of one picture, (H, W); InputError without heights, or if each turn has a map."""
    height: NDArray[np.float32] | None = select_turn(result, None).height
    if height is None:
        raise InputError("the result has no heights: take one of a press or of 'mirrorskin fuse'")
    return height


def patch_of(result: Result, region: Region | None = None, kept: Mask | None = None) -> tuple[Patch, Result]:
    """Cut out a region; also return the result without the heights that cannot be compared with those in it.

    ``kept``, (H, W), are the pixels to measure, by default all. Only measured heights with a finite standard
    deviation count. Components with relative heights cannot be compared with others: they are omitted if
    others are absolute; if none is, only the largest is used.
    """
    height = heights_of(result)
    if result.height_sigma is not None and not np.isfinite(result.height_sigma).any():
        result = result.assign(height_sigma=None)
    if result.x is None or result.y is None:
        raise InputError("the result has no pixel size: reconstruct it again with --pixel-size")
    pixel_size = spacing(result.x, result.y)
    if region is None:
        region = Region.whole((height.shape[0], height.shape[1]))
    region.check((height.shape[0], height.shape[1]), "--region")
    part = region.slices
    filled = np.zeros(height.shape, bool) if result.filled is None else result.filled != 0
    measured, notes = _known(result, height, filled)
    if kept is not None:
        notes += [f"pixels left out by a mask: {np.count_nonzero(measured[part] & ~kept[part])}"]
        measured = measured & kept
    measured, absolute, left_out = _comparable(result, measured, part)
    if not np.any(measured[part] & ~filled[part]):
        raise InputError("no height was measured there: choose another region, or another result")
    contact = measured if result.contact is None else result.contact != 0
    if kept is not None:
        contact = contact & kept
    heights = np.where(measured & ~filled, height, np.nan)[part].astype(np.float64)
    sigma = None if result.height_sigma is None else result.height_sigma[part].astype(np.float64)
    patch = Patch(
        height=heights,
        filled=np.where(measured & filled, height, np.nan)[part].astype(np.float64),
        sigma=sigma,
        contact=contact[part],
        contact_given=result.contact is not None,
        secant=None if result.normals is None else _secant(result.normals[part]),
        normals_sigma=None if result.normals_sigma is None else result.normals_sigma[part].astype(np.float64),
        x=result.x[part[1]],
        y=result.y[part[0]],
        pixel_size=pixel_size,
        absolute=absolute,
        place=part,
        noise_length=noise_length(result),
        of_press=result.fitted.event is not None,
        common=None if sigma is None else cache(partial(common_errors, heights, sigma, result)),
        notes=(*left_out, *notes),
    )
    return patch, result.assign(height=np.where(measured, height, np.float32(np.nan)))


def noise_length(result: Result) -> float:
    """Return the length over which errors of heights are correlated, mm; 0 for independent ones."""
    fitted = result.fitted
    if fitted.height_correlation is not None:
        return fitted.height_correlation
    return 0.0 if fitted.integration is None else math.inf


def _known(result: Result, height: NDArray[np.float32], filled: Mask) -> tuple[Mask, list[str]]:
    """Return which heights count, and notes."""
    measured, notes = np.isfinite(height), []
    if result.height_sigma is not None:
        undefined = measured & ~np.isfinite(result.height_sigma) & ~filled
        measured &= ~undefined
        if undefined.any():
            notes.append(f"pixels left out, whose height has no standard deviation: {undefined.sum()}")
    if 1 in height.shape:
        notes.append("a single row or column: pixels are taken to be square")
    return measured, notes


def _comparable(result: Result, measured: Mask, part: tuple[slice, slice]) -> tuple[Mask, bool, list[str]]:
    """Return which heights can be compared, whether they are absolute, and notes."""
    component, unknown = result.component, result.offset_unknown
    if component is None or unknown is None or not np.any(unknown):
        return measured, True, []
    # Component -1, which is none, counts as absolute.
    relative = np.concatenate([[False], unknown != 0])[component + 1]
    inside = np.zeros(measured.shape, bool)
    inside[part] = measured[part]
    if np.any(inside & ~relative):
        lost = np.unique(component[inside & relative]).size
        note = f"components left out, whose height is only relative: {lost}"
        return measured & ~relative, True, [note] if lost else []
    labels, counts = np.unique(component[inside], return_counts=True)
    notes = [f"heights are relative: {zero_of_relative(result)}"]
    if labels.size > 1:
        measured = measured & (component == labels[np.argmax(counts)])
        notes.append(f"only the largest of {labels.size} components is measured: their offsets are unknown")
    return measured, False, notes


def _secant(normals: NDArray[np.float32]) -> Doubles:
    """Return 1 / z of normals; NaN if they do not face the camera."""
    z = normals[..., 2].astype(np.float64)
    return 1 / np.where(z > 0, z, np.nan)
