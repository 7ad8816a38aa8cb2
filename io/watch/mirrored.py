"""Whether the phases of a turn are reversed: then the slopes that brightness shows belong to no surface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.types import Block, Floats
from mirrorskin.io.watch.saturation import MAD

MIRRORED = Finding(
    "mirrored",
    "the slopes fit together better with the phases reversed: do phases count counter-clockwise in the"
    " picture?",
)
"""The finding that phases are reversed."""

_SIDE = 128  # pixels of the grid along each side, at most
_REACH = 16  # pixels of the grid over the distance at which slopes are compared
_POINTS_MIN = 100
_CLEAR, _CORRELATION, _OTHER = 2.5, 0.15, 0.05  # least z-score and correlation; most of the other comparison
_SWINGS = 3.0  # least amplitude of a pixel in contact, standard deviations of the residual
_USUAL = 0.25  # least amplitude, share of the median
_CONDITION = 10.0  # most of the fit of a turn: phases on one axis show no direction
_STEEPEST = 1.4  # zenith, radians
_LIMIT = 3.0  # of outliers, standard deviations


class TurnMoments:
    """Sums over the frames of a turn, from which the brightness of each pixel is fitted by its phase.

    ``shape``: frames, rows and columns.
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        steps = [-(-length // _SIDE) for length in shape[1:]]
        self._grid = slice(None, None, steps[0]), slice(None, None, steps[1])
        self._matrix, self._count = np.zeros((3, 3)), 0
        self._sums: Floats | None = None

    def push(self, block: Block) -> None:
        """Add frames, if they have phases."""
        if block.phase is None:
            return
        phase = np.asarray(block.phase, np.float64)
        waves = np.stack([np.ones(len(phase)), np.cos(phase), np.sin(phase)])
        counts = np.asarray(block.frames)[:, *self._grid].astype(np.float64)
        sums = np.stack([*np.tensordot(waves, counts, 1), np.einsum("tij,tij->ij", counts, counts)])
        self._sums = sums if self._sums is None else self._sums + sums
        self._matrix += waves @ waves.T
        self._count += len(phase)

    def is_mirrored(self, zenith_offset: Any, zenith_gain: Any) -> bool:
        """Return whether slopes are those of a surface if one of their components has the other sign.

        Slopes p and q of a surface satisfy dp/dy = dq/dx; with the phases reversed, q has the other sign. So
        the mean of their product is positive for a surface, and negative for a mirrored one. Slopes are known
        with ``zenith_offset`` and ``zenith_gain``, numbers or maps; otherwise only their directions are.
        """
        freedom = self._count - 3
        if self._sums is None or freedom < 1 or np.linalg.cond(self._matrix) > _CONDITION:
            return False
        sums = self._sums.reshape(4, -1)
        mean, cosine, sine = solution = np.linalg.solve(self._matrix, sums[:3])
        residual = np.sqrt(np.maximum(sums[3] - np.sum(solution * sums[:3], axis=0), 0) / freedom)
        swing = cosine + 1j * sine
        touched = np.abs(swing) > np.maximum(_SWINGS * residual, 1e-6)
        if not touched.any():
            return False
        touched &= np.abs(swing) > _USUAL * np.median(np.abs(swing[touched]))
        direction = np.where(touched, swing / np.where(touched, np.abs(swing), 1), np.nan)
        scores = [self._compare(direction)]
        if zenith_gain is not None and zenith_offset is not None:
            offset, gain = (self._on_grid(values) for values in (zenith_offset, zenith_gain))
            with np.errstate(divide="ignore", invalid="ignore"):
                steep = np.tan(np.clip((mean - offset) / gain, 0, _STEEPEST))
            scores.append(self._compare(direction * steep))
        clear = any(score > _CLEAR and correlation > _CORRELATION for score, correlation in scores)
        return clear and all(correlation > -_OTHER for _, correlation in scores)

    def _on_grid(self, values: Any) -> NDArray[Any]:
        array = np.asarray(values, np.float64)
        return (array[self._grid] if array.ndim == 2 else array).reshape(-1)

    def _compare(self, slopes: NDArray[np.complex128]) -> tuple[float, float]:
        """Return how clearly slopes p + iq contradict a surface, and their correlation; 0 if unknown."""
        assert self._sums is not None
        slope = slopes.reshape(self._sums.shape[1:])
        reach = max(1, math.isqrt(int(np.count_nonzero(np.isfinite(slope)))) // _REACH)
        arm = max(1, reach // 2)  # four separate pixels have independent noise
        inside = slice(arm, -arm)
        up, down = slope[: -2 * arm, inside], slope[2 * arm :, inside]
        left, right = slope[inside, : -2 * arm], slope[inside, 2 * arm :]
        dp_dy, dq_dx = (up - down).real, (right - left).imag  # y points up
        defined = np.isfinite(dp_dy) & np.isfinite(dq_dx)
        if np.count_nonzero(defined) < _POINTS_MIN:
            return 0.0, 0.0
        dp_dy, dq_dx = _without_outliers(dp_dy[defined]), _without_outliers(dq_dx[defined])
        product = -dp_dy * dq_dx
        sizes, spread = float(np.sum(dp_dy**2) * np.sum(dq_dx**2)), float(np.std(product))
        if sizes <= 0 or spread <= 0:
            return 0.0, 0.0
        error = spread * max(reach, 2 * arm) / math.sqrt(len(product))  # neighbours overlap
        return float(np.mean(product)) / error, float(np.sum(product)) / math.sqrt(sizes)


def _without_outliers(values: Floats) -> Floats:
    limit = _LIMIT * MAD * float(np.median(np.abs(values - np.median(values))))
    return np.clip(values, -limit, limit) if limit > 0 else values
