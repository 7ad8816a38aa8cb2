"""What errors that all normals have in common do to heights."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.diagnosis.turn_nuisances import mode_errors, picture_axes
from mirrorskin.kernels.array_types import Doubles

_SIDE = 32  # most points of the grid along a side
_SCREENING = 1e-9  # weight of known heights, so that each component has a solution


def common_variance(
    normals: NDArray[np.float32],
    component: NDArray[np.int32],
    modes: Doubles,
    pixel_size: tuple[float, float],
) -> NDArray[np.float32]:
    """Return the variance of heights about the mean of their component, (H, W) mm^2, by modes of normals.

    Modes are those of `mirrorskin.engine.diagnosis.turn_nuisances`. The slopes of each
    mode are integrated on a grid of every n-th pixel: such errors are smooth.

    Parameters
    ----------
    normals : ndarray, (H, W, 3)
    component : ndarray, (H, W), int32
        -1 without a height.
    modes : ndarray, (M, 2, terms)
    pixel_size : (float, float)
        Millimetres, along x and y.
    """
    shape = component.shape
    step = max(1, -(-max(shape) // _SIDE))
    cut = slice((step - 1) // 2, None, step), slice((step - 1) // 2, None, step)
    labels, vectors = component[cut], normals[cut]
    used = (labels >= 0) & np.isfinite(vectors).all(axis=-1)
    if not used.any():
        return np.zeros(shape, np.float32)
    rows, columns = labels.shape
    x, y = picture_axes((shape[0], shape[1]))
    across, up = (axis[used] for axis in np.meshgrid(x[cut[1]], y[cut[0]]))
    slopes = np.zeros((2, len(modes), rows, columns))
    slopes[:, :, used] = _slopes(mode_errors(modes, vectors[used], across, up), vectors[used])
    heights = _integrate(slopes, used, (step * pixel_size[0], step * pixel_size[1]))
    part = labels[used]
    total = np.zeros(labels.shape)
    counts = np.maximum(np.bincount(part), 1)
    for height in heights:
        values = height[used]
        means = np.bincount(part, values) / counts
        total[used] += (values - means[part]) ** 2
    spread, coverage = (
        cv2.resize(values.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)
        for values in (total, used)
    )
    known: NDArray[np.float32] = np.divide(
        spread, coverage, out=np.full(shape, float(total[used].max()), np.float32), where=coverage > 1e-3
    )
    return known


def _slopes(errors: Doubles, normals: NDArray[np.floating]) -> Doubles:
    """Return the errors of slopes along x and y, (2, M, n), from those of normals."""
    x, y, z = normals.astype(np.float64).T
    flat = np.maximum(np.hypot(x, y), 1e-12)
    cosine, sine = x / flat, y / flat
    along, across = errors[:, 0] / z**2, errors[:, 1] / z
    return -np.stack([along * cosine - across * sine, along * sine + across * cosine])


def _integrate(slopes: Doubles, used: NDArray[np.bool_], spacing: tuple[float, float]) -> Doubles:
    """Return least-squares heights of slopes, (2, M, rows, columns), on the used points of a grid."""
    rows, columns = used.shape
    transposed = columns > rows
    if transposed:  # blocks are the shorter lines
        used, slopes, spacing = used.T, -slopes[::-1].transpose(0, 1, 3, 2), spacing[::-1]
        rows, columns = columns, rows
    (p, q), (across, down) = slopes, spacing
    # From row to row, y decreases; weights make the sum that of squared errors of slopes.
    right, below = used[:, 1:] & used[:, :-1], used[1:] & used[:-1]
    rise = np.where(right, across * (p[:, :, 1:] + p[:, :, :-1]) / 2, 0.0)
    fall = np.where(below, -down * (q[:, 1:] + q[:, :-1]) / 2, 0.0)
    weights = right / across**2, below / down**2
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
    diagonal += np.where(diagonal > 0, screening, 1.0)
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
    return result.transpose(0, 2, 1) if transposed else result
