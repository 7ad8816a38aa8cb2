"""Whether heights and slopes of the same surface contradict each other, and by which error of the slopes.

A wrong gain or offset of the zenith, a response that is not linear, or light that changes during the rotation
bends the surface by far more than the noise: its error is common to neighbours. Heights of a press show it
where they overlap with slopes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.normals_to_height import Slopes
from mirrorskin.io.base.findings import Finding, in_process
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array_types import Doubles

_CELL, _IN_CELL = 16, 64  # pixels along the side of a cell, and least number of them with both
_MIN_CELLS = 4  # number of cells that decide
_CLEAR_Z_SCORE = 3.0  # standard deviations of their mean square
_MAX_LINES, _MIN_LINE_DISTANCE = 48, 4  # largest number of lines in each direction; least pixels between them
_MAX_PART, _MIN_PART = 64, 8  # pixels of a part of a line
_WITH_HEIGHT = 4  # pixels with a height that a part needs
_MIN_PARTS = 12
_MIN_CHI2 = 30.0  # chi^2 of a gain and an offset
_MAX_GAIN, _MAX_OFFSET = 0.25, math.radians(10)  # larger errors than these are something else
_MIN_SLOPE = 0.05  # least slope at which an offset of the zenith has a direction


@dataclass(frozen=True, slots=True)
class ZenithBias:
    """Error of the zenith of slopes: it is (1 + gain) times the true zenith, plus the offset, radians."""

    gain: float = 0.0
    offset: float = 0.0

    def corrected(self, slopes: Slopes) -> Slopes:
        """Return slopes without this error."""
        if self == ZenithBias():
            return slopes
        steepness = np.hypot(slopes.dz_dx, slopes.dz_dy)
        zenith = np.arctan(steepness)
        true = np.maximum(zenith - np.where(steepness > _MIN_SLOPE, self.offset, 0.0), 0.0) / (1 + self.gain)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(steepness > 0, np.tan(true) / steepness, 1.0).astype(np.float32)
        return replace(slopes, dz_dx=slopes.dz_dx * factor, dz_dy=slopes.dz_dy * factor)

    def after(self, other: ZenithBias) -> ZenithBias:
        """Return this error and another one, which was removed before."""
        return ZenithBias(
            (1 + self.gain) * (1 + other.gain) - 1, self.offset * (1 + other.gain) + other.offset
        )


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Difference of heights from the surface of these heights and of slopes.

    Attributes
    ----------
    chi2 : float
        Mean over cells of the square of the mean difference over its variance, if errors of pixels are
        independent: below 1 unless heights and slopes contradict each other. NaN with too few cells.
    clear : bool
        Whether this mean is above 1 by more than chance.
    rms : float
        RMS difference, weighted as in the surface, mm; without contradiction, that of the means of cells.
    zenith_bias : ZenithBias, optional
        The error of the slopes, if they disagree and one is significant.
    certain : bool
        Whether a clear one is a fault: usual errors of a turn may explain it.
    """

    chi2: float = math.nan
    clear: bool = False
    rms: float = math.nan
    zenith_bias: ZenithBias | None = None
    certain: bool = True


def find_disagreement(
    surface: NDArray[np.floating],
    height: Doubles,
    weight: Doubles,
    slopes: Slopes,
    pixel_size: tuple[float, float],
) -> Disagreement:
    """Compare a surface, (H, W), with the heights and weights from which it was computed with slopes."""
    both = slopes.defined & (weight > 0) & np.isfinite(surface)
    firm = np.where(both, weight, 0.0)
    error = np.where(both, height - surface, 0.0)
    pixels, total, first = (_cells(values) for values in (both, firm, firm * error))
    enough = (pixels >= _IN_CELL) & (total > 0)
    count = int(np.count_nonzero(enough))
    if count < _MIN_CELLS:
        return Disagreement()
    chi2 = float(np.mean(first[enough] ** 2 / total[enough]))
    clear = chi2 > 1 + _CLEAR_Z_SCORE * math.sqrt(2 / count)
    mean = first[enough] / total[enough]
    square = np.sum(firm * error**2) / np.sum(firm) if clear else np.average(mean**2, weights=total[enough])
    chance = 0.0 if clear else count / float(np.sum(total[enough]))
    rms = math.sqrt(max(float(square) - chance, 0.0))
    return Disagreement(
        chi2, clear, rms, find_zenith_bias(slopes, height, firm, pixel_size) if clear else None
    )


def describe_disagreement(
    disagreement: Disagreement, error: ZenithBias, scatter: float
) -> dict[str, ProcessValue]:
    """Return what a result's process says of a disagreement, and of the error that was removed before.

    ``scatter`` is the factor by which the errors of slopes exceed those stated.
    """
    process: dict[str, ProcessValue] = {}
    findings = []
    if error != ZenithBias():
        process |= {"slope_gain_error": error.gain, "slope_offset_error": error.offset}
        findings.append(
            Finding(
                "slope error",
                f"heights show that the normals' zeniths are wrong by {100 * error.gain:+.2g} % plus"
                f" {math.degrees(error.offset):+.2g} degrees: this is corrected in the surface, not in the"
                " normals. Calibrate the zenith's gain and offset",
            )
        )
    if disagreement.clear:
        process["disagreement"] = disagreement.rms
        findings.append(
            Finding(
                "disagreement",
                f"heights and normals disagree by {1000 * disagreement.rms:.2g} µm, which height_sigma"
                " includes: do both show the same surface, is the zenith's response calibrated, and is the"
                " light steady?",
                disagreement.certain,
            )
        )
    if scatter > 1:
        text = (
            f"neighbouring slopes contradict each other as if their errors were {scatter:.2g} times those"
            " stated, which height_sigma includes"
        )
        findings.append(Finding("slope scatter", text, False))
    return process | in_process(findings, {})


