"""What errors that all normals have in common do to heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.diagnosis.turn_nuisances import TERMS, mode_errors, picture_axes
from mirrorskin.kernels.array_types import Doubles

_SIDE = 32  # most points of the grid along a side
_BEYOND = 3.0  # standard deviations of its prior: largest amplitude of a mode
_LEFT = 0.3  # share of an error that may be left: modes are sums of a few functions
_SCREENING = 1e-9  # weight of known heights, so that each component has a solution


@dataclass(frozen=True, slots=True)
class CommonErrors:
    """Errors of heights by modes of normals, on a grid of every n-th pixel: such errors are smooth.

    Modes are those of `mirrorskin.engine.diagnosis.turn_nuisances`.
    """

    heights: Doubles  # (K, n): independent errors, mm
    used: NDArray[np.bool_]  # (rows, columns): the n points of the grid
    shape: tuple[int, int]  # of the picture
    mode: Doubles | None = None  # (2, terms): an error of normals that known heights show

    def variance(self) -> NDArray[np.float32]:
        """Return the variance of heights, (H, W) mm^2."""
        total = np.zeros(self.used.shape)
        total[self.used] = np.sum(self.heights**2, axis=0)
        spread, coverage = (
            cv2.resize(values.astype(np.float32), self.shape[::-1], interpolation=cv2.INTER_LINEAR)
            for values in (total, self.used)
        )
        most = np.full(self.shape, float(total.max(initial=0.0)), np.float32)
        known: NDArray[np.float32] = np.divide(spread, coverage, out=most, where=coverage > 1e-3)
        return known


def common_variance(
    normals: NDArray[np.float32],
    component: NDArray[np.int32],
    modes: Sequence[float],
    pixel_size: tuple[float, float],
) -> NDArray[np.float32]:
    """Return the variance of heights about the mean of their component, (H, W) mm^2, by modes of normals.

    Parameters
    ----------
    normals : ndarray, (H, W, 3)
    component : ndarray, (H, W), int32
        -1 without a height.
    modes : sequence of float
        Those of `Fitted.common_errors`: (M, 2, terms), flat.
    pixel_size : (float, float)
        Millimetres, along x and y.
    """
    grid = _Grid.of(component >= 0, pixel_size, normals=normals)
    labels = component[grid.cut][grid.used]
    heights = grid.heights(np.reshape(modes, (-1, 2, TERMS)), np.ones((2, *grid.used.shape)))
    counts = np.maximum(np.bincount(labels), 1)
    for height in heights:
        height -= (np.bincount(labels, height) / counts)[labels]
    return CommonErrors(heights, grid.used, component.shape).variance()


def find_common_errors(
    slopes: tuple[NDArray[np.floating], NDArray[np.floating]],
    inside: NDArray[np.bool_],
    modes: Sequence[float],
    pixel_size: tuple[float, float],
    weights: tuple[NDArray[np.floating], ...],
    excess: Doubles,
) -> CommonErrors:
    """Return what known heights show of the modes of normals, and what they do to the surface.

    The surface z fits slopes with the weights W and heights h with the weights w. A mode d of slopes changes
    it by y, and would change the heights of slopes alone by f. With the amplitudes a, whose variances are 1
    without heights, the sum of squares is least for ::

        A a = sum of w f (z - h),    A = 1 + sum of w f y^T

    and the covariance of a is the inverse of A. Whether slopes fit together shows nothing here: relief finer
    than a pixel changes that, too. An error that is beyond the priors has another cause: it is not returned.

    Parameters
    ----------
    slopes : (ndarray, ndarray), each (H, W)
        Along x, and along y; NaN where unknown.
    inside : ndarray, (H, W), bool
        Pixels of the surface.
    modes : sequence of float
        Those of `Fitted.common_errors`: (M, 2, terms), flat.
    pixel_size : (float, float)
        Millimetres, along x and y.
    weights : (ndarray, ndarray, ndarray), each (H, W)
        Inverse variances of slopes along x and along y, and of heights.
    excess : ndarray, (H, W)
        Surface less known height, mm; 0 without one.
    """
    grid = _Grid.of(inside, pixel_size, slopes=slopes)
    trust = np.stack([grid.mean(values) for values in weights])
    held = trust[2][grid.used]
    shapes = np.reshape(modes, (-1, 2, TERMS))
    free, moved = (grid.heights(shapes, known) for known in (trust[:2], trust))
    area = grid.step**2
    seen = np.eye(len(shapes)) + area * (free * held) @ moved.T
    pull = area * free @ grid.mean(weights[2] * excess)[grid.used]
    squares, directions = np.linalg.eigh((seen + seen.T) / 2)
    squares = np.maximum(squares, 1.0)
    amplitudes = directions @ (directions.T @ pull / squares)
    errors, effect = (directions / np.sqrt(squares)).T @ moved, amplitudes @ moved
    mode, left = None, 1.0
    if np.max(np.abs(amplitudes), initial=0.0) > _BEYOND:
        left = 0.0
    elif amplitudes @ pull > 1:  # more than one standard deviation
        mode, left = np.tensordot(amplitudes, shapes, 1), _LEFT
    return CommonErrors(np.vstack([errors, left * effect]), grid.used, inside.shape, mode)


@dataclass(frozen=True, slots=True)
class _Grid:
    """Every n-th pixel of a picture."""

    step: int
    cut: tuple[slice, slice]  # where the points are in a map
    used: NDArray[np.bool_]  # (rows, columns)
    normals: NDArray[np.float32]  # (n, 3), of the points that are used
    places: tuple[Doubles, Doubles]  # x and y of these points
    pixel_size: tuple[float, float]

    @classmethod
    def of(
        cls,
        inside: NDArray[np.bool_],
        pixel_size: tuple[float, float],
        *,
        normals: NDArray[np.float32] | None = None,
        slopes: tuple[NDArray[np.floating], ...] = (),
    ) -> Self:
        """Return the grid of a picture with normals or slopes; points without one are not used."""
        step = max(1, -(-max(inside.shape) // _SIDE))
        cut = slice((step - 1) // 2, None, step), slice((step - 1) // 2, None, step)
        found = normals_of_slopes(*(slope[cut] for slope in slopes)) if normals is None else normals[cut]
        used = inside[cut] & np.isfinite(found).all(axis=-1)
        x, y = picture_axes((inside.shape[0], inside.shape[1]))
        x, y = np.meshgrid(x[cut[1]], y[cut[0]])
        return cls(step, cut, used, found[used], (x[used], y[used]), pixel_size)

    def mean(self, values: NDArray[np.floating]) -> Doubles:
        """Return the means of a map over squares around the points, (rows, columns)."""
        starts = [np.arange(length) * self.step for length in self.used.shape]
        sums = np.add.reduceat(np.add.reduceat(values.astype(np.float64), starts[0]), starts[1], axis=1)
        sizes = [np.diff(start, append=length) for start, length in zip(starts, values.shape, strict=True)]
        return np.asarray(sums / np.multiply.outer(*sizes))

    def heights(self, modes: Doubles, trust: Doubles) -> Doubles:
        """Return the least-squares heights of modes at the points that are used, (M, n).

        ``trust``, (2 or 3, rows, columns), are the weights of slopes along x and y, and of a height of 0.
        """
        if not self.used.any():
            return np.zeros((len(modes), 0))
        slopes = np.zeros((2, len(modes), *self.used.shape))
        slopes[:, :, self.used] = mode_slopes(modes, self.normals, *self.places)
        used, spacing = self.used, (self.step * self.pixel_size[0], self.step * self.pixel_size[1])
        rows, columns = used.shape
        transposed = columns > rows
        if transposed:  # blocks are the shorter lines
            used, slopes, spacing = used.T, -slopes[::-1].transpose(0, 1, 3, 2), spacing[::-1]
            trust = np.stack([trust[1].T, trust[0].T, *(known.T for known in trust[2:])])
            rows, columns = columns, rows
        (p, q), (across, down) = slopes, spacing
        # From row to row, y decreases; weights make the sum that of squared errors of slopes.
        right, below = used[:, 1:] & used[:, :-1], used[1:] & used[:-1]
        rise = np.where(right, across * (p[:, :, 1:] + p[:, :, :-1]) / 2, 0.0)
        fall = np.where(below, -down * (q[:, 1:] + q[:, :-1]) / 2, 0.0)
        weights = (
            right * (trust[0][:, 1:] + trust[0][:, :-1]) / (2 * across**2),
            below * (trust[1][1:] + trust[1][:-1]) / (2 * down**2),
        )
        count = len(p)
        source = np.zeros((count, rows, columns))
        source[:, :, 1:] += weights[0] * rise
        source[:, :, :-1] -= weights[0] * rise
        source[:, 1:] += weights[1] * fall
        source[:, :-1] -= weights[1] * fall
        diagonal = np.zeros((rows, columns))
        diagonal[:, 1:] += weights[0]
        diagonal[:, :-1] += weights[0]
        diagonal[1:] += weights[1]
        diagonal[:-1] += weights[1]
        screening = _SCREENING * float(diagonal.max() or 1.0)
        diagonal += np.where(diagonal > 0, screening, 1.0) + np.where(used, trust[2:].sum(axis=0), 0.0)
        pivots, at = np.zeros((rows, columns, columns)), np.arange(columns)
        pivots[:, at, at] = diagonal
        pivots[:, at[1:], at[:-1]] = pivots[:, at[:-1], at[1:]] = -weights[0]
        rests = np.ascontiguousarray(np.moveaxis(source, 0, 2))  # (rows, columns, M)
        solved = []
        for row, following in pairwise([*range(rows), rows]):
            link = np.zeros((columns, columns))
            if following < rows:
                link[at, at] = -weights[1][row]
            solved.append(np.linalg.solve(pivots[row], np.concatenate([link, rests[row]], axis=1)))
            if following < rows:
                reduced = -weights[1][row][:, np.newaxis] * solved[-1]
                pivots[following] -= reduced[:, :columns]
                rests[following] -= reduced[:, columns:]
        heights = np.empty((rows, columns, count))
        heights[-1] = solved[-1][:, columns:]
        for row in range(rows - 2, -1, -1):
            heights[row] = solved[row][:, columns:] - solved[row][:, :columns] @ heights[row + 1]
        result = np.moveaxis(heights, 2, 0)
        return (result.transpose(0, 2, 1) if transposed else result)[:, self.used]


def normals_of_slopes(dz_dx: NDArray[np.floating], dz_dy: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the unit normals, (..., 3), of slopes along x and y."""
    upwards = np.stack([-dz_dx, -dz_dy, np.ones_like(dz_dx)], axis=-1)
    return np.asarray(upwards / np.linalg.norm(upwards, axis=-1, keepdims=True), np.float32)


def mode_slopes(modes: Doubles, normals: NDArray[np.floating], x: Doubles, y: Doubles) -> Doubles:
    """Return the errors of slopes along x and y, (2, M, n), that modes make at normals, (n, 3)."""
    errors = mode_errors(modes, normals, x, y)
    nx, ny, nz = normals.astype(np.float64).T
    flat = np.maximum(np.hypot(nx, ny), 1e-12)
    cosine, sine = nx / flat, ny / flat
    along, across = errors[:, 0] / nz**2, errors[:, 1] / nz
    return -np.stack([along * cosine - across * sine, along * sine + across * cosine])
