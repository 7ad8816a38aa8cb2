"""What a turn's phases and weights say of its fit, worked out once for all turns that share them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.rotation.phases import Doubles, fit_matrix
from mirrorskin.engine.rotation.turns import goes_round
from mirrorskin.io import InputError

_DIGITS = 9  # of a phase in radians: what differs by less is the same phase, told after another turn
_KEPT = 256


@dataclass(frozen=True, slots=True, eq=False)
class TurnFit:
    """How a turn of N frames is fitted; two are the same if they are one object.

    Attributes
    ----------
    matrix : ndarray, (3, N), float64
        See `mirrorskin.engine.rotation.phases.fit_matrix`.
    table : ndarray, (6, N), float32
        Cosine and sine of each phase, root of its weight, and its shares in mean, cosine and sine.
    covariance : ndarray, (3, 3), float64
        Of mean, cosine and sine, where samples of weight 1 have variance 1.
    weighted : bool
        Whether a frame has another weight than 1.
    goes_round : bool
        Whether no gap between phases is above half a turn.
    """

    matrix: Doubles
    table: NDArray[np.float32]
    covariance: Doubles
    weighted: bool
    goes_round: bool


def fit_of(phase: Doubles, weights: Doubles) -> TurnFit | None:
    """Return how a turn is fitted, or None if its phases do not determine that.

    Parameters
    ----------
    phase : ndarray, (N,), float64
        Radians; they count modulo a turn, to 1e-9.
    weights : ndarray, (N,), float64
        Above 0.
    """
    return _fit_of(np.round(np.mod(phase, 2 * np.pi), _DIGITS).tobytes(), weights.tobytes())


@lru_cache(_KEPT)
def _fit_of(phases: bytes, weighing: bytes) -> TurnFit | None:
    phase, weights = np.frombuffer(phases), np.frombuffer(weighing)
    try:
        matrix = fit_matrix(phase, weights)
    except InputError:
        return None
    return TurnFit(
        matrix,
        np.stack([np.cos(phase), np.sin(phase), np.sqrt(weights), *matrix]).astype(np.float32),
        matrix @ (matrix / weights).T,
        bool(np.any(weights != 1)),
        goes_round(phase),
    )
