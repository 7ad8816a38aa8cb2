"""What cameras and stages do to the heights of a press that frames do not show: one model, with priors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import device_of_maps, operand_of
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.engine.diagnosis.sensor_health import (
    LightChange,
    Samples,
    find_light_change,
    reference_of,
    with_light_change,
)
from mirrorskin.engine.diagnosis.turn_nuisances import picture_axes
from mirrorskin.io import Header, Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.model.result import shape_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma
from mirrorskin.kernels.press.relief import add_relief

if TYPE_CHECKING:
    from mirrorskin.engine.press.crossing import PressOperation

_BLURS = np.linspace(0.0, 4.0, 81)  # pixels: those whose probability is computed
_OUT_OF_FOCUS = 3e-4  # probability of a lens that is not as assumed, whose blur may be any of these
_QUANTILES = 0.16, 0.84  # of the rise, two standard deviations of a blurred edge apart
_QUARTER = 0.25  # share of the pixels: the flattest and the steepest ones
_STEEPER = 1.5  # least ratio of their square slopes
_SLOPE_NOISE = 0.2  # steps: what errors of heights between two frames do to a slope
_MIN_PIXELS = 16  # pixels that an estimate needs
_MIN_FRAMES = 8  # frames from which edges show a blur
_INTERPOLATED = 0.17, 0.06  # square steps: what interpolation adds to the variance of an edge, and its error
_MOSTLY, _WITHIN = 0.8, 0.9  # share of light, and of a step, of pixels that turn light at once
_OF_SLOPES = 0.1  # relative error of a footprint because slopes differ inside pixels
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_END_FRACTION = 0.1  # of the frames, at each end, in which levels are compared with the references
_MIN_DISTANCE = 0.3  # of the travel, least distance of these frames from the onset of a pixel
_MIN_GRID_PIXELS = 64  # pixels that show a level
_CLEAR_Z_SCORE = 5.0  # standard errors from which on a level differs from its reference
_MIN_DIFFERENCE = 0.01  # share of the rise to light from which on it differs
_COMMON_Z_SCORE = 2.0  # sigmas of the pixels' own differences above which a difference is common
_ALIKE = 2.0  # standard deviations of light that is alike
_LEAST_NOISE, _MOST_NOISE = 0.004, 0.05  # shares of the rise: limits of these
_CLEAR_LAG, _SHIFTED = 0.02, 0.2  # a lag that is one; what it does to sudden changes, steps
_BLUR_Z_SCORE = 3.0  # standard errors from which on a blur is reported


class Nuisances(Step):
    """Add to the standard deviation of heights what is uncertain about camera, lens and light.

    Each nuisance has a prior, see `mirrorskin.io.Header.prior`. Frames narrow it where they show it: levels
    on plateaus, the footprint of a pixel by steep and flat edges, lag by sudden ones. See the documentation,
    "One model of nuisances".
    """

    needs = ("height", "height_sigma")

    blur: float | None = option(
        default=None,
        within=(0, 100),
        help="standard deviation of the lens's point spread, pixels, which makes heights of curved surfaces"
        " less certain; 0 adds nothing",
        shown_default="estimated from the frames of a recording, if its steps show it",
    )
    dark_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own dark levels about `dark`",
        python_only=True,
    )
    bright_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own bright levels about `bright`",
        python_only=True,
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and what the frames show clearly."""
        edges, header = Edges.of(result, context), context.source.header
        footprint, lag = footprint_of(edges, header, self.blur), header.prior("lag_sigma")
        errors, slow, counted = (0.0, 0.0), 0.0, 0.0
        widening = math.sqrt(1 + 2 * math.pi * max(footprint.variance - PIXEL, 0.0))
        if edges is not None:
            errors, lag, slow = edges.level_errors(), edges.lag(lag, widening), edges.slow()
            if any(errors) or self.dark_sigma or self.bright_sigma:  # otherwise it changes hardly anything
                counted = slow
        step = abs(float(np.median(np.diff(context.positions("travel")))))
        share, common = self._shares(context)
        share = math.hypot(share, *(error / math.sqrt(2) for error in errors))
        added = _Added(
            footprint.variance,
            (share * widening) ** 2,
            (share * counted) ** 2 + (lag * step) ** 2,
        )
        clear_lag = lag > max(_CLEAR_LAG, 2 * header.prior("lag_sigma"))
        if clear_lag:  # a pixel that turns light at once seems to do so slowly
            added = added._replace(offset=added.offset + (_SHIFTED * step) ** 2)
        fitted = result.fitted
        if edges is not None and np.isfinite(edges.slope).any():
            slope = edges.slope[np.isfinite(edges.slope)]
            width = math.hypot(widening * float(np.sqrt(np.mean(slope**2))), slow)
            fitted = replace(fitted, height_common_sigma=common * width)
        found = result.assign(height_sigma=partial(added.to, result), fitted=fitted)
        if footprint.clear:
            process = {**result.process, "blur": round(math.sqrt(footprint.variance - PIXEL), 2)}
            found = found.assign(process=process, fitted=replace(fitted, footprint=footprint.variance))
        if clear_lag or any(errors):
            found = with_findings(found, *_findings(errors, lag if clear_lag else 0.0))
        change = None if edges is None else edges.light_change(context)
        return with_light_change(found, change, reference_of(context.source))

    def _shares(self, context: Context) -> tuple[float, float]:
        """Return the uncertainty of the level at the threshold, before the frames, as a share of the rise.

        The second value is that of gamma and drift alone, whose errors are the same at all pixels.
        """
        operation, prior = cast("PressOperation", context.operation), context.source.header.prior
        threshold, dark, bright = operation.lowest_threshold, operation.dark, operation.bright
        given = 0.0
        if dark is not None and bright is not None and (self.dark_sigma or self.bright_sigma):
            rise = np.asarray(bright, np.float64) - np.asarray(dark, np.float64)
            given = math.hypot((1 - threshold) * self.dark_sigma, threshold * self.bright_sigma)
            given /= float(np.nanmedian(rise))
        gamma = -math.log(threshold) * prior("gamma_sigma") if threshold else 0.0
        common = threshold * math.hypot(gamma, prior("drift_sigma"))
        return math.hypot(given, common, threshold * prior("frame_gain_sigma")), common


