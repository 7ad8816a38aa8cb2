"""Normal equations of a rigid motion between two maps: ``pose.cl`` in NumPy with float64.

A map is an array of records, (H, W, 8): the normal's x and y, the mean square angular error of the normal
(radians^2, `VAGUE` or more if it is not to be compared), height (mm) and its variance (mm^2, `FAR` if it is
not to be compared), and the second derivatives of the height xx, xy and yy (1/mm). The first number of an
unusable pixel is NaN.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]

BLOCK = 8
"""Pixels on each side of a block, whose sums are written together."""
PARTS = (0, 21, 27, 28, 29, 30, 31, 67)
"""Offsets in the sums of a block: upper triangle of J'WJ; J'Wr; chi^2; its expectation; compared heights;
compared normals; and J'WK, with K the Jacobian by the first map's own normals and curvature, which is
optional.
"""
FAR = 1e30
NEAR = 1e20
"""Variance above which a height is not compared: even the smallest interpolated share of FAR exceeds it."""
VAGUE = 100.0
"""Radians^2 above which a normal is not compared."""
POSE = 26
"""Numbers of a pose of `pose_equations`."""
NO_LIMIT = 1e30
"""Limit of a pixel's chi square above which none is left out."""
FEWEST = 20
"""Smallest number of pixels that two maps must share."""
TURN_AT, SHIFT_AT, PIXELS_AT, COVARIANCE_AT = 2, 11, 14, 16
"""Offsets in the answer of `pose_follow`."""
FOUND = COVARIANCE_AT + PARTS[1]
"""Numbers in that answer."""
INDEPENDENT = 100
"""Weight, in blocks, of the covariance of independent errors."""
LEAST = 1e-6
"""Share of the mean information that is added to all directions of a step, for rounding errors."""
MAX_STEP = 0.35
"""Longest step, relative to the object's size."""
_STRIDE = 4  # pixel step of coarse steps
_MAX_COARSE, _MAX_FINE = 8, 4  # largest number of steps
_CLOSE, _EXACT = 3.0, 0.1  # errors that coarse and fine steps may leave, sigmas
_CLEAR = 3.0  # sigmas of a step from which the next one shows its error
_MIN_KEPT = 0.5  # share of the pixels that are not outliers
_LOST = 3.0  # chi square, in units of the typical one, above which the maps do not match
_OUTLIER = 30.0  # chi square of a pixel that is left out, in units of the typical one


class Shape(NamedTuple):
    """Normals and the quantities for their derivatives: rows (n,), of unit vectors and second derivatives."""

    x: Doubles
    y: Doubles
    z: Doubles
    xx: Doubles
    xy: Doubles
    yy: Doubles


def pose_equations(first: Array, second: Array, poses: Array, sums: Array) -> None:
    """Write sums over each block of `BLOCK` x `BLOCK` pixels of the first map at some poses.

    Parameters
    ----------
    first, second : (H, W, 8)
        Records; the two maps may be of different sizes.
    poses : (count, 26)
        Rotation matrix (9); translation (3); centre of further rotations (3); x and y of the first pixel and
        pixel size along x and y of the first map (4), and of the second (4); squared sines of the tilts with
        which the normals of both maps were measured (2), or 1 for normals with isotropic errors; limit of the
        chi square of a pixel, above which it is left out.
    sums : (count, blocks, PARTS[-1] or PARTS[-2])
        See `PARTS`.
    """
    for pose, out in zip(poses, sums, strict=True):
        _equations_at(1, first, second, pose, out)


