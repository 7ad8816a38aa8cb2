"""Curves of sharpness: what they have in common, and whether travel and light of the frames fit to them.

The logarithm of the contrast is a parabola of the travel around the sharpest frame. If a frame is missing
there, it is one if later frames have travelled a step further. Light that changes with the travel shifts all
peaks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.io import Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import MEDIAN_SQUARE, fit_clipped

if TYPE_CHECKING:
    from mirrorskin.engine.optical.focus import Focus

GRID_LINES = 64
"""Lines of pixels along a side of the picture whose curves are used."""

_FEWEST = 64  # least number of pixels around a frame
_SHIFTS = 1, -1, 2  # steps of the travel by which later frames may be wrong
_BETTER = 0.25  # largest ratio of the squares of residuals with and without a jump
_CONTRAST = 5.0  # least contrast of a peak above that of noise, in standard errors
_DISTANCES = 32  # most distances from the focus at which light is compared
_LARGEST = 1e18  # noise whose square a float32 holds


class TravelJump(Step):
    """Warn if from one frame on the travel is wrong."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result; its process has the warning, if the peaks do not fit to the travel."""
        operation = cast("Focus", context.operation)
        noise, freedom = operation.noise or 0.0, (2 * operation.radius + 1) ** 2 - 1
        if not 0 < noise < _LARGEST or operation.reach < 2:
            return result
        jump = find_travel_jump(*operation.peaks(), context.positions("travel"), freedom, noise**2)
        return result if jump is None else with_findings(result, jump)


class LightTrend(Step):
    """Add to standard deviations what light that changes over the stack shifts peaks by."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with larger standard deviations, if samples of all frames show the light."""
        operation, travel = cast("Focus", context.operation), context.positions("travel")
        noise, freedom = operation.noise or 0.0, (2 * operation.radius + 1) ** 2 - 1
        unit = float(np.ptp(travel)) / max(len(travel) - 1, 1)
        if context.samples is None or not 0 < noise < _LARGEST:
            return result
        curves = curves_of(*operation.peaks(), travel, unit, freedom, noise**2)
        if curves is None:
            return result
        bent = _parabolas(*curves[:3])[0][:, 2]
        if not (peaked := bent < 0).any():
            return result
        width = float(np.median(-1 / bent[peaked])) * unit**2
        trend = light_trend(context.samples, np.asarray(result["height"]), travel)
        return result.assign(height_sigma=np.hypot(result["height_sigma"], np.float32(width) * trend))