class _Added(NamedTuple):
    """What is added to heights: see `mirrorskin.kernels.press.relief.add_relief`."""

    footprint: float
    per_slope: float
    offset: float

    def to(self, result: Result) -> NDArray[np.float32]:
        """Return the standard deviations of heights."""
        device, shape = device_of_maps(None, result), shape_of(result, "height")
        height, sigma = (
            operand_of(result, name, np.float32, shape, device) for name in ("height", "height_sigma")
        )
        assert height is not None  # the step needs them
        assert sigma is not None
        return add_relief(device, height, sigma, *self).release()


def _findings(errors: tuple[float, float], lag: float) -> list[Finding]:
    """Return notes of levels that changed, and of a lag."""
    findings = []
    changes = " and ".join(
        f"{name} by {100 * error:+.2g} %"
        for name, error in zip(("dark", "light"), errors, strict=True)
        if error
    )
    if changes:
        text = f"levels differ from their references, {changes} of the rise; height_sigma includes this"
        findings.append(Finding("levels", text, False))
    if lag:
        text = (
            f"frames still show {100 * lag:.2g} % of the one before, which is in the standard deviations:"
            " lengthen the time between frames, or shorten the exposure"
        )
        findings.append(Finding("lag", text, False))
    return findings


@dataclass(frozen=True)
class Footprint:
    """Variance of the area that a pixel sees, square pixels, and whether it clearly exceeds the pixel."""

    variance: float
    clear: bool = False