def pose_follow(
    expected_x: Array,
    expected_y: Array,
    expected_z: Array,
    expected_bend: float,
    key: Array,
    first: Array,
    second: Array,
    found: Array,
) -> None:
    """Write the motion from one map to another near an expected motion.

    Gauss-Newton steps use every `_STRIDE`-th row and column until the error that they leave, which is
    proportional to their square, is below `_CLOSE` sigmas; then all pixels without outliers. If more than
    half of the pixels are outliers, or chi square is too large, coarse steps continue.

    Parameters
    ----------
    expected_x, expected_y, expected_z : (4,)
        A row of the rotation matrix of the expected motion, and the translation along this axis.
    expected_bend : float
        Error that a coarse step leaves over the square of the step, both in sigmas; `NO_LIMIT` if unknown.
    key : (51,)
        Numbers 12 to 24 of a pose of `pose_equations`; the object's size; typical chi square; projection onto
        the directions in which the motion is followed (36), in units of the size.
    first, second : (H, W, 8)
        Records.
    found : (FOUND,)
        Number of blocks with shared pixels, 0 if no motion is found; error over the square of a step as
        ``expected_bend``; rotation matrix; translation; number of pixels; chi square per degree of freedom;
        and the upper triangle of the covariance in the directions of the projection, of rotations in units of
        1 / size. It is N S N or n N: N is the inverse of J'WJ, S the sum over blocks of the products of their
        J'Wr, and n their size relative to J'WJ. The mean of both is weighted by the number of blocks and
        `INDEPENDENT`. Chi square and S are those after the last step, for residuals that are linear in it.
    """
    found[0] = 0
    size, typical, projection = key[13], key[14], key[15:].reshape(6, 6)
    scale = np.repeat([1 / size, 1.0], 3)
    expected = np.array([expected_x, expected_y, expected_z])
    motion, bend = np.concatenate([expected[:, :3].ravel(), expected[:, 3]]), expected_bend
    last = shared = 0.0
    rough, coarse, fine = motion, 0, -1
    while coarse < _MAX_COARSE or fine >= 0:
        stride = _STRIDE if fine < 0 else 1
        pose = np.concatenate([motion, key[:13], [NO_LIMIT if fine < 0 else _OUTLIER * typical]])
        blocks = math.prod(-(-side // (BLOCK * stride)) for side in first.shape[:2])
        sums = np.zeros((blocks, PARTS[-2]))
        _equations_at(stride, first, second, pose, sums)
        total = sums.sum(axis=0)
        pixels, chi_square = total[29:31].max(), total[27] / max(total[28], 1e-9)
        if fine < 0 and pixels < FEWEST:
            return
        if fine >= 0 and (pixels < max(_MIN_KEPT * shared, FEWEST) or chi_square > _LOST * typical):
            fine, motion = -1, rough
            continue
        step, moved = _step(total, chi_square, projection, scale)
        motion = _moved(motion, step * scale, key[:3])
        if fine >= 0:
            fine += 1
            if min(moved, bend / _STRIDE * moved**2) < _EXACT or fine == _MAX_FINE:
                break
            continue
        if last > _CLEAR:
            bend = moved / last**2
        last, coarse = moved, coarse + 1
        if min(moved, bend * moved**2) < _CLOSE:
            fine, shared, rough = 0, pixels * _STRIDE**2, motion
    if fine < 0:
        return
    sums[:, 21:27] += _matrix(sums) @ (step * scale)
    right = sums[:, 21:27].sum(axis=0)
    chi_square = (total[27] + (total[21:27] + right) @ (step * scale)) / max(total[28], 1e-9)
    used = int(np.count_nonzero(sums[:, 29] + sums[:, 30]))
    covariance = _covariance(_matrix(total), sums[:, 21:27], used, projection, scale)
    found[:] = [used, bend, *motion, total[29:31].max(), chi_square, *covariance[np.triu_indices(6)]]


def _covariance(normal: Doubles, scores: Doubles, used: int, projection: Doubles, scale: Doubles) -> Doubles:
    """Return the covariance of a motion, (6, 6), in units of the object's size, in some directions."""
    sizes, directions = np.linalg.eigh(projection)
    directions = directions[:, sizes > 0.5]
    independent = directions.T @ (normal * np.outer(scale, scale)) @ directions
    scores = scores * scale @ directions
    scatter = scores.T @ scores * (used / max(used - 6, 1))
    inverse, share = np.linalg.inv(independent), used / (used + INDEPENDENT)
    size = np.trace(inverse @ scatter) / len(inverse)
    within = share * inverse @ scatter @ inverse + (1 - share) * size * inverse
    return np.asarray(directions @ within @ directions.T, np.float64)


def _matrix(sums: Array) -> Doubles:
    """Return J'WJ, (..., 6, 6), from sums."""
    matrix = np.zeros((*sums.shape[:-1], 6, 6))
    row, column = np.triu_indices(6)
    matrix[..., row, column] = matrix[..., column, row] = sums[..., :21]
    return matrix


def _step(total: Doubles, chi_square: float, projection: Doubles, scale: Doubles) -> tuple[Doubles, float]:
    """Return a Gauss-Newton step in units of the object's size, and its length in sigmas."""
    full = _matrix(total) * np.outer(scale, scale)
    matrix = projection @ full @ projection
    matrix += LEAST * np.trace(matrix) / np.trace(projection) * projection
    matrix += np.trace(full) / 6 * (np.eye(6) - projection)
    step = np.asarray(np.linalg.solve(matrix, -projection @ (total[21:27] * scale)), np.float64)
    step = step / max(float(np.linalg.norm(step)) / (MAX_STEP / scale[0]), 1.0)
    return step, math.sqrt(step @ full @ step / max(chi_square, 1.0))


def _moved(motion: Doubles, step: Doubles, centre: Doubles) -> Doubles:
    """Return a motion, (12,), followed by a rotation about a point, by Cayley's formula, and a shift."""
    x, y, z = step[:3] / 2
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    small = np.linalg.solve(np.eye(3) - cross, np.eye(3) + cross)
    shift = small @ (motion[9:] - centre) + centre + step[3:]
    return np.concatenate([(small @ motion[:9].reshape(3, 3)).ravel(), shift])


def _equations_at(step: int, first: Array, second: Array, pose: Array, sums: Array) -> None:
    row, column = (index.ravel() for index in np.indices(first.shape[:2]))
    across = -(-first.shape[1] // (BLOCK * step))
    block = row // (BLOCK * step) * across + column // (BLOCK * step)
    mine = first.reshape(-1, 8).astype(np.float64)
    turn, shift, centre = pose[:9].reshape(3, 3), pose[9:12], pose[12:15]
    taken = (row % step == 0) & (column % step == 0) & np.isfinite(mine[:, 0])
    row, column, block, mine = row[taken], column[taken], block[taken], mine[taken]
    x0, y0, step_x, step_y = pose[15:19]
    place = np.stack([x0 + column * step_x, y0 - row * step_y, mine[:, 3]]) if len(mine) else np.zeros((3, 0))
    place = turn @ place + shift[:, None]
    theirs, weight_square, inside = _interpolate(second.astype(np.float64), place, pose[19:23])
    block, mine, place = block[inside], mine[inside], place[:, inside]
    arm = place - centre[:, None]

    n = _upright(theirs[0], theirs[1])
    shape = Shape(*n, *theirs[5:8])
    turned = turn @ _upright(mine[:, 0], mine[:, 1])
    shape_here = Shape(*turned, *_turn_curvature(turn, mine[:, 0], mine[:, 1], mine[:, 5:8].T))
    variance = _variances(mine[:, 0], mine[:, 1], turn, mine[:, 2], pose[23])
    other = _variances(theirs[0], theirs[1], np.eye(3), theirs[2], pose[24])
    xx, xy, yy = variance + other
    is_clear = xx + yy < VAGUE
    lower = 1 / np.sqrt(xx), xy / np.sqrt(xx), 1 / np.sqrt(yy - xy * xy / xx)
    part = (1 - weight_square) * _trace(other, xx, xy, yy)
    lift = turn[:, 2] @ n / n[2]
    own_height = lift**2 * mine[:, 4]
    sure = 1 / np.sqrt(own_height + theirs[4])
    compared = (mine[:, 4] < NEAR) & (theirs[4] < NEAR)
    sure = np.where(compared, sure, 0)
    residual = np.stack([*_whiten(turned[0] - n[0], turned[1] - n[1], lower), sure * (place[2] - theirs[3])])
    residual[:2] *= is_clear
    kept = np.sum(residual**2, axis=0) <= pose[25]
    is_clear, compared = is_clear & kept, compared & kept
    lower, sure = (is_clear * lower[0], lower[1], is_clear * lower[2]), sure * kept
    residual *= kept
    jacobian, other_jacobian = (_jacobian(surface, arm, lower, sure) for surface in (shape, shape_here))
    expected = is_clear * (2 - part) + sure**2 * (own_height + weight_square * theirs[4])

    upper = np.triu_indices(6)
    whole = np.concatenate(
        [
            np.einsum("kin,kjn->ijn", jacobian, jacobian)[upper],
            np.einsum("kin,kn->in", jacobian, residual),
            [np.sum(residual**2, axis=0), expected, compared, is_clear],
            np.einsum("kin,kjn->ijn", jacobian, other_jacobian).reshape(36, -1),
        ]
    )
    sums[...] = np.stack([np.bincount(block, terms, len(sums)) for terms in whole[: sums.shape[1]]], axis=-1)


def _upright(x: Doubles, y: Doubles) -> Doubles:
    return np.stack([x, y, np.sqrt(1 - x * x - y * y)])


def _interpolate(second: Doubles, place: Doubles, grid: Array) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Return the records at positions, (8, n), the sums of squared weights, and where four pixels exist.

    All numbers are interpolated linearly. To the height, each pixel adds half of the rise computed from its
    normal, which makes the interpolation exact for paraboloids.
    """
    rows, columns = second.shape[:2]
    x0, y0, step_x, step_y = grid
    right, down = (place[0] - x0) / step_x, (y0 - place[1]) / step_y
    inside = (right >= 0) & (right < columns - 1) & (down >= 0) & (down < rows - 1)
    right, down = right[inside], down[inside]
    west, north = right.astype(np.intp), down.astype(np.intp)
    interpolated, weight_square, bent = np.zeros((8, len(west))), np.zeros(len(west)), np.zeros(len(west))
    for below in (0, 1):
        for right_of in (0, 1):
            from_x, from_y = right - west - right_of, down - north - below
            weight = (1 - np.abs(from_x)) * (1 - np.abs(from_y))
            record = second[north + below, west + right_of].T
            interpolated += weight * record
            bent += weight / 2 * (record[0] * from_x * step_x - record[1] * from_y * step_y)
            weight_square += weight**2
    interpolated[3] -= bent / np.sqrt(1 - interpolated[0] ** 2 - interpolated[1] ** 2)
    defined = np.isfinite(interpolated[0])
    inside[inside] = defined
    return interpolated[:, defined], weight_square[defined], inside


def _variances(x: Doubles, y: Doubles, turn: Array, square: Doubles, flat_limit: float) -> Doubles:
    """Return the covariance xx, xy, yy of a normal's x and y after a rotation.

    The share ``flat_limit`` / (2 sin^2 zenith) of the variance of an angular error is along the meridian.
    """
    flat = x * x + y * y
    fraction = flat_limit / 2 / np.maximum(flat, flat_limit)
    across, more = (1 - fraction) * square, (2 * fraction - 1) * square / np.maximum(flat, flat_limit)
    n = _upright(x, y)
    turned, along = turn @ n, turn @ np.stack([x * n[2], y * n[2], -flat])
    return np.stack(
        [
            across * ((i == j) - turned[i] * turned[j]) + more * along[i] * along[j]
            for i, j in ((0, 0), (0, 1), (1, 1))
        ]
    )


def _trace(other: Doubles, xx: Doubles, xy: Doubles, yy: Doubles) -> Doubles:
    """Return the trace of the inverse of one covariance times another."""
    traced: Doubles = (yy * other[0] - 2 * xy * other[1] + xx * other[2]) / (xx * yy - xy * xy)
    return traced


def _turn_curvature(turn: Array, x: Doubles, y: Doubles, curvature: Doubles) -> Doubles:
    """Return the second derivatives of a surface's height after a rotation.

    The surface is F = z - h(x, y) = 0, with gradient G and second derivatives M. The second derivatives of
    the rotated height are -(M_ab + M_az h_b + M_bz h_a + M_zz h_a h_b) / G_z with h_a = -G_a / G_z.
    """
    gradient = turn @ _upright(x, y)
    xx, xy, yy = curvature
    u, v = turn[:, 0], turn[:, 1]

    def second(i: int, j: int) -> Doubles:
        form: Doubles = -(xx * u[i] * u[j] + xy * (u[i] * v[j] + v[i] * u[j]) + yy * v[i] * v[j])
        return form

    p, q = -gradient[:2] / gradient[2]
    scale = np.sqrt(1 - x * x - y * y) / gradient[2]
    xz, yz, zz = second(0, 2), second(1, 2), second(2, 2)
    turned_xx = second(0, 0) + 2 * xz * p + zz * p * p
    turned_xy = second(0, 1) + xz * q + yz * p + zz * p * q
    turned_yy = second(1, 1) + 2 * yz * q + zz * q * q
    return np.asarray(-scale * np.stack([turned_xx, turned_xy, turned_yy]))


def _whiten(x: Doubles, y: Doubles, lower: tuple[Doubles, ...]) -> tuple[Doubles, Doubles]:
    first = x * lower[0]
    return first, (y - lower[1] * first) * lower[2]


def _jacobian(shape: Shape, arm: Doubles, lower: tuple[Doubles, ...], sure: Doubles) -> Doubles:
    """Return the change, (3, 6, n), of the weighted residuals by a further rotation and translation."""
    x, y, z = arm
    zeros, ones = np.zeros_like(x), np.ones_like(x)
    move_x, move_y = (
        np.stack([zeros, z, -y, ones, zeros, zeros]),
        np.stack([-z, zeros, x, zeros, ones, zeros]),
    )
    move_z = np.stack([y, -x, zeros, zeros, zeros, ones])
    turn_x = np.stack([zeros, shape.z, -shape.y, zeros, zeros, zeros])
    turn_y = np.stack([-shape.z, zeros, shape.x, zeros, zeros, zeros])
    slope_x, slope_y = -shape.x / shape.z, -shape.y / shape.z
    change = shape.xx * move_x + shape.xy * move_y, shape.xy * move_x + shape.yy * move_y
    along = shape.x * change[0] + shape.y * change[1]
    normal = (
        turn_x + shape.z * (change[0] - shape.x * along),
        turn_y + shape.z * (change[1] - shape.y * along),
    )
    height = sure * (move_z - slope_x * move_x - slope_y * move_y)
    return np.stack([*_whiten(*normal, lower), height])
