"""Normal equations of a rigid motion from a turn to a single frame: ``turn_pose.cl`` in NumPy with float64.

A pixel of the turn has a normal n and a height. The motion moves it, and turns its normal to n'. The frame
shows there the zenith of n' relative to the body's axis a in that frame: cos t = n' . a (eq. 10). The
residual is the zenith of the frame less t. A motion along z changes no zenith: it is not determined.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.skin.pose import BLOCK, VAGUE

Array = NDArray[Any]

LIGHT = (31, 37, 38, 39, 75, 81)
"""Offsets in the sums of a block, after the first 31 of `mirrorskin.kernels.skin.pose.PARTS`: B'WJ; B'WB;
B'Wr; and J'WK and B'WK, which are optional. B is the change of the zenith with the light of the frame, and K
the Jacobian by the gradient of the frame.
"""
NUMBERS = 30
"""Length of a pose; see `turn_pose_equations`."""
CLEAR = 10.0
"""Smallest square of a zenith that is compared, in variances of the normal across its lean."""


def turn_pose_equations(
    step: int, base: float, turn: Array, zeniths: Array, pose: Array, sums: Array
) -> None:
    """Write sums over each block of the turn's pixels at a motion; every ``step``-th pixel counts.

    Parameters
    ----------
    step : int
        A block has `BLOCK` x `BLOCK` pixels that count.
    base : float
        Brightness at zenith 0 over the gain, radians: light that is stronger by a share s adds
        s (base + zenith).
    turn : (H, W, 8)
        Records of the turn's map; see `mirrorskin.kernels.skin.pose`. The variance of a zenith in a frame is
        derived from the mean square error of a normal from all frames of the turn.
    zeniths : (H, W)
        Of the frame, relative to the axis, radians; NaN where unknown.
    pose : (30,)
        Rotation matrix (9); translation (3); centre of further rotations (3); x and y of the first pixel and
        pixel size along x and y of the turn (4), and of the frame (4); squared sine of the turn's tilt; the
        axis (3); number of the turn's frames; limit of the chi square of a pixel, above which it is left
        out; 1, or 0 for a frame of the turn itself.
    sums : (blocks, LIGHT[-1] or LIGHT[3])
        See `LIGHT`.
    """
    row, column = (index.ravel() for index in np.indices(turn.shape[:2]))
    wide = -(-turn.shape[1] // (BLOCK * step))
    block = row // (BLOCK * step) * wide + column // (BLOCK * step)
    mine = turn.reshape(-1, 8).astype(np.float64)
    matrix, shift, centre = pose[:9].reshape(3, 3), pose[9:12], pose[12:15]
    flat_limit, axis, frames, limit, other_frame = pose[23], pose[24:27], *pose[27:30]
    taken = (row % step == 0) & (column % step == 0) & np.isfinite(mine[:, 0])
    row, column, block, mine = row[taken], column[taken], block[taken], mine[taken].T
    x0, y0, step_x, step_y = pose[15:19]
    place = matrix @ np.stack([x0 + column * step_x, y0 - row * step_y, mine[3]]) + shift[:, None]
    seen, gradient, weight_square, inside = _interpolate(zeniths.astype(np.float64), place, pose[19:23])
    block, mine, place = block[inside], mine[:, inside], place[:, inside]
    arm = place - centre[:, None]

    x, y, square, _, _, xx, xy, yy = mine
    n = np.stack([x, y, np.sqrt(1 - x * x - y * y)])
    normal, axis_here = matrix @ n, axis @ matrix  # the turned normal; the axis in the turn's coordinates
    cosine = axis_here @ n
    zenith = np.arccos(np.minimum(cosine, 1.0))

    # Variances: along the normal's lean, and across it, where a turn is less certain.
    flat = x * x + y * y
    outside = np.maximum(flat, flat_limit)
    fraction = flat_limit / (2 * outside)
    across = square * (1 - fraction)
    clear = np.minimum(np.sin(zenith) ** 2, flat) > CLEAR * across
    per_sine = 1 / np.sin(np.where(clear, zenith, 1.0))
    lean = per_sine * (n[2] * (axis_here[0] * x + axis_here[1] * y) - axis_here[2] * flat)
    of_turn = across + square * ((2 * fraction - 1) * lean**2 / outside)
    of_frame = weight_square * frames * fraction * square
    sure = 1 / np.sqrt(of_turn + of_frame)
    # An error e of the normal across its lean adds e² / (2 sin t): the turn's own normal allows for that of t
    # in its mean pose.
    bend = across / 2 * (per_sine - 1 / np.sqrt(np.where(clear, flat, 1.0)))
    residual = sure * (seen - zenith + bend)
    kept = clear & (square < VAGUE) & (residual**2 <= limit)
    sure, residual = np.where(kept, sure, 0), np.where(kept, residual, 0)

    # Change of the zenith along x and y of the turn, then of the frame.
    change_x, change_y = (_change(n, axis_here, per_sine, *bend) for bend in ((xx, xy), (xy, yy)))
    ((a, c), (b, d)) = (  # moves of the pixel's place along x and y of the frame
        [matrix[i, 0] - matrix[i, 2] * x / n[2] for i in (0, 1)],
        [matrix[i, 1] - matrix[i, 2] * y / n[2] for i in (0, 1)],
    )
    area = a * d - b * c
    turned = per_sine * np.cross(normal.T, axis).T

    # The error e also changes residual and Jacobian together: the mean of that is subtracted. It is 0 for a
    # frame of the turn, whose own error is in e.
    tangent = np.stack([-y, x, np.zeros_like(x)]) / np.sqrt(np.where(clear, flat, 1.0))
    axis_across = per_sine * (axis_here @ tangent)
    both = other_frame * across * per_sine * axis_across
    by_tangent = -n[2] * np.stack([tangent[0] * xx + tangent[1] * xy, tangent[0] * xy + tangent[1] * yy])
    both_x, both_y = both * cosine * (by_tangent + axis_across * np.stack([change_x, change_y]))
    both_turned = both * (np.cross((matrix @ tangent).T, axis).T + axis_across * cosine * turned)

    def rows_of(turned: Doubles, by_x: Doubles, by_y: Doubles) -> Doubles:
        lever = np.stack([-by_y * arm[2], by_x * arm[2], by_y * arm[0] - by_x * arm[1]])
        return np.concatenate([turned + lever, [by_x, by_y, np.zeros_like(by_x)]])

    def of_frame_axes(along_x: Doubles, along_y: Doubles) -> tuple[Doubles, Doubles]:
        return (d * along_x - c * along_y) / area, (a * along_y - b * along_x) / area

    light = sure * (base + zenith)
    jacobian = sure * rows_of(turned, *of_frame_axes(change_x, change_y))
    other = sure * rows_of(turned, *gradient)
    common = sure**2 * rows_of(both_turned, *of_frame_axes(both_x, both_y))
    upper = np.triu_indices(6)
    whole = np.concatenate(
        [
            (jacobian[:, None] * jacobian)[upper],
            jacobian * residual - common,
            [residual**2, kept, np.zeros_like(sure), kept],
            light * jacobian,
            [light**2, light * residual],
            (jacobian[:, None] * other).reshape(36, -1),
            light * other,
        ]
    )
    sums[...] = np.stack([np.bincount(block, terms, len(sums)) for terms in whole[: sums.shape[1]]], axis=-1)


def _change(n: Doubles, axis_here: Doubles, per_sine: Doubles, bend_x: Doubles, bend_y: Doubles) -> Doubles:
    """Return the change of the zenith where the slopes change by ``bend_x`` and ``bend_y`` per mm."""
    along = n[0] * bend_x + n[1] * bend_y
    moved = np.stack([along * n[0] - bend_x, along * n[1] - bend_y, along * n[2]])
    return np.asarray(-per_sine * n[2] * (axis_here @ moved))


def _interpolate(
    frame: Doubles, place: Doubles, grid: Array
) -> tuple[Doubles, Doubles, Doubles, NDArray[np.bool_]]:
    """Return zeniths, their gradients along x and y, (2, n), sums of squared weights, and where all exist.

    The interpolation is cubic (Keys 1981), between 4 x 4 pixels: a linear one errs where zeniths bend.
    """
    rows, columns = frame.shape
    x0, y0, step_x, step_y = grid
    right, down = (place[0] - x0) / step_x, (y0 - place[1]) / step_y
    inside = (right >= 1) & (right < columns - 2) & (down >= 1) & (down < rows - 2)
    west, north = right[inside].astype(np.intp), down[inside].astype(np.intp)
    across, across_change = _weights(right[inside] - west)
    along, along_change = _weights(down[inside] - north)
    near = np.stack([frame[north + row, west + np.arange(-1, 3)[:, None]] for row in range(-1, 3)])
    seen = np.einsum("jn,in,jin->n", along, across, near)
    gradient = np.stack(
        [
            np.einsum("jn,in,jin->n", along, across_change, near) / step_x,
            -np.einsum("jn,in,jin->n", along_change, across, near) / step_y,
        ]
    )
    weight_square = np.sum(along**2, axis=0) * np.sum(across**2, axis=0)
    known = np.isfinite(seen)
    inside[inside] = known
    return seen[known], gradient[:, known], weight_square[known], inside


def _weights(t: Doubles) -> tuple[Doubles, Doubles]:
    """Return the weights of four pixels in line, (4, n), and their derivatives."""
    weights = -t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2
    changes = -1 + 4 * t - 3 * t**2, -10 * t + 9 * t**2, 1 + 8 * t - 9 * t**2, 3 * t**2 - 2 * t
    return np.stack(weights) / 2, np.stack(changes) / 2
