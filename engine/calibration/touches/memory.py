"""What earlier touches have told of a sensor, and how it fades."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mirrorskin.engine.calibration.touches.reading import Touch
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles


class Earlier(NamedTuple):
    """What earlier touches, or presses of a ball, have told of a sensor."""

    names: tuple[str, ...]  # of the parameters
    values: Doubles
    information: Doubles
    pull: Doubles  # information times the deviation of the parameters that touches alone would have
    touches: int
    time: float  # of the last, seconds since 1970; NaN if unknown


class Memory(NamedTuple):
    """Information of earlier touches, and the weight of each of the new ones."""

    matrix: Doubles
    vector: Doubles  # matrix times the parameters that earlier touches alone would have
    weights: tuple[float, ...]
    time: float

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
            matrix[np.ix_(at, at)] = weights[-1] * before.information[np.ix_(of, of)]
            vector[at] = weights[-1] * before.pull[of]
            vector += matrix[:, at] @ before.values[of]
        return cls(matrix, vector, tuple(weights[: len(touches)]), last)

    def moved(self, by: Doubles) -> Memory:
        """Return the information about parameters that are smaller by some values."""
        return self._replace(vector=self.vector - self.matrix @ by)
