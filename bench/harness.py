"""Fair timing on a shared machine: the works of a case take turns in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of one work over all rounds: the median, and the quartiles as its spread."""

    median: float
    lower: float
    upper: float
    rounds: int


def take_turns(works: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, Timing]:
    """Time several works, each once a round, after one warm-up that does not count.

    Parameters
    ----------
    works : mapping of str to callable
        Each does its whole work and waits for it.
    rounds : int

    Returns
    -------
    dict of Timing
    """
    for work in works.values():
        work()
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            seconds[name].append(time.perf_counter() - start)
    return {name: _timing(values) for name, values in seconds.items()}


def _timing(values: list[float]) -> Timing:
    lower, median, upper = np.percentile(values, [25, 50, 75])
    return Timing(float(median), float(lower), float(upper), len(values))
