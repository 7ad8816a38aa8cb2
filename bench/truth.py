"""What heights should be: the direct solution in double precision, and how far an answer is from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.integration.graph import Flags, Floats, Mask, link
from mirrorskin.bench.peers.integration.system import (
    Doubles,
    System,
    as_map,
    assemble,
    centre,
    solve_exactly,
)
from mirrorskin.bench.slopes import PIXEL


@dataclass(frozen=True, slots=True)
class Truth:
    """The heights of one problem.

    Attributes
    ----------
    system : System
        Its equations.
    values : ndarray, (N,), float64
        Their answer, mean 0 in each component.
    wanted : ndarray, (H, W), bool
        Where heights are asked for.
    """

    system: System
    values: Doubles
    wanted: Mask

    @property
    def range(self) -> float:
        """Of the heights."""
        return float(np.ptp(self.values))

    @property
    def map(self) -> NDArray[np.float32]:
        """The heights as a map; NaN where none are asked for."""
        return as_map(self.system, self.values, self.wanted)

    def settle(self, answer: NDArray[Any]) -> Doubles:
        """Return an answer, (N,) or (H, W), at the pixels of the equations with mean 0 in each component."""
        values = answer if answer.ndim == 1 else answer[self.system.linked]
        return centre(self.system, values.astype(np.float64))

    def error(self, answer: NDArray[Any]) -> float:
        """Return the root mean square error of an answer, in ranges of the heights."""
        return float(np.sqrt(np.mean(np.square(self.settle(answer) - self.values)))) / self.range


def find_truth(slopes: Floats, mask: Flags, edges: Flags | None) -> Truth:
    """Return the direct solution; see `mirrorskin.bench.peers.integration.graph.link`."""
    system = assemble(link(slopes.astype(np.float64), PIXEL, mask, edges))
    return Truth(system, centre(system, solve_exactly(system)), mask != 0)
