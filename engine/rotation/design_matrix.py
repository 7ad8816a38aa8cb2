"""The fit E = mean + cosine cos alpha + sine sin alpha of a rotation's samples: its turns, and its matrix."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError
from mirrorskin.io.positions import check_phase

Doubles = NDArray[np.float64]

LONGEST = 64
"""Frames of one turn at most."""

_MAX_CONDITION = 1e8  # of the Gram matrix
_SAME = 1e-9  # radians within which two phases are one
_DIGITS = 9  # of a phase modulo a turn, by which turns of the same phases are known
_FULL_TURN = 2 * np.pi - 1e-6  # but for the rounding of phases


def basis(phase: ArrayLike) -> Doubles:
    """Return the functions that are fitted, 1, cos alpha and sin alpha, as columns: (N, 3) float64."""
    alpha = np.asarray(phase, np.float64)
    return np.stack([np.ones_like(alpha), np.cos(alpha), np.sin(alpha)], axis=1)


def check_weights(frame_weights: ArrayLike | None, count: int) -> Doubles:
    """Return the weights of ``count`` frames, float64; 1 each by default."""
    if frame_weights is None:
        return np.ones(count)
    values = np.asarray(frame_weights)
    if values.dtype.kind not in "biuf" or values.shape != (count,):
        given = f"frame weights of type {values.dtype} and shape {values.shape} for {count} frames"
        raise InputError(f"{given}: one number a frame is needed")
    wrong = ~(np.isfinite(values) & (values >= 0))
    if np.any(wrong):
        frame = int(np.argmax(wrong))
        raise InputError(f"weight {values[frame]} at frame {frame}: a finite number from 0 on is needed")
    return values.astype(np.float64)


def check_phases(phase: ArrayLike, frame_weights: ArrayLike | None = None) -> Doubles:
    """Return phases as float64, (N,), if they determine mean, cosine and sine of what they sample.

    InputError: phases, radians, or weights that are no finite numbers, weights below 0, fewer than three
    different phases, or phases so close together that the condition of the Gram matrix exceeds 1e8.
    """
    alpha = check_phase(phase, int(np.size(phase)), "phase")
    weight = check_weights(frame_weights, len(alpha))
    known = alpha[weight > 0]
    if len(alpha) > 0 and len(known) == 0:
        raise InputError(f"all {len(alpha)} frames have weight 0: nothing is left to be fitted")
    different = _count_different(known)
    if different < 3:
        problem = f"{len(known)} frames at {different} different phases do not determine a fit"
        raise InputError(f"{problem} of mean, cosine and sine: at least 3 are needed")
    weighted = basis(known) * np.sqrt(weight[weight > 0] / weight.max())[:, np.newaxis]
    condition = float(np.linalg.cond(weighted)) ** 2
    if not condition <= _MAX_CONDITION:
        limit = f"condition {condition:.0e}, at most {_MAX_CONDITION:.0e}"
        problem = f"the phases are too close together to separate mean, cosine and sine ({limit})"
        raise InputError(f"{problem}: spread them over more of the turn")
    return alpha


def fit_matrix(phase: ArrayLike, frame_weights: ArrayLike | None = None) -> Doubles:
    """Return the matrix, (3, N), that makes mean, cosine and sine of samples: the weighted pseudo-inverse.

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
    """How a turn of N frames is fitted; two are the same if they are one object."""

    phase: Doubles  # (N,), radians from 0 to a turn
    weights: Doubles  # (N,), above 0
    matrix: Doubles  # (3, N): see `fit_matrix`
    table: NDArray[np.float32]  # (6, N): cosines, sines, roots of the weights, and the matrix
    covariance: Doubles  # (3, 3), of mean, cosine and sine, where samples of weight 1 have variance 1
    weighted: bool  # whether a frame has another weight than 1
    goes_round: bool  # see `goes_round`


def turn_fit(phase: Doubles, weights: Doubles) -> TurnFit | None:
    """Return how a turn is fitted, weights being above 0, or None if its phases do not determine that.

    Turns of the same phases, modulo a whole turn, share one fit.
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


def cut_into_turns(phase: Doubles) -> list[slice]:
    """Return the frames of each turn, in order; the last turn may go on with later frames.

    A turn is over with the first frame that is a whole turn away from its own first. Phases that fall back
    by more than half a turn are taken to be given modulo a turn.
    """
    if len(phase) == 0:
        return []
    steps = np.diff(phase)
    forward = 1.0 if (np.median(steps) if len(steps) else 0.0) >= 0 else -1.0
    steps = np.where(forward * steps < -np.pi, steps + forward * 2 * np.pi, steps)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    starts = [0]
    for frame, angle in enumerate(way):
        if abs(angle - way[starts[-1]]) >= _FULL_TURN:
            starts.append(frame)
    return [slice(start, stop) for start, stop in zip(starts, [*starts[1:], len(way)], strict=True)]


def longest_turn(phase: Doubles) -> int:
    """Return the number of frames of the longest turn."""
    return max((turn.stop - turn.start for turn in cut_into_turns(phase)), default=0)


def goes_round(phase: Doubles) -> bool:
    """Return whether no gap between phases is above half a turn."""
    return bool(np.max(_gaps(phase)) <= np.pi + 1e-6)


def _count_different(phase: Doubles) -> int:
    """Return how many different points of the circle phases are, but for rounding."""
    return max(1, int(np.count_nonzero(_gaps(phase) > _SAME))) if len(phase) else 0


def _gaps(phase: Doubles) -> Doubles:
    """Return the angles between phases that are next to each other on the circle."""
    points = np.sort(np.mod(phase, 2 * np.pi))
    return np.diff(points, append=points[0] + 2 * np.pi)
