"""Whether the peaks of sharpness fit to the travel of the frames: a lost frame spoils those around it.

The logarithm of the contrast is a parabola of the travel around the sharpest frame. If a frame is missing
there, it is one if later frames have travelled a step further.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.io import Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.engine.optical.focus import Focus

_LINES, _FEWEST = 64, 64  # lines of pixels along a side that are used; least number of pixels around a frame
_SHIFTS = 1, -1, 2  # steps of the travel by which later frames may be wrong
_BETTER = 0.25  # largest ratio of the squares of residuals with and without a jump
_CONTRAST = 5.0  # least contrast of a peak above that of noise, in standard errors
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


def find_travel_jump(
    peak: NDArray[Any], best: NDArray[Any], travel: Doubles, freedom: int, variance: float
) -> Finding | None:
    """Return that from one frame on the travel is wrong, if peaks show it.

    ``peak``, (2 reach + 1, H, W), is the contrast in the frames around the sharpest one of each pixel,
    ``best``, (H, W); it is ``freedom`` times ``variance`` by noise alone.
    """
    reach, thin = len(peak) // 2, max(1, min(best.shape) // _LINES)
    signal = peak[:, ::thin, ::thin].reshape(len(peak), -1).astype(np.float64) - freedom * variance
    sharpest = best[::thin, ::thin].ravel()
    enough = _CONTRAST * variance * np.sqrt(2 * freedom)
    whole = np.isfinite(signal).all(axis=0) & (signal > 0).all(axis=0) & (signal[reach] > enough)
    whole &= (sharpest >= reach) & (sharpest < len(travel) - reach)
    step = float(np.median(np.diff(travel))) if len(travel) > 1 else 0.0
    if reach < 2 or step == 0 or np.count_nonzero(whole) < _FEWEST:
        return None
    signal, sharpest = signal[:, whole], sharpest[whole]
    around = np.arange(-reach, reach + 1)[:, np.newaxis]
    places = (travel[sharpest + around] - travel[sharpest]) / step
    weights = signal**2 / (2 * freedom * variance + 4 * signal)
    values = np.log(signal / signal[reach])
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


def _residual(values: Doubles, weights: Doubles, places: Doubles) -> Doubles:
    """Return the weighted squares that parabolas through the values, (n, pixels), leave at each pixel."""
    columns = np.stack([np.ones_like(places), places, places**2])
    matrix = np.einsum("ikp,jkp,kp->pij", columns, columns, weights)
    matrix += 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, np.newaxis, np.newaxis] * np.eye(3)  # equal places
    right = np.einsum("ikp,kp,kp->pi", columns, weights, values)
    fit = np.linalg.solve(matrix, right[..., np.newaxis])[..., 0]
    return np.asarray(np.einsum("kp,kp->p", weights, (values - np.einsum("ikp,pi->kp", columns, fit)) ** 2))