class Edges:
    """How the brightness of a grid of pixels rises with travel, and the slopes there."""

    def __init__(
        self, shares: NDArray[np.float32], travel: Doubles, heights: list[NDArray[Any]], noise: float
    ) -> None:
        self.shares, self.travel, self.noise = shares, travel, noise
        self.step = float(np.median(np.diff(travel)))
        middle, before, after, above, below = (values.ravel().astype(np.float64) for values in heights)
        self.onset = -middle
        self.slope = np.hypot((after - before) / 2, (below - above) / 2)

    @classmethod
    def of(cls, result: Result, context: Context) -> Edges | None:
        """Return the edges of a press or a release; None without samples, or if travel oscillates."""
        samples, travel = context.samples, context.positions("travel")
        if samples is None or len(travel) < 3 or (np.diff(travel) * (travel[-1] - travel[0]) < 0).any():
            return None
        operation = cast("PressOperation", context.operation)
        values = samples.values.reshape(len(travel), -1).astype(np.float32)
        if travel[-1] < travel[0]:  # of a release
            values, travel = values[::-1], travel[::-1]
        few = max(1, len(travel) // 10)
        ends = values[:few].mean(axis=0), values[-few:].mean(axis=0)
        dark, bright = (
            end
            if level is None
            else samples.of_map(np.broadcast_to(np.asarray(level, np.float32), operation.shape)).ravel()
            for level, end in zip((operation.dark, operation.bright), ends, strict=True)
        )
        heights = context.neighbours(result)
        rises = np.broadcast_to(bright - dark, values.shape[1:])[np.isfinite(heights[0].ravel())]
        rise = float(np.nanmedian(rises)) if np.isfinite(rises).any() else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = (values - dark) / (bright - dark)
        noise = (result.fitted.noise or 0.0) / rise if rise > 0 else math.inf
        return cls(shares, travel, heights, noise)

    def reached(self, level: float) -> Doubles:
        """Return the travel at which each share first reaches a level, NaN where it does not."""
        reached = self.shares >= level
        after = np.argmax(reached, axis=0)
        crossed, after = after > 0, np.maximum(after, 1)
        each, travel = np.arange(self.shares.shape[1]), self.travel
        low, high = self.shares[after - 1, each], self.shares[after, each]
        with np.errstate(divide="ignore", invalid="ignore"):
            where = travel[after - 1] + (travel[after] - travel[after - 1]) * (level - low) / (high - low)
        return np.where(crossed, where, np.nan)

    def level_errors(self) -> tuple[float, float]:
        """Return errors of the references of dark and light, shares of the rise; 0 where hardly any."""
        few, start, end = max(1, round(_END_FRACTION * len(self.travel))), self.travel[0], self.travel[-1]
        away = _MIN_DISTANCE * (end - start)
        level_errors = []
        for frames, level, usable in (
            (self.shares[:few], 0.0, self.onset > start + away),
            (self.shares[-few:], 1.0, self.onset < end - away),
        ):
            error = frames[:, usable].mean(axis=0) - level
            error = error[np.isfinite(error)]
            if error.size < _MIN_GRID_PIXELS:
                level_errors.append(0.0)
                continue
            middle = float(np.median(error))
            spread = mad_sigma(error - middle)
            clear = max(
                _MIN_DIFFERENCE,
                _COMMON_Z_SCORE * spread,
                _CLEAR_Z_SCORE * _OF_MEDIAN * spread / math.sqrt(error.size),
            )
            level_errors.append(middle if abs(middle) > clear else 0.0)
        return level_errors[0], level_errors[1]

    def light_change(self, context: Context) -> LightChange | None:
        """Return by how much full light differs from its reference; None without references."""
        operation = cast("PressOperation", context.operation)
        missing = operation.dark is None or operation.bright is None
        if missing or operation.estimated_levels or context.samples is None:
            return None
        few = max(1, round(_END_FRACTION * len(self.travel)))
        usable = self.onset < self.travel[-1] - _MIN_DISTANCE * (self.travel[-1] - self.travel[0])
        ratio = np.where(usable, self.shares[-few:].mean(axis=0), np.nan).astype(np.float64)
        middle = ratio[np.isfinite(ratio)]
        if middle.size < _MIN_GRID_PIXELS:
            return None
        # What differs from pixel to pixel, such as slopes that show no full light, is no change of the lamp.
        spread = mad_sigma(middle - np.median(middle))
        header = context.source.header
        x, y = picture_axes(operation.shape)
        x, y = np.meshgrid(x[context.samples.columns], y[context.samples.rows])
        none = np.empty((len(ratio), 0))
        light = Samples(
            ratio, np.full(len(ratio), max(spread, _LEAST_NOISE)), np.ones(len(ratio)), x.ravel(), y.ravel(),
            none, *np.empty((2, 0)),
        )  # fmt: skip
        common = math.hypot(header.prior("frame_gain_sigma"), header.prior("drift_sigma"), spread)
        return find_light_change(light, common, common)

    def slow(self) -> float:
        """Return the travel in which the flattest pixels turn light in addition to their slopes, mm."""
        width = 2 * (self.reached(0.75) - self.reached(0.25))
        finite = np.isfinite(width) & np.isfinite(self.slope)
        if np.count_nonzero(finite) < _MIN_GRID_PIXELS:
            return 0.0
        width, slope = width[finite], self.slope[finite]
        flat = slope <= np.quantile(slope, _QUARTER)
        return math.sqrt(max(0.0, float(np.median(width[flat] ** 2 - slope[flat] ** 2))))

    def lag(self, prior: float, widening: float) -> float:
        """Return the share of a frame that the next one still shows, root mean square.

        Of pixels that turn light within a step, most are fully light in the next frame, unless it lags. The
        travel in which a pixel turns light is its slope times ``widening``.
        """
        each = np.arange(self.shares.shape[1])
        after = np.argmax(self.shares >= _MOSTLY, axis=0)
        usable = (after > 0) & (after + 2 < len(self.travel)) & (self.slope * widening < _WITHIN * self.step)
        after, each = after[usable], each[usable]
        before, first, *later = (self.shares[after + number, each] for number in (-1, 0, 1, 2))
        finite = np.isfinite([first, *later]).all(axis=0)  # not where both levels are equal
        before, first, *later = (shares[finite] for shares in (before, first, *later))
        sudden = (before < max(_MOSTLY - 0.75, 3 * self.noise)) & (np.min(later, axis=0) > _MOSTLY)
        if np.count_nonzero(sudden) < _MIN_PIXELS or self.noise > _MOST_NOISE:
            return prior
        share, most = np.quantile(first[sudden] / np.mean(later, axis=0)[sudden], (0.5, _MOSTLY))
        if most - share > _ALIKE * max(self.noise, _LEAST_NOISE):  # these turn light slowly
            return prior
        return math.hypot(max(1 - float(most), 0.0), self.noise / 2)

    def variance(self) -> tuple[float, float]:
        """Return the variance of the footprint, square pixels, and its standard error; inf if not shown."""
        if len(self.travel) < _MIN_FRAMES:
            return PIXEL, math.inf
        low, high = map(self.reached, _QUANTILES)
        spread = ((high - low) / 2) ** 2
        usable = np.isfinite(spread) & np.isfinite(self.slope) & (self.slope > 0)
        if np.count_nonzero(usable) < _MIN_PIXELS:
            return PIXEL, math.inf
        square, spread = self.slope[usable] ** 2, spread[usable]
        ends = np.quantile(square, (_QUARTER, 1 - _QUARTER))
        medians, errors, squares = [], [], []
        for part in (square <= ends[0], square >= ends[1]):
            middle = float(np.median(spread[part]))
            medians.append(middle)
            errors.append(_OF_MEDIAN * mad_sigma(spread[part] - middle) / math.sqrt(np.count_nonzero(part)))
            squares.append(float(np.median(square[part])))
        rise = squares[1] - squares[0]
        if squares[1] < _STEEPER * squares[0]:
            return PIXEL, math.inf
        added, unsure = (value * self.step**2 for value in _INTERPOLATED)
        # What flat parts show as well is no footprint: interpolation, or a skin that touches slowly.
        variance = (medians[1] - added - max(medians[0] - added, 0.0)) / rise
        return variance, math.hypot(*errors, unsure, variance * (_SLOPE_NOISE * self.step) ** 2) / rise


def footprint_of(edges: Edges | None, header: Header, stated: float | None) -> Footprint:
    """Return a pixel's footprint: that of a stated blur, or its mean square by edges and prior."""
    if stated is not None:
        return Footprint(stated**2 + PIXEL if stated else 0.0, bool(stated))
    variance, error = (PIXEL, math.inf) if edges is None else edges.variance()
    away = (_BLURS - LEAST_BLUR) / max(header.prior("blur_sigma"), 1e-3)
    density = np.exp(-0.5 * away**2)
    density = density / np.sum(density) + _OUT_OF_FOCUS / len(_BLURS)
    clear = variance - PIXEL > _BLUR_Z_SCORE * error
    if error < math.inf:
        variance, error = max(variance, PIXEL), math.hypot(error, _OF_SLOPES * variance)
        misfit = (_BLURS**2 + PIXEL - variance) / error
        density = (1.0 if clear else density) * np.exp(-0.5 * np.minimum(misfit**2, 100.0))
    square = float(np.sum(density * (_BLURS**2 + PIXEL) ** 2) / np.sum(density))
    return Footprint(math.sqrt(square), clear)