def light_trend(samples: FrameSamples, height: NDArray[Any], travel: Doubles) -> NDArray[np.float32]:
    """Return the slopes of the logarithm of the light, 1/mm of travel: a plane over the picture, (H, W).

    Defocus is the same above and below the focus, so that only the light changes samples at equal distances
    from there differently.
    """
    peak = -samples.of_map(height).astype(np.float64).ravel()
    places, order = np.unique(travel, return_index=True)
    values = samples.values[order].reshape(len(places), -1).astype(np.float64)
    known = np.isfinite(peak) & np.isfinite(values).all(axis=0) & (values.mean(axis=0) > 0)
    if len(places) < 2 or np.count_nonzero(known) < _FEWEST:
        return np.zeros(height.shape, np.float32)
    peak, values = peak[known], values[:, known]
    farthest = np.minimum(peak - places[0], places[-1] - peak)
    change, weight = np.zeros_like(peak), np.zeros_like(peak)
    for distance in np.linspace(0, np.ptp(places) / 2, min(len(places) // 2, _DISTANCES) + 1)[1:]:
        above, below = (_interpolated(values, places, peak + side * distance) for side in (1, -1))
        used = farthest >= distance
        change += np.where(used, distance * (above - below), 0)
        weight += np.where(used, 2 * distance**2, 0)
    rows, columns = (np.linspace(-1, 1, length) for length in height.shape)
    grid = np.meshgrid(rows[samples.rows], columns[samples.columns], indexing="ij")
    plane = np.stack([np.ones(known.size), *(axis.ravel() for axis in grid)], axis=1)[known]
    used = weight > 0
    slopes = change[used] / weight[used] / values.mean(axis=0)[used]
    fitted = fit_clipped(plane[used], slopes, 1 / np.sqrt(weight[used]))
    if fitted is None:
        return np.zeros(height.shape, np.float32)
    level, down, across = fitted.parameters
    return np.asarray(level + down * rows[:, np.newaxis] + across * columns, np.float32)


def _interpolated(values: Doubles, places: Doubles, at: Doubles) -> Doubles:
    """Return the values, (T, n), at one place each, (n,)."""
    after = np.clip(np.searchsorted(places, at), 1, len(places) - 1)
    share = (at - places[after - 1]) / (places[after] - places[after - 1])
    pixels = np.arange(values.shape[1])
    return np.asarray((1 - share) * values[after - 1, pixels] + share * values[after, pixels])


def find_travel_jump(
    peak: NDArray[Any], best: NDArray[Any], travel: Doubles, freedom: int, variance: float
) -> Finding | None:
    """Return that from one frame on the travel is wrong, if peaks show it.

    ``peak``, (2 reach + 1, H, W), is the contrast in the frames around the sharpest one of each pixel,
    ``best``, (H, W); it is ``freedom`` times ``variance`` by noise alone.
    """
    reach = len(peak) // 2
    step = float(np.median(np.diff(travel))) if len(travel) > 1 else 0.0
    curves = curves_of(peak, best, travel, step, freedom, variance)
    if curves is None:
        return None
    values, weights, places, sharpest = curves
    around = np.arange(-reach, reach + 1)[:, np.newaxis]
    usual = _residual(values, weights, places)
    candidates = []
    for shift in _SHIFTS:
        moved = {
            j: _residual(values, weights, places + shift * (around >= j)) for j in range(1 - reach, reach + 1)
        }
        for frame in range(reach, len(travel) - reach):
            pixels = {j: sharpest == frame - j for j in moved}
            number = sum(int(np.count_nonzero(selected)) for selected in pixels.values())
            before = sum(float(np.sum(usual[selected])) for selected in pixels.values())
            after = sum(float(np.sum(moved[j][selected])) for j, selected in pixels.items())
            if number >= _FEWEST and before > 0:
                candidates.append((after / before, frame, shift))
    ratio, frame, shift = min(candidates, default=(1.0, 0, 0))
    if ratio > _BETTER:
        return None
    frames = "a frame" if abs(shift) == 1 else f"{shift} frames"
    cause = f"{'was' if abs(shift) == 1 else 'were'} {'missing' if shift > 0 else 'there twice'}"
    return Finding(
        "travel jump",
        f"from frame {frame} on, the peaks of sharpness fit a travel {abs(shift * step):.3g} mm"
        f" {'further' if shift > 0 else 'back'}, as if {frames} before it {cause}: give the travel of each"
        " frame",
    )


def curves_of(
    peak: NDArray[Any], best: NDArray[Any], travel: Doubles, unit: float, freedom: int, variance: float
) -> tuple[Doubles, Doubles, Doubles, NDArray[Any]] | None:
    """Return log S, its weights and places in ``unit``, (2 reach + 1, n), and the sharpest frames, (n,).

    They are those of pixels whose curves are whole; None if these are few.
    """
    reach, sharpest = len(peak) // 2, best.ravel()
    signal = peak.reshape(len(peak), -1).astype(np.float64) - freedom * variance
    enough = _CONTRAST * variance * np.sqrt(2 * freedom)
    whole = np.isfinite(signal).all(axis=0) & (signal > 0).all(axis=0) & (signal[reach] > enough)
    whole &= (sharpest >= reach) & (sharpest < len(travel) - reach)
    if reach < 2 or unit == 0 or np.count_nonzero(whole) < _FEWEST:
        return None
    signal, sharpest = signal[:, whole], sharpest[whole]
    around = np.arange(-reach, reach + 1)[:, np.newaxis]
    places = (travel[sharpest + around] - travel[sharpest]) / unit
    return np.log(signal / signal[reach]), signal**2 / (2 * freedom * variance + 4 * signal), places, sharpest


class CurveShape(NamedTuple):
    """How the curves of sharpness differ from Gaussians in common.

    Attributes
    ----------
    bias : float
        RMS error of the peaks, mm, because of the fourth order.
    excess : float
        Variance of log S in excess of noise that the fourth order does not explain.
    """

    bias: float
    excess: float


def common_shape(
    values: Doubles, weights: Doubles, places: Doubles, sharpest: NDArray[Any], variance: float, unit: float
) -> CurveShape | None:
    """Return the fourth order that curves, as of `curves_of`, have in common.

    A lens that is symmetric about its focus has a curve -w^2 + k w^4 + ... of w, the distance from the peak
    over the width, with the same k everywhere. It is not scatter, and hardly moves the peaks.
    """
    fit, left = _parabolas(values, weights, places)
    peaked = fit[:, 2] < 0
    if np.count_nonzero(peaked) < _FEWEST:
        return None
    fit, left, values, weights, places = (
        fit[peaked], left[:, peaked], values[:, peaked], weights[:, peaked], places[:, peaked]
    )  # fmt: skip
    vertex = -fit[:, 1] / (2 * fit[:, 2])
    fourth = ((places - vertex) ** 2 * fit[:, 2]) ** 2
    _, apparent = _parabolas(fourth, weights, places)
    total = np.sum(weights, axis=0)
    common = float(
        np.median(np.sum(weights * apparent * left, axis=0) / np.sum(weights * apparent**2, axis=0))
    )
    true, _ = _parabolas(values - common * fourth, weights, places)
    bias = vertex + true[:, 1] / (2 * true[:, 2])
    left = left - common * apparent
    degrees = len(values) - 3.0
    columns = np.stack([np.ones_like(places), places, places**2])
    matrix = np.einsum("ikp,jkp,kp->pij", columns, columns, weights)
    square = np.einsum("ikp,jkp,kp->pij", columns, columns, weights**2)
    free = total - np.trace(np.linalg.solve(matrix, square), axis1=1, axis2=2)
    excess = (np.sum(weights * left**2, axis=0) / (1 - 2 / (9 * degrees)) ** 3 - degrees * variance) / free
    return CurveShape(
        float(np.sqrt(np.median(bias**2) / MEDIAN_SQUARE)) * abs(unit), max(0.0, float(np.median(excess)))
    )


def _parabolas(values: Doubles, weights: Doubles, places: Doubles) -> tuple[Doubles, Doubles]:
    """Return the coefficients of parabolas through values, (n, 3), and the residuals, (k, n)."""
    columns = np.stack([np.ones_like(places), places, places**2])
    matrix = np.einsum("ikp,jkp,kp->pij", columns, columns, weights)
    matrix += 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, np.newaxis, np.newaxis] * np.eye(3)  # equal places
    right = np.einsum("ikp,kp,kp->pi", columns, weights, values)
    fit = np.linalg.solve(matrix, right[..., np.newaxis])[..., 0]
    return fit, values - np.einsum("ikp,pi->kp", columns, fit)


def _residual(values: Doubles, weights: Doubles, places: Doubles) -> Doubles:
    """Return the weighted squares that parabolas through the values, (n, pixels), leave at each pixel."""
    return np.asarray(np.sum(weights * _parabolas(values, weights, places)[1] ** 2, axis=0))
