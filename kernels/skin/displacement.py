"""Displacement of a texture: ``displacement.cl`` in plain NumPy with float64.

Between its samples a frame is the cubic spline through them (Unser, Aldroubi and Eden, IEEE Trans. Signal
Processing 41, 1993). Its coefficients are a filter of the frame, truncated to 17 samples along each axis; the
truncation error is less than 3e-5 of a sample.

A reference has four planes: its counts, NaN where they are not measurements; their derivatives along columns
and rows; and their difference from the local mean. They are padded by ``halo`` pixels of zeros (of NaN in the
first), so that a window may extend beyond the picture.

In a window, the frame is modelled as the reference, displaced by an affine field, times a gain and plus a
plane of brightness. This has ten parameters: displacement to the right and down at the window's centre, four
derivatives of these, brightness and its two slopes, gain. `basis` returns the columns of the design matrix.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

POLE = np.sqrt(3.0) - 2
TAPS = 8
"""Number of samples on either side that contribute to a coefficient."""
MARGIN = TAPS + 4
"""Coefficients outside of a frame, of its mirror image."""
PARAMETERS, AFFINE = 10, 6
"""Number of parameters of a window, and of those that describe its motion."""
PACKED = PARAMETERS * (PARAMETERS + 1) // 2
"""Elements of a symmetric matrix of the parameters: those of its lower triangle, by rows."""
MAX_CHANGE = 1.5
"""Maximum change of the field in one iteration, pixels."""
BENT = 0.1
"""Derivatives of the displacement, pixels per half window, up to which a window is displaced as a whole."""
MAX_SLOPE = 3.0
"""Maximum derivative of the displacement of a window, pixels per half window."""
MOST = 1e5
"""Maximum norm of the inverse of a normal matrix whose diagonal is scaled to 1."""

_ROOT = (4 + 2 * np.cos(_ANGLES := np.linspace(0, 2 * np.pi, 256, endpoint=False))) / 6
CORRELATION = tuple(float(np.mean(np.cos(k * _ANGLES) / _ROOT**2)) for k in range(4))
"""Covariance of coefficients 0 to 3 samples apart, for samples with noise of variance 1."""


def displacement_spline(
    top: int, bottom: int, left: int, right: int, frame: Array, coefficients: Array
) -> None:
    """Write the coefficients of a frame's spline in a part of a map with a margin on each side.

    The frame is mirrored at its ends. ``top`` to ``bottom`` and ``left`` to ``right`` are rows and columns of
    the coefficients, (rows + 2 MARGIN, columns + 2 MARGIN).
    """
    filtered = np.pad(frame.astype(np.float64), MARGIN + TAPS, mode="reflect")
    for axis in (0, 1):
        size = filtered.shape[axis] - 2 * TAPS
        near = [filtered.take(range(k, k + size), axis) for k in range(2 * TAPS + 1)]
        filtered = np.sqrt(3.0) * sum(POLE ** abs(k - TAPS) * part for k, part in enumerate(near))
    coefficients[top:bottom, left:right] = filtered[top:bottom, left:right]


def displacement_across(window: int, frame: Array, sums: Array, counts: Array) -> None:
    """Write the sum and the number of the valid samples of a row around each pixel; ends are mirrored.

    Valid samples are finite, and below the maximum of an integer type.
    """
    samples, defined = _known(frame)
    for values, summed in ((np.where(defined, samples, 0.0), sums), (defined, counts)):
        summed[:] = np.sum(_around(values.astype(np.float64), window, axis=1), axis=-1)


def displacement_planes(
    halo: int,
    window: int,
    frame: Array,
    coefficients: Array,
    sums: Array,
    counts: Array,
    planes: Array,
    difference: Array,
) -> None:
    """Write the four planes of a reference, (4, H + 2 halo, W + 2 halo), and fill the differences with 0.

    ``coefficients`` are the coefficients of its spline; ``sums`` and ``counts`` are results of
    `displacement_across`.
    """
    samples, defined = _known(frame)
    c = coefficients[MARGIN - 1 : 1 - MARGIN, MARGIN - 1 : 1 - MARGIN].astype(np.float64)
    along_x, along_y = c[:, 2:] - c[:, :-2], c[2:] - c[:-2]
    along_x = (along_x[:-2] + 4 * along_x[1:-1] + along_x[2:]) / 12
    along_y = (along_y[:, :-2] + 4 * along_y[:, 1:-1] + along_y[:, 2:]) / 12
    total, number = (
        np.sum(_around(part.astype(np.float64), window, axis=0), axis=-1) for part in (sums, counts)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = [along_x, along_y, samples - total / number]
    rest = [np.pad(np.where(defined, part, 0.0), halo) for part in parts]
    planes[:] = np.stack([np.pad(np.where(defined, samples, np.nan), halo, constant_values=np.nan), *rest])
    difference[:] = 0


def _known(frame: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return samples, and which of them are measurements."""
    defined = frame < np.iinfo(frame.dtype).max if frame.dtype.kind == "u" else np.isfinite(frame)
    return frame.astype(np.float64), np.asarray(defined)


