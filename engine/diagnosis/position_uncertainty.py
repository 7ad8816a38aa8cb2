"""Errors of the frames' positions, estimated from the smoothness of the surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, stored_map
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.io import Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma
from mirrorskin.kernels.numerics.samples import Grid, take_grids

if TYPE_CHECKING:
    from mirrorskin.engine.press.crossing import PressOperation

_BEND = np.array([-1.0, 3.0, -3.0, 1.0])  # third difference of four pixels in a row
_RISE = np.array([-1.0, -1.0, 1.0, 1.0]) / 4  # mean difference of neighbours
_LEAST_RISE = 0.2  # steps from pixel to pixel of a slope that shows positions
_FARTHER = (1.5, 2.2)  # steps over the rise to the next pixel: above each, rows of pixels are longer
_MAX_REACH = 3  # pixels: their greatest distance, with which jitter is not estimated
_FIRST_ROWS, _MAX_ROWS = 2000, 4000  # rows of four pixels along each axis, to begin with and in all
_SUSPICIOUS_Z_SCORE = 2.5  # standard errors: least difference of a frame from its neighbours
_MIN_STEP = 0.3  # steps: least distance of two frames whose errors are estimated
_MIN_FRAMES, _MAX_FRAMES = 7, 160  # frames that show positions
_MIN_ROWS_PER_FRAME = 40  # times that a frame is next to a pixel
_PRIOR = 0.3  # steps: standard deviation of a position, so that none is undetermined
_SMOOTH = 4  # frames per degree of the polynomial that the surface itself may have
_ITERATIONS = 3  # of the reweighted fit
_LEAST_BEND = 0.05  # least standard deviation of a bend, relative to the rise
_OVERLAP = 6  # rows of four pixels that share a pixel, along both axes
_BINS, _MIN_FILLED_BINS = 8, 3.0  # parts of an interval, and how many of them heights must fill
_MIN_JITTER, _JITTER_Z_SCORE = 0.07, 3.0  # steps, and standard errors, of a jitter that is one
_MIN_JITTER_FRAMES = 7  # frames from which a jitter is estimated
_JUMP, _JUMP_Z_SCORE = (0.6, 1.5), 5.0  # steps, and standard errors, of one lost frame
_MAX_OTHER_JUMP = 0.7  # greatest jump elsewhere, relative to it


class PositionUncertainty(Step):
    """Compare the travel of the frames with the surface, and report contradictions.

    If a frame was exposed at another travel than stated, all heights near it are shifted, wherever in the
    picture they are. A surface does not bend at just these heights, so that the error of each frame can be
    estimated: the errors e minimise the bends of rows of four pixels, relative to their rise, so that no
    scale is preferred. A slow change with height may belong to the surface itself and is ignored.

    Random errors are added to the standard deviation of heights; one missing step is a lost frame.
    """

    needs = ("height", "height_sigma")

    def apply(self, result: Result, context: Context) -> Result:
        """Return a result with larger standard deviations, or a warning, where positions do not fit."""
        operation = cast("PressOperation", context.operation)
        travel = context.positions("travel")
        errors = _fit_positions(stored_map(result, "height"), travel)
        if errors is None:
            return result
        jump = errors.lost_frame()
        if jump is not None:
            later = context.first_frame + int(np.argmin(np.abs(travel - errors.travel[jump + 1])))
            text = (
                f"the surface bends everywhere at the height of frame {later}, as if the body had moved by"
                " two steps before it: was a frame lost? Give the travel of each frame"
            )
            return with_findings(result, Finding("travel jump", text))
        jitter = errors.jitter()
        stated = operation.travel_sigma or 0.0
        if jitter <= stated:
            return result
        text = f"positions jitter by about {1000 * jitter:.2g} µm, which is in the standard deviations"
        added = math.sqrt(jitter**2 - stated**2)
        return with_findings(with_travel_error(result, added), Finding("jitter", text, False))


@dataclass(frozen=True)
class _PositionFit:
    """Estimated errors of frames at some travel, (n,), mm, and where they are meaningful.

    ``clear``, (n - 1,), is True for the intervals between frames over which heights are spread: many heights
    at one distance from the frames, as of a plate, contain no information. ``jumps`` are the errors of all
    later frames if they are the same, with their standard errors; ``reach`` is the distance of the pixels in
    a row.
    """

    travel: Doubles
    step: float
    error: Doubles
    covariance: Callable[[], Doubles]
    clear: NDArray[np.bool_]
    jumps: Doubles
    jump_errors: Doubles
    reach: int

    def jitter(self) -> float:
        """Return the standard deviation of random errors, mm; 0 if there are none."""
        if self.reach == _MAX_REACH:
            return 0.0
        clear = self.clear[:-2] & self.clear[1:-1] & self.clear[2:]
        clear[[0, -1]] = False
        if np.count_nonzero(clear) < _MIN_JITTER_FRAMES:
            return 0.0
        differences = np.diff(np.eye(len(self.error)), 3, axis=0)[clear] / math.sqrt(20)
        jitter = mad_sigma(differences @ self.error)
        if jitter < _MIN_JITTER * self.step:
            return 0.0
        variance = np.einsum("ij,jk,ik->i", differences, self.covariance(), differences)
        error = math.sqrt(float(np.median(variance)))
        if jitter < _JITTER_Z_SCORE * error:
            return 0.0
        return math.sqrt(jitter**2 - error**2)

    def lost_frame(self) -> int | None:
        """Return the number of the frame after which one is missing, if one clearly is."""
        unclear = np.convolve(~self.clear, np.ones(5), "same") > 0
        unclear[[0, 1, -2, -1]] = True
        jumps = np.where(unclear, np.nan, self.jumps) / self.step
        if np.isnan(jumps).all():
            return None
        largest = int(np.nanargmax(jumps))
        jump, error = jumps[largest], self.jump_errors[largest] / self.step
        jumps[max(0, largest - 2) : largest + 3] = 0
        alone = np.nanmax(np.abs(jumps)) < _MAX_OTHER_JUMP * jump
        return largest if _JUMP[0] < jump < _JUMP[1] and jump > _JUMP_Z_SCORE * error and alone else None


@dataclass(frozen=True)
class _Rows:
    """Rows of four pixels: their bend relative to their rise, and how errors of frames change it.

    bend = bends[i] + sum of change[j, i] * error[frame[j, i]] over the 8 frames next to the pixels.
    """

    bends: Doubles
    frame: NDArray[np.intp]
    change: Doubles

    @property
    def bend(self) -> float:
        """Standard deviation of a bend."""
        return max(mad_sigma(self.bends), _LEAST_BEND)

    def seen(self, count: int) -> NDArray[np.intp]:
        """Return how often each of some frames is next to a pixel."""
        return np.bincount(self.frame.ravel(), minlength=count)

    def suspicious(self, clear: NDArray[np.bool_]) -> bool:
        """Return whether the error of a single frame would make bends clearly less.

        Second differences from frame to frame of what each error would change, in standard errors.
        """
        weight = 1 / np.sqrt(1 + (self.bends / (2 * self.bend)) ** 2)
        gradient = (weight * self.bends * self.change).ravel()
        frame, count = self.frame.ravel(), len(clear) + 1
        total, square = (np.bincount(frame, part, minlength=count) for part in (gradient, gradient**2))
        usable = self.seen(count) >= _MIN_ROWS_PER_FRAME
        usable[[0, -1]] = False
        usable[1:-1] &= clear[:-1] & clear[1:]
        scores = np.where(usable, total / np.sqrt(np.maximum(square, np.finfo(float).tiny)), np.nan)
        changes = np.diff(scores, 2)
        return bool(np.any(np.abs(changes) > math.sqrt(6) * _SUSPICIOUS_Z_SCORE))

    def between(self, first: int, stop: int) -> _Rows:
        """Return the rows that lie between two frames, which are then numbered from the first."""
        inside = ((self.frame >= first) & (self.frame < stop)).all(axis=0)
        if inside.all():
            return _Rows(self.bends, self.frame - first, self.change)
        frame, change = (values.compress(inside, axis=1) for values in (self.frame, self.change))
        return _Rows(self.bends[inside], frame - first, change)


def _fit_positions(height: AnyArray, pushed: Doubles) -> _PositionFit | None:
    """Return the errors of the frames' positions; None if the heights do not show any."""
    travel = np.unique(pushed)
    if len(travel) < _MIN_FRAMES:
        return None
    step = float(np.median(np.diff(travel)))
    travel = _apart(travel, _MIN_STEP * step)
    if len(travel) < _MIN_FRAMES:
        return None
    pixels, reach = _pixels_of(height, 1, _FIRST_ROWS), 1
    clear = _spread(pixels[0][np.isfinite(pixels[0])], travel)
    rise = np.abs(pixels[1] - pixels[0])
    rise = rise[rise > _LEAST_RISE / 2 * step]
    if np.count_nonzero(clear) < _MIN_FRAMES - 2 or rise.size < _MIN_ROWS_PER_FRAME:
        return None
    reach = 1 + int(np.searchsorted(_FARTHER, step / float(np.median(rise))))
    if reach > 1:
        pixels = _pixels_of(height, reach, _FIRST_ROWS)
    rows = _rows_of(pixels, travel, step)
    if not rows.suspicious(clear):
        return None
    more = _pixels_of(height, reach, _MAX_ROWS)
    if more.shape != pixels.shape:
        rows = _rows_of(more, travel, step)
    clear = _spread(more[0][np.isfinite(more[0])], travel)
    covered = np.flatnonzero(rows.seen(len(travel)) >= _MIN_ROWS_PER_FRAME)
    if len(covered) < _MIN_FRAMES:
        return None
    first, stop = int(covered[0]), int(covered[-1]) + 1
    if stop - first > _MAX_FRAMES:
        middle = int(np.median(rows.frame))
        first = min(max(first, middle - _MAX_FRAMES // 2), stop - _MAX_FRAMES)
        stop = first + _MAX_FRAMES
    return _fit(rows.between(first, stop), travel[first:stop], step, clear[first : stop - 1], reach)


def _apart(travel: Doubles, distance: float) -> Doubles:
    """Return travel, in ascending order, without values closer to the one before than a distance."""
    if np.diff(travel).min() >= distance:
        return travel
    kept = [0]
    for number in range(1, len(travel)):
        if travel[number] - travel[kept[-1]] >= distance:
            kept.append(number)
    return travel[kept]


def _pixels_of(height: AnyArray, reach: int, max_rows: int) -> Doubles:
    """Return depths of rows of four pixels, ``reach`` apart, from rows and columns all over, (4, n)."""
    grids, (rows, columns) = [], height.shape
    for lines, length, down, across in ((rows, columns, columns, 1), (columns, rows, 1, columns)):
        count = length - 3 * reach
        if count > 0:
            thinner = max(1, lines * count // max_rows)
            skip = math.isqrt(thinner)
            each = -(-thinner // skip)
            first = each // 2 % lines
            steps = reach * across, each * down, skip * across
            shape = 4, -(-(lines - first) // each), -(-count // skip)
            grids.append(Grid(height, first * down, steps, shape))
    if not grids:
        return np.empty((4, 0))
    return -np.concatenate([part.reshape(4, -1) for part in take_grids(*grids)], axis=1).astype(np.float64)


def _rows_of(pixels: Doubles, travel: Doubles, step: float) -> _Rows:
    """Return the rows of four pixels that are on a slope."""
    each = np.diff(pixels, axis=0)
    rises = (each > 0).all(axis=0) | (each < 0).all(axis=0)
    rises &= np.abs(pixels[3] - pixels[0] + pixels[2] - pixels[1]) > 4 * _LEAST_RISE * step
    pixels = pixels.compress(rises, axis=1)
    rise = np.sum(_RISE[:, np.newaxis] * pixels, axis=0)
    bends = np.sum(_BEND[:, np.newaxis] * pixels, axis=0) / rise
    frame = np.clip(np.searchsorted(travel, pixels, side="right") - 1, 0, len(travel) - 2)
    fraction = (pixels - travel[frame]) / (travel[frame + 1] - travel[frame])
    change = (_BEND[:, np.newaxis] - bends * _RISE[:, np.newaxis]) / rise
    return _Rows(
        bends,
        np.concatenate([frame, frame + 1]),
        np.concatenate([change * (1 - fraction), change * fraction]),
    )


def _spread(heights: Doubles, travel: Doubles) -> NDArray[np.bool_]:
    """Return for each interval between frames whether the heights in it differ enough."""
    interval = np.clip(np.searchsorted(travel, heights, side="right") - 1, 0, len(travel) - 2)
    fraction = (heights - travel[interval]) / (travel[interval + 1] - travel[interval])
    part = np.clip((fraction * _BINS).astype(np.intp), 0, _BINS - 1)
    count = np.bincount(interval * _BINS + part, minlength=(len(travel) - 1) * _BINS)
    count = count.reshape(-1, _BINS).astype(np.float64)
    total = count.sum(axis=1)
    return np.asarray((total > 0) & (total**2 >= _MIN_FILLED_BINS * np.sum(count**2, axis=1)))


def _fit(rows: _Rows, travel: Doubles, step: float, clear: NDArray[np.bool_], reach: int) -> _PositionFit:
    """Fit the errors of all frames, and those of a single jump between any two of them."""
    count, (first, second) = len(travel), np.triu_indices(len(rows.frame))
    pairs = (count * rows.frame[first] + rows.frame[second]).ravel()
    products = rows.change[first] * rows.change[second]
    products[first == second] /= 2  # the other half of the matrix is the transposed one
    weighted = np.empty_like(products)  # used again, because new memory costs as much as the products

    def normal(weight: Doubles) -> Doubles:
        """Return the sum of weighted products of changes, (n, n)."""
        np.multiply(weight, products, out=weighted)
        half = np.bincount(pairs, weighted.ravel(), minlength=count**2).reshape(count, count)
        return np.asarray(half + half.T)

    degree = max(2, count // _SMOOTH)
    smooth, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, count), degree))
    of_surface = np.sum(smooth[:, np.newaxis] * smooth[np.newaxis], axis=2)
    bend, error, residual = rows.bend, np.zeros(count), rows.bends
    for _ in range(_ITERATIONS):
        weight = 1 / np.sqrt(1 + (residual / (2 * bend)) ** 2)
        squares = normal(weight)
        slope = (weight * rows.bends * rows.change).ravel()
        gradient = -np.bincount(rows.frame.ravel(), slope, minlength=count)
        whole = squares + np.eye(count) * (bend / (_PRIOR * step)) ** 2
        whole += 10 * np.trace(whole) * of_surface
        inverse = np.linalg.inv(whole)
        error = np.sum(inverse * gradient, axis=1)
        residual = rows.bends + np.sum(rows.change * error[rows.frame], axis=0)

    def covariance() -> Doubles:
        return _OVERLAP * inverse @ normal((weight * residual) ** 2) @ inverse

    after = np.tri(count, count - 1, -1)  # a jump between two frames shifts all that follow
    inner = np.linalg.pinv(smooth.T @ squares @ smooth)
    mixed = smooth.T @ squares @ after
    weights = np.sum(after * (squares @ after), axis=0) - np.sum(mixed * (inner @ mixed), axis=0)
    weights = np.maximum(weights, 1e-9 * np.trace(squares))
    jumps = (after.T @ gradient - mixed.T @ inner @ (smooth.T @ gradient)) / weights
    return _PositionFit(
        travel, step, error, covariance, clear, jumps, bend * np.sqrt(_OVERLAP / weights), reach
    )


def with_travel_error(result: Result, sigma: float) -> Result:
    """Return a result whose heights also have errors of the travel of each frame, mm.

    The variance of a height between two frames, at the share w, is (w^2 + (1 - w)^2) sigma^2: on average
    2/3 sigma^2.
    """
    error = np.float32(math.sqrt(2 / 3) * sigma)
    names = [name for name in ("height_sigma", "hysteresis_sigma") if name in result]
    more = {name: error * (math.sqrt(2) if name != "height_sigma" else 1) for name in names}
    return result.assign({name: np.hypot(result[name], np.float32(more[name])) for name in names})