def find_zenith_bias(
    slopes: Slopes, height: Doubles, weight: Doubles, pixel_size: tuple[float, float]
) -> ZenithBias | None:
    """Return the error of the zenith that heights and their weights show; None if it is not significant.

    Slopes are summed along parts of rows and columns. To first order, an error of the zenith theta by
    g theta + o changes the slope t = tan(theta) by (1 + t^2) (g theta + o). Both are fitted to the heights,
    with a free height of each part; their covariance is from the scatter of the parts, within which errors
    are correlated.
    """
    maps = [slopes.dz_dx, slopes.dz_dy, slopes.defined, height, weight]
    parts = _parts(maps, 0, pixel_size[0]), _parts([values.T for values in maps], 1, -pixel_size[1])
    matrices, rights = (np.concatenate(values) for values in zip(*parts, strict=True))
    if len(matrices) < _MIN_PARTS:
        return None
    matrix, right = matrices.sum(axis=0), rights.sum(axis=0)
    if np.linalg.cond(matrix) > 1e12:
        return None
    error = np.linalg.solve(matrix, right)
    scatter = rights - matrices @ error
    inverse = np.linalg.inv(matrix)
    covariance = inverse @ (scatter.T @ scatter) @ inverse
    chi2 = float(error @ np.linalg.solve(covariance, error))
    gain, offset = (float(value) for value in error)
    if not chi2 > _MIN_CHI2 or abs(gain) > _MAX_GAIN or abs(offset) > _MAX_OFFSET:
        return None
    return ZenithBias(gain, offset)


def _parts(maps: Sequence[NDArray[Any]], along: int, size: float) -> tuple[Doubles, Doubles]:
    """Return the normal equations of n parts of rows: of errors that raise the slopes, less a common height.

    These are matrices, (n, 2, 2), and right-hand sides, (n, 2). Slopes along rows are the first or the second
    of the maps; ``size`` is the distance of pixels along rows, mm, with the sign of the slope.
    """
    rows = maps[0].shape[0]
    step = max(_MIN_LINE_DISTANCE, -(-rows // _MAX_LINES))
    dz_dx, dz_dy, defined, height, weight = (
        np.pad(values[step // 2 :: step], ((0, 0), (0, _MAX_PART))).ravel().astype(np.float64)
        for values in maps
    )
    ends = np.flatnonzero(np.diff(defined, prepend=0, append=0)).reshape(-1, 2)
    count = -(-np.diff(ends)[:, 0] // _MAX_PART)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    start = np.repeat(ends[:, 0], count) + _MAX_PART * place
    length = np.minimum(np.repeat(ends[:, 1], count) - start, _MAX_PART)
    inside = np.arange(_MAX_PART) < length[:, np.newaxis]
    at = start[:, np.newaxis] + np.arange(_MAX_PART)
    used = np.where(inside, weight[at], 0.0)
    enough = (length >= _MIN_PART) & (np.count_nonzero(used, axis=1) >= _WITH_HEIGHT)
    used, inside, at = used[enough], inside[enough], at[enough]

    dz_dx, dz_dy = (np.where(inside, values[at], 0.0) for values in (dz_dx, dz_dy))
    steepness = np.hypot(dz_dx, dz_dy)
    rise = 1 + steepness**2
    with np.errstate(divide="ignore", invalid="ignore"):
        by_gain = np.where(steepness > 0, rise * np.arctan(steepness) / steepness, 0.0)
        by_offset = np.where(steepness > _MIN_SLOPE, rise / steepness, 0.0)
    slope = (dz_dx, dz_dy)[along] * size
    values = np.stack([by_gain * slope, by_offset * slope, slope])
    sums = np.zeros(values.shape)
    np.cumsum((values[..., 1:] + values[..., :-1]) / 2, axis=-1, out=sums[..., 1:])
    # Slopes that contain the error rise by too much: heights less sums are minus its sums.
    sums[2] -= np.where(used > 0, height[at], 0.0)
    sums -= (np.sum(sums * used, axis=-1) / used.sum(axis=-1))[..., np.newaxis]
    normal = np.einsum("ank,bnk->nab", sums[:2] * used, sums)
    return normal[..., :2], normal[..., 2]


def _cells(values: NDArray[Any]) -> Doubles:
    """Return the sums over square cells; the last rows and columns that fill none are left out."""
    rows, columns = (size // _CELL for size in values.shape)
    whole = values[: rows * _CELL, : columns * _CELL].astype(np.float64)
    return np.asarray(whole.reshape(rows, _CELL, columns, _CELL).sum(axis=(1, 3)))
