"""What earlier touches have told of a sensor, and how it fades.

What touches tell is the probability of the movement, times that of response and gel for a given movement.
Light and gel age, and the movement does not: with time, only the latter becomes less certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.touches.reading import Touch
from mirrorskin.engine.calibration.touches.window import MOVEMENT
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

_OF_GEL = "compliance"
_SINGULAR = 1e-12  # relative eigenvalue of a direction about which touches tell nothing


class Earlier(NamedTuple):
    """What earlier touches, or presses of a ball, have told of a sensor."""

    names: tuple[str, ...]  # of the parameters
    values: Doubles
    information: Doubles
    pull: Doubles  # information times the deviation of the parameters that touches alone would have
    touches: int
    time: float  # of the last, seconds since 1970; NaN if unknown


class Memory(NamedTuple):
    """Information of earlier touches, and how much of that of each new one is not forgotten."""

    matrix: Doubles
    vector: Doubles  # matrix times the parameters that earlier touches alone would have
    weights: tuple[float, ...]
    time: float
    names: tuple[str, ...]

    @classmethod
    def of(
        cls,
        before: Earlier | None,
        touches: Sequence[Touch],
        forget: float | None,
        names: Sequence[str],
    ) -> Memory:
        """Return the weights of touches, and what earlier ones told of parameters."""
        times = [touch.time for touch in touches] + ([] if before is None else [before.time])
        last = max((time for time in times if math.isfinite(time)), default=math.nan)
        weights = [1.0] * len(times)
        if forget is not None:
            if not forget > 0:
                raise InputError(f"forget {forget} s: give a time above 0")
            if not np.isfinite(times).all():
                raise InputError(
                    "old touches can only be forgotten if recordings have a start time: leave forget out"
                )
            weights = [math.exp((time - last) / forget) for time in times]
        matrix, vector = np.zeros((len(names),) * 2), np.zeros(len(names))
        if before is not None:
            at = np.array([names.index(name) for name in before.names if name in names])
            of = np.array([number for number, name in enumerate(before.names) if name in names])
            matrix[np.ix_(at, at)] = before.information[np.ix_(of, of)]
            vector[at] = before.pull[of]
            vector += matrix[:, at] @ before.values[of]
            matrix, vector = _faded(matrix, vector, weights[-1], names)
        return cls(matrix, vector, tuple(weights[: len(touches)]), last, tuple(names))

    def of_touch(self, number: int, information: Doubles, push: Doubles) -> tuple[Doubles, Doubles]:
        """Return what is not forgotten of a new touch's information, and of its push."""
        return _faded(information, push, self.weights[number], self.names)

    def moved(self, by: Doubles) -> Memory:
        """Return the information about parameters that are smaller by some values."""
        return self._replace(vector=self.vector - self.matrix @ by)


def _faded(matrix: Doubles, vector: Doubles, weight: float, names: Sequence[str]) -> tuple[Doubles, Doubles]:
    """Return information, and this times parameters, with a weight below 1 for response and gel alone.

    The information about the movement is what remains if these are unknown. That about them for a given
    movement gets the weight, as if its variance had grown.
    """
    if weight == 1:
        return matrix, vector
    moves = np.array([name in MOVEMENT and name != _OF_GEL for name in names])
    movement, rest = np.flatnonzero(moves), np.flatnonzero(~moves)
    by_rest, pull_by_rest = told_by(matrix, vector, movement, rest)
    faded, pull = weight * matrix, weight * vector
    faded[np.ix_(movement, movement)] += (1 - weight) * (matrix[np.ix_(movement, movement)] - by_rest)
    pull[movement] += (1 - weight) * (vector[movement] - pull_by_rest)
    return (faded + faded.T) / 2, pull


def told_by(
    matrix: Doubles, vector: Doubles, of: NDArray[np.intp], by: NDArray[np.intp]
) -> tuple[Doubles, Doubles]:
    """Return the part of the information on some parameters, and of its vector, that is lost without others.

    What remains is known even if those others, on which it depends, are unknown.
    """
    mixed = matrix[np.ix_(by, of)]
    share = np.linalg.lstsq(matrix[np.ix_(by, by)], mixed, rcond=_SINGULAR)[0].T
    return share @ mixed, share @ vector[by]
