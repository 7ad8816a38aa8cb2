"""A surface from absolute heights and slopes, with inverse-variance weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.diagnosis.footprint import PIXEL
from mirrorskin.engine.fusion.agreement import (
    Disagreement,
    ZenithBias,
    describe_disagreement,
    find_disagreement,
)
from mirrorskin.engine.fusion.common_height import CommonHeight, PressSteps
from mirrorskin.engine.integration.arrays import integrate_arrays
from mirrorskin.engine.integration.common_errors import find_common_errors
from mirrorskin.engine.integration.normals_to_height import Slopes
from mirrorskin.engine.press.holes import fill_holes
from mirrorskin.engine.press.intervals import estimate_interval_scatter, fit_paraboloids, interval_evidence
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device

Mask = NDArray[np.bool_]

_UNIFORM = np.sqrt(3.0)  # half the width of a uniform distribution, in its standard deviations
_MIN_SIGMA = 1e-5  # smallest standard deviation of a height, mm
_MIN_WINDOW, _MAX_WINDOW = 2.0, 8.0  # pixels: standard deviation of windows for slopes of heights
_NEAR = 3.0  # largest distance from a normal at which slopes of heights are used, in windows
_MIN_SLOPE = 0.05  # smallest slope from which the width of terraces is computed
_FIRM = 30.0  # standard deviation of a press' height over that of the surface near normals
_OFF = 4.0  # standard deviations from the heights around, above which a height is an outlier
_MAX_MISFIT = 3.0  # mean squared misfit, in standard deviations, above which a surface is not smooth
_OVERSTATED = 2.0  # ratio of errors of heights to their sigmas up to which the sigmas are not changed
_SEVERAL = 6.0  # smallest range of heights, in half intervals, for uniformly distributed errors
_NEARLY_ALL = 0.9  # quantile of the errors from which the used share of the intervals is estimated
_MIN_USED = 0.5  # smallest used share of the intervals
_FIRST = 1e-4  # tolerance of the surfaces before the last; with 1e-5, errors are the same within 0.1 %
_USUAL_MISFIT = 0.25  # median square misfit of slopes whose errors are as stated, in variances
_MIN_SLOPES = 1000  # slopes that determine this median
_MIN_EXCESS = 1.15  # ratio of the median to the usual one from which on chance does not explain it
_COMPARED = 1 << 16  # slopes whose misfit is computed
_CORRECTIONS = 3  # largest number of corrections of the slopes
_IMPROVED = 0.5  # share of the disagreement that a correction must leave at most
_DOUBTFUL = 0.5  # share of a disagreement that stays, although usual errors of a turn explain it
_CERTAIN = 4.0  # its chi^2 from which it is a warning nevertheless
_ITERATIONS = 5  # largest number of updates of the components' offsets
_OFFSET_TOLERANCE = 1e-3  # change of an offset, in half intervals, that ends them


@dataclass(frozen=True, slots=True)
class AbsoluteHeights:
    """Heights with standard deviations, such as those of a press."""

    height: Doubles  # (H, W), float64: millimetres; NaN where unknown
    sigma: Doubles  # (H, W), float64: standard deviations, mm; NaN where unknown

    @classmethod
    def of(cls, height: NDArray[np.floating], sigma: NDArray[np.floating], mask: Mask | bool = True) -> Self:
        """Return the finite heights of a map within a mask; sigmas are raised to at least the median."""
        height, sigma = np.asarray(height, np.float64), np.asarray(sigma, np.float64)
        usable = mask & np.isfinite(height) & (sigma >= 0) & (sigma < np.inf)
        # Most pixels with a far smaller sigma than others have an unusual rise of the light.
        lowest_sigma = max(float(np.median(sigma[usable])), _MIN_SIGMA) if usable.any() else _MIN_SIGMA
        return cls(
            np.where(usable, height, np.nan), np.where(usable, np.maximum(sigma, lowest_sigma), np.nan)
        )

    @property
    def defined(self) -> Mask:
        """Pixels with a height, (H, W)."""
        return np.isfinite(self.height)

    @property
    def weight(self) -> Doubles:
        """Inverse variances, 0 where unknown."""
        return np.nan_to_num(1 / self.sigma**2)


class FusionSolver:
    """Integrates heights and slopes in three passes: as given, with slopes from heights, and with intervals.

    Later slopes, of the same frames after another registration, are integrated in one pass: the last surface
    replaces the first two. `surface` raises InputError without any height or slope, and NotConverged if the
    integration does not converge. If slopes are ``doubtful``, as those of frames that were not registered,
    their difference from the heights is part of ``height_sigma`` even if chance explains it. ``modes`` are
    the errors that all slopes have in common; see `mirrorskin.engine.integration.common_errors`. ``steps``
    are those of the press whose heights these are, if known: they determine the uncertainty of the common
    height.
    """

    def __init__(
        self,
        press: AbsoluteHeights,
        pixel_size: ArrayLike,
        robust: bool,
        device: Device,
        footprint: float = PIXEL,
        doubtful: bool = False,
        steps: PressSteps | None = None,
    ) -> None:
        self._press, self._pixel_size = press, check_pixel_size(pixel_size)
        self._robust, self._device, self.footprint = robust, device, footprint
        self._doubtful, self._steps = doubtful, steps
        self.modes: Sequence[float] = ()
        self._near: Result | None = None
        self._zenith_bias, self._disagreement = ZenithBias(), Disagreement()
        self._correlation, self._scatter = 0.0, 1.0
        self._common = CommonHeight()

    def surface(self, slopes: Slopes, *, sigma: bool = True) -> Result:
        """Return the surface of the heights and given slopes.

        If heights and slopes contradict each other, the error of the zenith that explains it best is removed
        from the slopes, and the difference that is left is part of ``height_sigma``.
        """
        if not (slopes.defined | self._press.defined).any():
            raise InputError("there is nothing to fuse: no pixel has a height or a normal")
        surface, self._disagreement = self._fit(self._zenith_bias.corrected(slopes), sigma)
        if self._disagreement.clear:  # perhaps only because the first surface was too far from the last
            surface, self._disagreement = self._fit(self._zenith_bias.corrected(slopes), sigma)
        doubtful = self._doubtful and math.isfinite(self._disagreement.rms)
        contradict = doubtful or self._disagreement.clear or self._zenith_bias != ZenithBias()
        for _ in range(_CORRECTIONS):
            if not self._disagreement.clear or self._disagreement.zenith_bias is None:
                break
            before, near = (surface, self._disagreement, self._zenith_bias), self._near
            self._zenith_bias = self._disagreement.zenith_bias.after(self._zenith_bias)
            surface, self._disagreement = self._fit(self._zenith_bias.corrected(slopes), sigma)
            if not self._disagreement.chi2 < _IMPROVED * before[1].chi2:
                (surface, self._disagreement, self._zenith_bias), self._near = before, near
                break
        if contradict and surface.height_sigma is not None:
            larger = np.hypot(surface.height_sigma, np.float32(self._disagreement.rms))
            surface = surface.assign(height_sigma=larger)
        if self._steps is not None:
            surface, self._common = self._steps.place(surface)
        return surface

    @property
    def process(self) -> dict[str, ProcessValue]:
        """Facts about the last surface: contradictions, correlation of errors, and the common height."""
        process = describe_disagreement(self._disagreement, self._zenith_bias, self._scatter)
        process["height_correlation"] = self._correlation
        if self._common.sigma is not None:
            process |= {
                "common_height_shift": self._common.shift,
                "common_height_sigma": self._common.sigma,
            }
        return process

    def _fit(self, slopes: Slopes, sigma: bool) -> tuple[Result, Disagreement]:
        """Return the surface of heights and slopes, and their disagreement."""
        press, near = self._press, self._near
        if near is None:
            near = self._solve(slopes, press.height, press.weight, sigma=False, tolerance=_FIRST)
        press = _correct_overstated(press, near, slopes)
        extended = _extend(slopes, near, press, self._pixel_size)
        if self._near is None and extended is not slopes:
            first: dict[str, Any] = {"initial_heights": near.height, "sigma": False, "tolerance": _FIRST}
            near = self._solve(extended, press.height, press.weight, **first)
        height, weight = _use_intervals(near, press, slopes)
        surface = self._solve(extended, height, weight, initial_heights=near.height, sigma=sigma)
        common = find_common_errors(
            (slopes.dz_dx, slopes.dz_dy),
            surface.component >= 0,
            self.modes,
            self._pixel_size,
            (*extended.weights, weight),
            np.where(weight > 0, surface.height - height, 0.0),
        )
        before = Disagreement()
        if common.mode is not None:
            before = find_disagreement(surface.height, height, weight, slopes, self._pixel_size)
            slopes = slopes.without(common.mode)
            along_x = np.where(slopes.defined, slopes.dz_dx, extended.dz_dx)
            along_y = np.where(slopes.defined, slopes.dz_dy, extended.dz_dy)
            extended = replace(extended, dz_dx=along_x, dz_dy=along_y)
            at: dict[str, Any] = {"initial_heights": surface.height, "sigma": sigma}
            surface = self._solve(extended, height, weight, **at)
        # Outliers are not part of the surface, but may count in the next call.
        self._near = near.assign(height=np.where(surface.component < 0, near.height, surface.height))
        disagreement = find_disagreement(surface.height, height, weight, slopes, self._pixel_size)
        if before.clear and not disagreement.clear:  # either of both may be wrong
            rms, certain = max(disagreement.rms, _DOUBTFUL * before.rms), before.chi2 > _CERTAIN
            disagreement = replace(disagreement, clear=True, rms=rms, certain=certain)
        self._correlation = _correlation_length(extended, weight)
        if surface.height_sigma is not None:
            self._scatter = _scatter(surface.height, slopes, self._pixel_size)
            total = (surface.height_sigma * np.float32(self._scatter)) ** 2 + common.variance()
            surface = surface.assign(height_sigma=np.sqrt(total))
            surface = _add_error_of_averaging(_set_sigma_of_lone_pixels(surface, weight), self.footprint)
        return surface, disagreement

    def filled(self, surface: Result) -> Result:
        """Return a surface with its holes filled."""
        return _join(_fill(surface, self._pixel_size))

    def _solve(self, slopes: Slopes, height: Doubles, weight: Doubles, **options: Any) -> Result:
        return integrate_arrays(
            slopes.dz_dx,
            slopes.dz_dy,
            self._pixel_size,
            mask=slopes.defined | (weight > 0),
            slope_weights=slopes.weights,
            known_heights=np.where(weight > 0, height, np.nan),
            known_height_weights=weight,
            robust=self._robust,
            slope_correlation=0.0,  # `_scatter` compares slopes and stated errors
            device=self._device,
            **options,
        )


def _correlation_length(slopes: Slopes, weight: Doubles) -> float:
    """Return the length, mm, over which errors of heights are correlated: their sigma over that of slopes.

    See `mirrorskin.engine.metrology.noise`. Heights without a weight make the others less dense.
    """
    defined = slopes.defined
    if not defined.any():
        return 0.0
    height_weight = float(np.mean(weight[defined | (weight > 0)]))
    slope_deviation = float(np.mean(np.sqrt(slopes.weights[:, defined])))
    return slope_deviation / math.sqrt(height_weight) if height_weight > 0 else math.inf


def _correct_overstated(press: AbsoluteHeights, surface: Result, slopes: Slopes) -> AbsoluteHeights:
    """Raise sigmas to the size of the errors, if the slopes show that most are much too small."""
    both = press.defined & slopes.defined
    if not both.any():
        return press
    off = press.height[both] - surface.height[both]
    # The median of a uniform distribution's magnitude is half of its half-width.
    usual = float(np.median(np.abs(off - np.median(off)))) * 2 / _UNIFORM
    if usual < _OVERSTATED * float(np.median(press.sigma[both])):
        return press
    return AbsoluteHeights(press.height, np.maximum(press.sigma, usual))


def _extend(
    slopes: Slopes, surface: Result, press: AbsoluteHeights, pixel_size: tuple[float, float]
) -> Slopes:
    """Add slopes, fitted to heights in a window, at pixels near normals that have a height but no normal.

    The window spans at least a terrace. Windows overlap, so each slope counts only for its share of a window.
    No slopes are added where heights do not fit a smooth surface.
    """
    gaps = press.defined & ~slopes.defined
    if not gaps.any() or not slopes.defined.any():
        return slopes
    sigma = float(np.median(press.sigma[press.defined]))
    width = _window(slopes, sigma, min(pixel_size))
    size = 2 * int(_NEAR * width) + 1
    gaps &= cv2.dilate(slopes.defined.view(np.uint8), np.ones((size, size), np.uint8)) > 0
    height = np.where(gaps, press.height, surface.height)
    firm = slopes.defined & np.isfinite(height)
    weight = np.where(firm, (_FIRM / sigma) ** 2, np.where(gaps, 1 / press.sigma**2, 0.0))
    trend = fit_paraboloids(height, weight, gaps, width)
    off = np.abs(height[gaps] - trend.height) > _OFF * press.sigma[gaps]
    if off.any():  # fit again without outliers
        weight[gaps] = np.where(off, 0.0, weight[gaps])
        trend = fit_paraboloids(height, weight, gaps, width)
    smooth = trend.misfit < _MAX_MISFIT
    gaps[gaps] = smooth
    along = trend.along[:, smooth] / np.array([[pixel_size[0]], [-pixel_size[1]]])
    variance = trend.variance[:, smooth] * trend.pixels[smooth] / np.square(pixel_size)[:, np.newaxis]
    dz_dx, dz_dy, weights = slopes.dz_dx.copy(), slopes.dz_dy.copy(), slopes.weights.copy()
    dz_dx[gaps], dz_dy[gaps] = along
    weights[:, gaps] = 1 / variance
    return Slopes(dz_dx, dz_dy, weights)


def _window(slopes: Slopes, sigma: float, pixel: float) -> float:
    """Return the width of windows, in pixels, that span a terrace at the median slope."""
    steepness = np.hypot(slopes.dz_dx[slopes.defined], slopes.dz_dy[slopes.defined])
    terrace = 2 * _UNIFORM * sigma / (pixel * max(float(np.median(steepness)), _MIN_SLOPE))
    return float(np.clip(terrace, _MIN_WINDOW, _MAX_WINDOW))


def _use_intervals(surface: Result, press: AbsoluteHeights, slopes: Slopes) -> tuple[Doubles, Doubles]:
    """Return known heights and their weights from their intervals, given an approximate surface.

    Heights far from the surface are outliers, with weight 0. So are heights without a normal, which are at
    rims and often late, if their component has others. If no height of a component is near an end of its
    interval, the component is on one terrace, and all of its heights together count as one.
    """
    size = _sizes(surface)
    joined = press.defined & (size[surface.component] > 1)
    both = joined & slopes.defined
    has_both = np.bincount(surface.component[both], minlength=size.size) > 0
    joined &= slopes.defined | ~has_both[surface.component]
    height, weight = press.height.copy(), press.weight
    if not joined.any():
        return height, weight
    label, half = surface.component[joined], _UNIFORM * press.sigma[joined]
    middle, shape = press.height[joined], surface.height[joined].astype(np.float64)
    lift = _most_agreed(middle - shape, half, label, size.size)  # steps from a mean may end elsewhere
    half *= _share_used(middle - shape - lift[label], half, shape)
    for _ in range(_ITERATIONS):
        at = shape + lift[label]
        spread = estimate_interval_scatter(middle - at, half)
        inside = interval_evidence(at, middle, half, spread)
        firm = np.bincount(label, inside.weight, size.size)
        move = np.bincount(label, inside.weight * (inside.height - at), size.size) / np.where(firm, firm, 1)
        lift += move
        if np.max(np.abs(move)) < _OFFSET_TOLERANCE * float(np.median(half)):
            break
    weight = np.nan_to_num(1 / (press.sigma**2 + spread.blur**2))
    weight[has_both[surface.component] & ~slopes.defined & (surface.component >= 0)] = 0.0
    near = inside.weight > 0
    count = np.maximum(np.bincount(label, near, size.size), 1)
    plain = np.where(near, weight[joined] / count[label], 0.0)
    ends = (firm > np.bincount(label, plain, size.size))[label]
    height[joined] = np.where(ends, inside.height, middle)
    weight[joined] = np.where(ends, inside.weight, plain)
    return height, weight


def _most_agreed(error: Doubles, half: Doubles, label: NDArray[np.integer], count: int) -> Doubles:
    """Return, for each label, the offset at which most errors are within their intervals, 0 without any.

    If it is not unique, it is the middle of the least and the greatest.
    """
    offset = np.concatenate([error - half, error + half])
    enters = np.repeat([1, -1], error.size)
    order = np.lexsort((-enters, offset, np.tile(label, 2)))
    offset, label = offset[order], np.tile(label, 2)[order]
    agreeing = np.cumsum(enters[order])  # 0 at the end of each label
    most = np.zeros(count, np.int64)
    np.maximum.at(most, label, agreeing)
    first = np.flatnonzero(agreeing == most[label])  # they agree up to the next offset
    ends = np.zeros((2, count))
    ends[0, label[first[::-1]]] = offset[first[::-1]]  # the first of each label
    ends[1, label[first]] = offset[first + 1]  # the last
    return np.asarray(ends.mean(axis=0))


def _share_used(error: Doubles, half: Doubles, height: Doubles) -> float:
    """Return the share of the intervals within which errors are, if heights span several intervals.

    Samples may determine the onset better than within an interval. With intervals that are too long, the few
    errors outside of them would determine the surface.
    """
    if np.ptp(height) < _SEVERAL * float(np.median(half)):
        return 1.0
    used = np.quantile(np.abs(error) / half, _NEARLY_ALL) / _NEARLY_ALL
    return float(np.clip(used, _MIN_USED, 1.0))


def _sizes(surface: Result) -> NDArray[np.intp]:
    """Return the number of pixels of each component."""
    return np.bincount(surface.component[surface.component >= 0], minlength=len(surface.offset_unknown))


def _set_sigma_of_lone_pixels(surface: Result, weight: Doubles) -> Result:
    """Set the standard deviations of components of one pixel to those of their heights."""
    lone = (surface.component >= 0) & (weight > 0) & (_sizes(surface)[surface.component] == 1)
    sigma = surface.height_sigma.copy()
    sigma[lone] = 1 / np.sqrt(weight[lone])
    return surface.assign(height_sigma=sigma)


def _scatter(surface: NDArray[np.floating], slopes: Slopes, pixel_size: tuple[float, float]) -> float:
    """Return by which factor the errors of slopes exceed those stated, from their misfit; at least 1.

    Errors that are the same in all frames, such as a gain of each pixel, do not show in the residuals of
    the frames, but make neighbouring slopes contradict each other. Errors of the zenith are in one of two
    directions: their variance is then larger by 2 r - 1, if that of both together is larger by r.
    """
    misfits = []
    for axis, slope, variance in (
        (1, slopes.dz_dx * pixel_size[0], pixel_size[0] ** 2),
        (0, -slopes.dz_dy * pixel_size[1], pixel_size[1] ** 2),
    ):
        maps = [surface, slope, slopes.weights[1 - axis]]
        height, rise, weight = (values.T if axis == 0 else values for values in maps)
        each = max(1, height.size // _COMPARED)
        height, rise, weight = (values[::each].astype(np.float64) for values in (height, rise, weight))
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.diff(height, axis=1) - (rise[:, 1:] + rise[:, :-1]) / 2
            misfits.append(error**2 / (variance * (1 / weight[:, 1:] + 1 / weight[:, :-1]) / 4))
    misfit = np.concatenate([values[np.isfinite(values)] for values in misfits])
    ratio = float(np.median(misfit)) / _USUAL_MISFIT if misfit.size >= _MIN_SLOPES else 0.0
    return float(np.sqrt(2 * ratio - 1)) if ratio > _MIN_EXCESS else 1.0


def _add_error_of_averaging(surface: Result, footprint: float) -> Result:
    """Add what a pixel's mean over its area differs from its middle, where the surface is curved, to sigma.

    The mean of a height z over an area with the variances a^2, b^2 exceeds that in its middle by
    (a^2 z_xx + b^2 z_yy) / 2.
    """
    height, inside = surface.height.astype(np.float64), surface.component >= 0
    if surface.edges is not None:
        inside &= surface.edges == 0
    bend = np.zeros(height.shape)
    for axis in (0, 1):
        if height.shape[axis] > 2:
            middle = tuple(slice(1, -1) if axis == inner_axis else slice(None) for inner_axis in (0, 1))
            bend[middle] += np.diff(np.where(inside, height, np.nan), 2, axis=axis)
    sigma = np.hypot(surface.height_sigma, np.nan_to_num(bend) * footprint / 2)
    return surface.assign(height_sigma=sigma.astype(np.float32))


def _fill(surface: Result, pixel_size: ArrayLike) -> Result:
    """Fill holes from the absolute heights around them; relative heights do not change."""
    absolute = (surface.component >= 0) & ~is_relative(surface)
    height, filled = fill_holes(np.where(absolute, surface.height, np.nan), surface.height_sigma, pixel_size)
    filled = np.where(surface.component < 0, filled, 0).astype(np.uint8)
    return surface.assign(height=np.where(filled, height, surface.height), filled=filled)


def is_relative(surface: Result) -> Mask:
    """Return the pixels with a relative height, of components without a known one."""
    return np.asarray(np.append(surface.offset_unknown, 0)[surface.component] != 0)


def _join(surface: Result) -> Result:
    """Merge adjacent components with absolute heights, although no slope connects them."""
    answered = (surface.component >= 0) | (surface.filled > 0)
    relative = is_relative(surface)
    count, labels = cv2.connectedComponents((answered & ~relative).view(np.uint8), connectivity=4)
    names = np.where(relative, count + surface.component, labels - 1)
    _, first, rank = np.unique(names[answered], return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    component = np.full(answered.shape, -1, np.int32)
    component[answered] = order[rank]
    offset_unknown = np.zeros(len(first), np.uint8)
    offset_unknown[component[relative]] = 1
    return surface.assign(component=component, offset_unknown=offset_unknown)
