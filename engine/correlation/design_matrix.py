"""The fit E = mean + cosine cos alpha + sine sin alpha to samples of a rotation: its matrix, and turns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError
from mirrorskin.io.model.positions import check_phase, step_in_degrees
from mirrorskin.kernels.array_types import Doubles

LONGEST = 64
"""Largest number of frames of one turn."""

_MAX_CONDITION = 1e8  # of the Gram matrix
_PHASE_TOLERANCE = 1e-9  # radians: tolerance of equal phases
_DIGITS = 9  # decimals of phases, radians, in the comparison of turns
_FULL_TURN = 2 * np.pi - 1e-6  # radians, with a tolerance for rounding


def basis(phase: ArrayLike) -> Doubles:
    """Return the fitted functions 1, cos alpha and sin alpha as columns: (N, 3) float64."""
    alpha = np.asarray(phase, np.float64)
    return np.stack([np.ones_like(alpha), np.cos(alpha), np.sin(alpha)], axis=1)


def check_weights(frame_weights: ArrayLike | None, count: int) -> Doubles:
    """Return the weights of ``count`` frames, float64; 1 each by default."""
    if frame_weights is None:
        return np.ones(count)
    values = np.asarray(frame_weights)
    if values.dtype.kind not in "biuf" or values.shape != (count,):
        raise InputError(
            f"frame weights of type {values.dtype} and shape {values.shape} for {count} frames: one number a"
            " frame is needed"
        )
    wrong = ~(np.isfinite(values) & (values >= 0))
    if np.any(wrong):
        frame = int(np.argmax(wrong))
        raise InputError(f"weight {values[frame]} at frame {frame}: a finite number from 0 on is needed")
    return values.astype(np.float64)


def check_phases(phase: ArrayLike, frame_weights: ArrayLike | None = None) -> Doubles:
    """Return phases as float64, (N,), or raise InputError if they do not determine mean, cosine and sine.

    InputError: phases, radians, or weights that are not finite, weights below 0, fewer than three different
    phases, or phases so close together that the condition of the Gram matrix exceeds 1e8.
    """
    alpha = check_phase(phase, int(np.size(phase)), "phase")
    weight = check_weights(frame_weights, len(alpha))
    used = alpha[weight > 0]
    if len(alpha) > 0 and len(used) == 0:
        raise InputError(
            f"all {len(alpha)} frames have weight 0: at least 3 with a weight above 0 are needed"
        )
    different = max(1, int(np.count_nonzero(_gaps(used) > _PHASE_TOLERANCE))) if len(used) else 0
    if different < 3:
        frames = "1 frame" if len(used) == 1 else f"{len(used)} frames"
        phases = "1 phase" if different == 1 else f"{different} different phases"
        problem = f"{frames} at {phases} do not determine a fit"
        raise InputError(f"{problem} of mean, cosine and sine: at least 3 are needed")
    weighted = basis(used) * np.sqrt(weight[weight > 0] / weight.max())[:, np.newaxis]
    condition = float(np.linalg.cond(weighted)) ** 2
    if not condition <= _MAX_CONDITION:
        limit = f"condition {condition:.0e}, at most {_MAX_CONDITION:.0e}"
        problem = f"the phases are too close together to separate mean, cosine and sine ({limit})"
        raise InputError(f"{problem}: spread them over more of the turn")
    return alpha


def check_turning(phase: Doubles, name: str = "phase") -> None:
    """Raise InputError if phases, radians, step by more than a turn, so that no turn has two frames."""
    step = step_in_degrees(phase)
    if step:
        raise InputError(
            f"{name} is in radians; yours steps by {step:.4g} rad, more than a turn: convert degrees with"
            " numpy.radians, or leave whole turns out"
        )


def fit_matrix(phase: ArrayLike, frame_weights: ArrayLike | None = None) -> Doubles:
    """Return the matrix, (3, N), from samples to mean, cosine and sine: the weighted pseudo-inverse.

    It minimises sum_k w_k (E_k - a - b cos alpha_k - c sin alpha_k)^2. With N evenly spaced phases and equal
    weights, its rows are 1/N, (2/N) cos alpha and (2/N) sin alpha: the time average of the paper, and the
    correlations of its equations 17 and 20, as sums over a whole turn.

    Examples
    --------
    >>> import numpy as np
    >>> phase = np.arange(4) * np.pi / 2
    >>> (fit_matrix(phase) @ (10 + 3 * np.cos(phase))).round(6).tolist()
    [10.0, 3.0, 0.0]
    """
    alpha = check_phases(phase, frame_weights)
    root = np.sqrt(check_weights(frame_weights, len(alpha)))
    return np.asarray(np.linalg.pinv(basis(alpha) * root[:, np.newaxis]) * root)


@dataclass(frozen=True, slots=True, eq=False)
class TurnFit:
    """The fit to a turn of N frames. Fits are compared by identity."""

    phase: Doubles  # (N,), radians from 0 to 2 pi
    weights: Doubles  # (N,), above 0
    matrix: Doubles  # (3, N): see `fit_matrix`
    table: NDArray[np.float32]  # (6, N): cosines, sines, roots of the weights, and the matrix
    covariance: Doubles  # (3, 3), of mean, cosine and sine, if samples of weight 1 have variance 1
    weighted: bool  # whether a weight differs from 1
    goes_round: bool  # see `goes_round`


def turn_fit(phase: Doubles, weights: Doubles) -> TurnFit | None:
    """Return the fit to a turn, or None if its phases do not determine one; weights are above 0.

    Turns with the same phases, modulo 2 pi, share one fit.
    """
    return _turn_fit(np.round(np.mod(phase, 2 * np.pi), _DIGITS).tobytes(), weights.tobytes())


@lru_cache(256)
def _turn_fit(phases: bytes, weighing: bytes) -> TurnFit | None:
    phase, weights = np.frombuffer(phases), np.frombuffer(weighing)
    try:
        matrix = fit_matrix(phase, weights)
    except InputError:
        return None
    return TurnFit(
        phase,
        weights,
        matrix,
        np.stack([np.cos(phase), np.sin(phase), np.sqrt(weights), *matrix]).astype(np.float32),
        matrix @ (matrix / weights).T,
        bool(np.any(weights != 1)),
        goes_round(phase),
    )


def split_into_turns(phase: Doubles) -> list[slice]:
    """Return the frames of each turn, in order; the last turn may be incomplete.

    A turn ends before the first frame that is a whole turn away from its first frame. Phases that jump back
    by more than half a turn are assumed to be modulo a turn.
    """
    if len(phase) == 0:
        return []
    steps = np.diff(phase)
    forward = 1.0 if (np.median(steps) if len(steps) else 0.0) >= 0 else -1.0
    steps = np.where(forward * steps < -np.pi, steps + forward * 2 * np.pi, steps)
    angles = np.concatenate([[0.0], np.cumsum(steps)])
    starts = [0]
    for frame, angle in enumerate(angles):
        if abs(angle - angles[starts[-1]]) >= _FULL_TURN:
            starts.append(frame)
    return [slice(start, stop) for start, stop in zip(starts, [*starts[1:], len(angles)], strict=True)]


def longest_turn(phase: Doubles) -> int:
    """Return the number of frames of the longest turn."""
    return max((turn.stop - turn.start for turn in split_into_turns(phase)), default=0)


def goes_round(phase: Doubles) -> bool:
    """Return whether all gaps between phases are at most half a turn."""
    return bool(np.max(_gaps(phase)) <= np.pi + 1e-6)


def _gaps(phase: Doubles) -> Doubles:
    """Return the angles between neighbouring phases on the circle."""
    points = np.sort(np.mod(phase, 2 * np.pi))
    return np.diff(points, append=points[0] + 2 * np.pi)
