"""The fit to frames at given poses: the body's axis in each, and the resulting information about a normal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.correlation.design_matrix import LONGEST
from mirrorskin.engine.rotation.tilt import check_tilts
from mirrorskin.io import InputError
from mirrorskin.io.base.types import body_axes
from mirrorskin.io.model.positions import check_phase
from mirrorskin.kernels.array_types import Doubles

PRESSES = 0.02
"""Minimum range of travel of a body that also presses, as a share of the maximum travel."""

_AXES_TOLERANCE = 1e-4  # ratio of singular values of the axes below which all axes are the same
_PLANE = 1e-2  # ratio of singular values of the axes below which they are in a plane
_UPRIGHT = 0.05  # sine of the maximum angle between this plane and the vertical
_FRAMES_OF_SECOND = 9  # minimum number of frames for a fit of second order
_UNIT = 1e-6  # tolerance of the length of a unit vector


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """The fit to a window of N frames. Fits are compared by identity.

    ``direction`` is the direction of rocking, radians from x towards y; None if the axes determine a normal.
    """

    weights: Doubles  # (N,), above 0
    matrix: Doubles  # (3, N): from samples to mean, cosine and sine
    waves: Doubles  # (N, n): orthonormal basis of the samples of all normals, approximately
    table: NDArray[np.float32]  # (13, N): see mirrorskin.kernels.rotation.normals_pose
    tilt: float  # root mean square tilt of the frames, radians
    presses: bool  # whether travel differs between frames
    deep: NDArray[np.bool_]  # (N,): frames with at least the median travel
    direction: float | None


def check_poses(
    count: int,
    phase: ArrayLike | None = None,
    tilt: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    travel: ArrayLike | None = None,
) -> Doubles:
    """Return the axis and the travel of each frame, (count, 4), from its phase and tilt, or its axis.

    InputError if both an axis and a phase are given, or neither, or if the numbers are not poses.
    """
    if (axis is None) == (phase is None or tilt is None):
        raise InputError("poses are a phase and a tilt of each frame, or an axis: give one of both")
    if axis is None:
        assert phase is not None
        assert tilt is not None
        axes = body_axes(check_phase(phase, count, "phase"), check_tilts(tilt, count))
    else:
        axes = np.asarray(axis, np.float64)
        if axes.shape != (count, 3) or not np.allclose(np.linalg.norm(axes, axis=1), 1, atol=_UNIT):
            raise InputError(f"axis of shape {axes.shape} for {count} frames: a unit vector each is needed")
        check_tilts(np.arctan2(np.hypot(axes[:, 0], axes[:, 1]), axes[:, 2]), count)
    depth = np.zeros(count) if travel is None else np.asarray(travel, np.float64)
    if depth.shape not in ((), (count,)):
        raise InputError(f"travel has shape {depth.shape} for {count} frames: one number a frame is needed")
    depth = np.broadcast_to(depth, count)
    if not np.isfinite(depth).all():
        raise InputError("travel is not finite: every frame needs a number, mm")
    return np.column_stack([axes, depth])


def rocks(phase: ArrayLike | None) -> bool:
    """Return whether there are two phases, half a turn apart."""
    if phase is None:
        return False
    steps: Doubles = np.unique(np.round(np.mod(np.asarray(phase, np.float64), 2 * np.pi), 6))
    return len(steps) == 2 and bool(abs(steps[1] - steps[0] - np.pi) < 1e-5)


def even_windows(frames: int) -> int:
    """Return the length of windows, for the smallest number of windows of nearly equal length.

    Examples
    --------
    >>> even_windows(100)
    50
    """
    return -(-frames // -(-frames // LONGEST))


def pose_fit(pose: Doubles, weights: Doubles, rocked: float | None = None) -> PoseFit:
    """Return the fit to frames with poses (N, 4) and weights above 0.

    ``rocked`` is the direction of rocking of earlier frames, radians, which these have as well if theirs
    differs by rounding only, or by little.

    InputError for fewer than 3 frames, for identical axes, and for axes in a plane that is not upright.
    """
    axes, travel = pose[:, :3], pose[:, 3]
    if len(axes) < 3:
        raise InputError(f"{len(axes)} frames determine no slope: at least 3 are needed")
    _, swings, planes = np.linalg.svd(axes, full_matrices=False)
    if swings[1] <= _AXES_TOLERANCE * swings[0]:
        raise InputError(f"all {len(axes)} frames have the same tilt and phase: they determine no slope")
    direction = None
    if swings[2] <= _PLANE * swings[1]:
        if abs(planes[2, 2]) > _UPRIGHT:
            raise InputError(
                "the body's axes lie in a plane that is not upright: rock it through the vertical, or turn it"
            )
        direction = float(np.arctan2(planes[2, 0], -planes[2, 1]) % math.pi)
        if rocked is not None and abs((direction - rocked + math.pi / 2) % math.pi - math.pi / 2) < _PLANE:
            direction = rocked
        along = axes @ [math.cos(direction), math.sin(direction), 0.0]
        axes = np.column_stack([along, np.zeros(len(axes)), axes[:, 2]])
    across = np.hypot(axes[:, 0], axes[:, 1])
    tilts = np.arctan2(across, axes[:, 2])
    tilt = math.sqrt(float(np.mean(tilts**2)))
    leans = -axes[:, :2] / math.sin(tilt)
    root = np.sqrt(weights)
    design = np.column_stack([np.ones(len(axes)), leans])
    matrix = np.linalg.pinv(design * root[:, np.newaxis], rcond=_PLANE) * root
    with np.errstate(divide="ignore", invalid="ignore"):
        outwards = np.where(across[:, np.newaxis] > 0, axes[:, :2] / across[:, np.newaxis], 0.0)
    relative_tilt = tilts / tilt
    leaning = relative_tilt * np.stack([*(np.cos(tilts) * outwards.T), -np.sin(tilts)])
    return PoseFit(
        weights,
        matrix,
        _waves(leans, root),
        np.stack([*leans.T, root, *matrix, *axes.T, *leaning, travel]).astype(np.float32),
        tilt,
        bool(np.ptp(travel) > PRESSES * np.max(np.abs(travel))),
        travel >= np.median(travel),
        direction,
    )


def _waves(leans: Doubles, root: Doubles) -> Doubles:
    """Return an orthonormal basis of the samples of all normals, to second order in the tilt, (N, n)."""
    x, y = ((leans - leans.mean(axis=0)) / np.max(leans.std(axis=0))).T
    second = [x * x, x * y, y * y] if len(x) >= _FRAMES_OF_SECOND else []
    terms = np.column_stack([np.ones(len(x)), x, y, *second]) * root[:, np.newaxis]
    base, sizes, _ = np.linalg.svd(terms, full_matrices=False)
    return np.asarray(base[:, sizes > _PLANE * sizes[0]])