def _around(values: Array, window: int, axis: int) -> Array:
    """Return the samples of a window around each along an axis, (H, W, window), mirrored at the ends."""
    widths = [(window // 2, window - 1 - window // 2) if k == axis else (0, 0) for k in range(2)]
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, widths, mode="reflect"), window, axis=axis)


def cubic(part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights, (4, ...), of the coefficients at -1, 0, 1 and 2 for a position from 0 to 1."""
    rest = 1 - part
    near, far = (2 / 3 - 0.5 * x**2 * (2 - x) for x in (part, rest))
    return np.stack([rest**3 / 6, near, far, part**3 / 6])


def noise_gain(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the variance of a value interpolated along one axis, for samples with noise of variance 1."""
    lags = [CORRELATION[k] * np.sum(weights[: 4 - k] * weights[k:], axis=0) for k in range(4)]
    return np.asarray(lags[0] + 2 * (lags[1] + lags[2] + lags[3]))


def interpolate_nodes(field: Array, start: float, step: int, size: tuple[int, int]) -> NDArray[np.float64]:
    """Return a field of nodes, (n, rows, columns), at each pixel: bilinear, and constant beyond the nodes."""
    values = field.astype(np.float64)
    for axis, length in ((1, size[0]), (2, size[1])):
        last = values.shape[axis] - 1
        place = np.clip((np.arange(length) - start) / step, 0, last)
        before = np.minimum(place.astype(int), max(last - 1, 0))
        part = (place - before).reshape((-1, 1) if axis == 1 else (-1,))
        values = (1 - part) * values.take(before, axis) + part * values.take(
            np.minimum(before + 1, last), axis
        )
    return values


def keys(place: NDArray[np.float64], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the four nodes around each position and their weights: Keys' cubic, linear at the ends.

    Keys, IEEE Trans. Acoustics, Speech and Signal Processing 29, 1981.
    """
    before = np.clip(place.astype(int), 0, max(nodes - 2, 0))
    t = place - before
    bend = np.where((before > 0) & (before < nodes - 2), t * (1 - t) / 2, 0.0)
    weights = [-bend * (1 - t), 1 - t + bend * (2 - 3 * t), t + bend * (3 * t - 1), -bend * t]
    return np.clip(before + np.arange(-1, 3)[:, np.newaxis], 0, nodes - 1), np.stack(weights)


def displacement_pixels(step: int, start: float, logarithms: bool, nodes: Array, pixels: Array) -> None:
    """Write the values of nodes, (T, n, rows, columns), interpolated at pixels, (T, H, W, n).

    Interpolation is cubic, linear where nodes are missing, and otherwise NaN. With ``logarithms`` the nodes'
    values are logarithms of the output, which is then positive.
    """
    for values, written in zip(nodes, pixels, strict=True):
        fine = values.astype(np.float64)
        for axis, length in ((1, written.shape[0]), (2, written.shape[1])):
            place = np.clip((np.arange(length) - start) / step, 0, values.shape[axis] - 1)
            taps, weights = keys(place, values.shape[axis])
            shape = (-1, 1) if axis == 1 else (-1,)
            pairs = zip(taps, weights, strict=True)
            fine = np.sum([weight.reshape(shape) * fine.take(tap, axis) for tap, weight in pairs], axis=0)
        linear = interpolate_nodes(values, start, step, written.shape[:2])
        interpolated = np.where(np.isfinite(fine), fine, linear)
        written[:] = np.moveaxis(np.exp(interpolated) if logarithms else interpolated, 0, -1)


def displacement_warp(
    step: int, start: float, halo: int, coefficients: Array, planes: Array, field: Array, difference: Array
) -> None:
    """Write the difference between the reference and a frame interpolated at displaced positions.

    Parameters
    ----------
    step, start : distance between nodes, and position of the first node's centre on either axis, pixels
    halo : margin of the planes, pixels
    coefficients : spline coefficients of the frame, padded
    planes : (4, H + 2 halo, W + 2 halo), of the reference
    field : (2, rows, columns), displacement of the frame at the nodes to the right and down, pixels
    difference : (2, H + 2 halo, W + 2 halo). First, the reference minus the frame plus the derivatives times
        the field, which equals the derivatives times the displacement. Second, its variance for noise of
        variance 1. 0 where the reference has no measurement, NaN outside the frame
    """
    rows, columns = (length - 2 * halo for length in planes.shape[1:])
    right, down = interpolate_nodes(field, start, step, (rows, columns))
    x, y = np.arange(columns) + right, np.arange(rows)[:, None] + down
    value = _interpolated(coefficients, x, y, rows, columns)
    core = np.s_[halo : halo + rows, halo : halo + columns]
    counts, along_x, along_y = planes[:3, *core].astype(np.float64)
    measured = np.isfinite(counts)
    warped = counts - value + along_x * right + along_y * down
    x, y = (np.where(np.isfinite(value), place, 0.0) for place in (x, y))
    variance = 1 + noise_gain(cubic(x - np.floor(x))) * noise_gain(cubic(y - np.floor(y)))
    difference[0][core] = np.where(measured, warped, 0)
    difference[1][core] = np.where(measured, variance, 0)


def windows(maps: Array, row: int, step: int, first: int, window: int, nodes: int) -> NDArray[np.float64]:
    """Return the windows of a row of nodes, (n, nodes, window^2), of maps (n, H, W).

    ``first`` is the start of the window of the first node, on either axis.
    """
    strip = maps[:, first + row * step : first + row * step + window].astype(np.float64)
    strip = np.lib.stride_tricks.sliding_window_view(strip, window, axis=2)
    strip = strip[:, :, first : first + nodes * step : step][:, :, :nodes]
    return strip.transpose(0, 2, 1, 3).reshape(len(maps), nodes, -1)


def basis(planes: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Return the columns of the parameters, (nodes, window^2, 10), of windows (4, nodes, window^2).

    Distances from the centre are in halves of the window.
    """
    counts, along_x, along_y, texture = planes
    place = (2 * np.arange(window) - (window - 1)) / window
    y, x = (part.reshape(-1) for part in np.meshgrid(place, place, indexing="ij"))
    defined = np.isfinite(counts).astype(np.float64)
    columns = [along_x, along_y, along_x * x, along_x * y, along_y * x, along_y * y]
    return np.stack([*columns, defined, defined * x, defined * y, texture], axis=-1)


def pack(matrices: Array, packed: Array) -> None:
    """Write symmetric matrices of nodes, (rows, columns, 10, 10), as work-items of several nodes use them.

    ``packed``, (n, 55, nodes), has the lower triangles, by rows, of the nodes of a work-item, which are
    adjacent in a row. The last work-item of a row may have nodes beyond its end; they are unchanged.
    """
    nodes = packed.shape[-1]
    triangles = matrices[..., *np.tril_indices(PARAMETERS)]
    by_row = packed.reshape(len(matrices), -1, PACKED, nodes)
    for first in range(0, matrices.shape[1], nodes):
        part = triangles[:, first : first + nodes]
        by_row[:, first // nodes, :, : part.shape[1]] = np.swapaxes(part, 1, 2)


def unpack(packed: Array, rows: int, columns: int) -> NDArray[np.float64]:
    """Return the matrices, (rows, columns, 10, 10), that `pack` has packed."""
    by_row = packed.astype(np.float64).reshape(rows, -1, PACKED, packed.shape[-1])
    triangles = np.swapaxes(by_row, 2, 3).reshape(rows, -1, PACKED)[:, :columns]
    matrices = np.empty((rows, columns, PARAMETERS, PARAMETERS))
    row, column = np.tril_indices(PARAMETERS)
    matrices[..., row, column] = matrices[..., column, row] = triangles
    return matrices


def displacement_normals(
    step: int, first: int, window: int, planes: Array, inverse: Array, summary: Array
) -> None:
    """Write the inverse of each node's normal matrix.

    Parameters
    ----------
    step, first, window, planes : as of ``displacement_solve``
    inverse : packed, see `pack`; NaN where the matrix is singular within rounding: a column is 0 or not
        finite, or after scaling the diagonal to 1 the Frobenius norm of the inverse exceeds 1e5
    summary : (4, rows, columns), elements 00, 10 and 11 of the inverse, and number of samples in the window
    """
    node_rows, node_columns = summary.shape[1:]
    matrices = np.empty((node_rows, node_columns, PARAMETERS, PARAMETERS))
    for row in range(node_rows):
        columns = basis(windows(planes, row, step, first, window, node_columns), window)
        normal = columns.transpose(0, 2, 1) @ columns
        summary[3, row] = normal[:, AFFINE, AFFINE]
        scale = np.sqrt(np.einsum("nii->ni", normal))
        usable = ((scale > 0) & np.isfinite(scale)).all(axis=1)
        scale[~usable], normal[~usable] = 1, np.eye(PARAMETERS)
        normal /= scale[:, :, None] * scale[:, None, :]
        usable &= np.linalg.eigvalsh(normal)[:, 0] > 1e-9
        normal[~usable] = np.eye(PARAMETERS)
        inverted = np.linalg.inv(normal)
        usable &= np.sum(inverted**2, axis=(1, 2)) < MOST**2
        inverted /= scale[:, :, None] * scale[:, None, :]
        inverted[~usable] = np.nan
        matrices[row] = inverted
    pack(matrices, inverse)
    summary[:3] = np.moveaxis(matrices[..., [0, 1, 1], [0, 0, 1]], -1, 0)


def displacement_solve(
    step: int,
    first: int,
    window: int,
    planes: Array,
    difference: Array,
    field: Array,
    inverse: Array,
    answer: Array,
) -> None:
    """Write the displacement of each node: least squares in its window.

    Parameters
    ----------
    step, first, window : distance between nodes, start of the first window, side of a window; pixels
    planes, difference, field : as of ``displacement_warp``
    inverse : as of ``displacement_normals``
    answer : (9, nodes): displacement to the right and down, pixels; derivatives of the first and of the
        second to the right and down, per half window; gain; residual sum of squares; and sum of the variances
        of the differences for noise of variance 1
    """
    node_rows, node_columns = field.shape[1:]
    matrices = unpack(inverse, node_rows, node_columns)
    for row in range(node_rows):
        here = np.s_[row * node_columns : (row + 1) * node_columns]
        columns = basis(windows(planes, row, step, first, window, node_columns), window)
        residual, variance = windows(difference, row, step, first, window, node_columns)
        centre = field[:, row].astype(np.float64)
        residual = residual - columns[..., 0] * centre[0][:, None] - columns[..., 1] * centre[1][:, None]
        sums = np.einsum("npk,np->kn", columns, residual)
        solution = np.einsum("nkl,ln->kn", matrices[row], sums)
        answer[:AFFINE, here] = solution[:AFFINE]
        answer[:2, here] += centre
        answer[AFFINE, here] = 1 - solution[-1]
        answer[AFFINE + 1, here] = np.sum(residual**2, axis=1) - np.sum(solution * sums, axis=0)
        answer[AFFINE + 2, here] = np.sum(variance, axis=1)


def displacement_follow(
    step: int,
    first: int,
    window: int,
    halo: int,
    top: int,
    bottom: int,
    left: int,
    right: int,
    iterations: int,
    settled: float,
    coefficients: Array,
    planes: Array,
    inverse: Array,
    summary: Array,
    field: Array,
    answer: Array,
) -> None:
    """Write the displacement of some nodes after several iterations, in which no other node has a part.

    A window is displaced by its own affine field. Derivatives up to ``BENT`` are left to the least squares:
    all pixels are displaced alike.

    Parameters
    ----------
    step, first, window, halo : distance between nodes, start of the first window, side of a window, and
        margin of the planes; pixels
    top, bottom, left, right : rows and columns of the nodes
    iterations, settled : maximum number of iterations; a node ends after one that moves it by less than
        ``settled`` pixels
    coefficients, planes, inverse, summary : as of ``displacement_warp`` and ``displacement_normals``
    field : (6, rows, columns), initial values of the displacement, and of its derivatives as in the answer
    answer : (9, rows, columns), displacement and derivatives as of ``displacement_solve``; gain; variance of
        a sample, from the squares; and the last change of the displacement, pixels. The displacement changes
        by at most ``MAX_CHANGE`` in an iteration, the derivatives are at most ``MAX_SLOPE``. NaN where the
        window leaves the frame
    """
    node_rows, node_columns = field.shape[1:]
    rows, columns = (length - 2 * halo for length in planes.shape[1:])
    matrices, start = unpack(inverse, node_rows, node_columns), first - halo + (window - 1) / 2
    place = np.arange(window) - (window - 1) / 2
    below, across = (part.reshape(-1) for part in np.meshgrid(place, place, indexing="ij"))
    for row, column in itertools.product(range(top, bottom), range(left, right)):
        here = windows(planes, row, step, first, window, node_columns)[:, column : column + 1]
        design = basis(here, window)[0]
        measured = np.isfinite(here[0, 0])
        moved = field[:, row, column].copy()
        for _ in range(iterations):
            if np.abs(moved[2:]).max() <= BENT:
                moved[2:] = 0
            x = (
                start
                + column * step
                + across
                + moved[0]
                + (moved[2] * across + moved[3] * below) * 2 / window
            )
            y = start + row * step + below + moved[1] + (moved[4] * across + moved[5] * below) * 2 / window
            differs = np.where(measured, here[0, 0] - _interpolated(coefficients, x, y, rows, columns), 0.0)
            sums = design.T @ differs
            solution = matrices[row, column] @ sums
            squares, change = np.sum(differs**2) - solution @ sums, np.abs(solution[:2]).max()
            if not np.isfinite(squares + change):
                moved[:2] = change = np.nan
                break
            moved[:2] += np.clip(solution[:2], -MAX_CHANGE, MAX_CHANGE)
            moved[2:] = np.clip(moved[2:] + solution[2:AFFINE], -MAX_SLOPE, MAX_SLOPE)
            if change < settled:
                break
        noise = math.prod(noise_gain(cubic(part - np.floor(part))) for part in moved[:2])
        gain, samples = 1 - solution[-1], summary[3, row, column]
        # The reference's noise is multiplied by the gain.
        variance = np.maximum(squares, 0) / ((noise + gain**2) * (samples - PARAMETERS))
        answer[:, row, column] = [*moved, gain, variance, change]


def _interpolated(
    coefficients: Array, x: NDArray[np.float64], y: NDArray[np.float64], rows: int, columns: int
) -> NDArray[np.float64]:
    """Return the spline of padded coefficients at positions of a frame; NaN outside."""
    inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    west, north = np.floor(x).astype(int), np.floor(y).astype(int)
    weights_x, weights_y = cubic(x - west), cubic(y - north)
    value = np.zeros(x.shape)
    for j in range(4):
        for i in range(4):
            warped = coefficients[north + j - 1 + MARGIN, west + i - 1 + MARGIN].astype(np.float64)
            value += weights_y[j] * weights_x[i] * warped
    return np.where(inside, value, np.nan)


def displacement_field(
    step: int, window: int, hold: float, trust: Array, answer: Array, field: Array, next_field: Array
) -> None:
    """Write the field of all windows, each weighted by how well its displacement is determined.

    Each window predicts the displacement of its neighbours, so that an affine field remains affine and
    continues where windows leave the picture. Far from all windows, the field is kept.

    Parameters
    ----------
    step, window : distance between nodes, side of a window; pixels
    hold : weight of the previous field
    trust : (rows, columns), weights of the windows; those without an answer have no weight
    answer, field : as of ``displacement_solve``
    next_field : (2, rows, columns), displacement to the right and down, pixels. It changes by at most
        ``MAX_CHANGE``, and derivatives of at most 1 per half window are used
    """
    rows, columns = trust.shape
    parts = answer[:AFFINE].reshape(AFFINE, rows, columns).astype(np.float64)
    weight = np.where(np.isfinite(parts[0]), trust, 0.0)
    parts = np.where(np.isfinite(parts[0]), parts, 0.0)
    y, x = np.meshgrid(*(2 * step / window * np.arange(n) for n in (rows, columns)), indexing="ij")
    total = _over_nodes(weight) + hold
    for n in range(2):
        coarse, (along_x, along_y) = field[n].astype(np.float64), np.clip(parts[2 + 2 * n : 4 + 2 * n], -1, 1)
        change = np.where(weight > 0, np.clip(parts[n] - coarse, -MAX_CHANGE, MAX_CHANGE), 0.0)
        here = _over_nodes(weight * (coarse + change - along_x * x - along_y * y)) + hold * coarse
        next_field[n] = (here + _over_nodes(weight * along_x) * x + _over_nodes(weight * along_y) * y) / total


def _over_nodes(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the binomial mean over 5 by 5 nodes; nodes that do not exist count as 0."""
    for axis in (0, 1):
        padded = np.pad(values, [(2, 2) if k == axis else (0, 0) for k in range(2)])
        around = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=axis)
        values = around @ (np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16)
    return values
