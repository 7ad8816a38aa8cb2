"""How long the stages of live work take: counts, and the last few thousand times of each."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.types import STAGES, Latency, Status

_KEPT = 4096  # times of a stage
_LATELY = 1.0  # seconds over which a rate is told
_FRESH = 0.25  # seconds for which percentiles that were worked out are told again


class Reservoir:
    """The last few thousand of some numbers."""

    def __init__(self) -> None:
        self._values: NDArray[np.float64] = np.full(_KEPT, np.nan)
        self._count = 0

    def add(self, values: NDArray[np.float64]) -> None:
        """Take in some more; of very many, the last."""
        values = values[-_KEPT:]
        places = (self._count + np.arange(len(values))) % _KEPT
        self._values[places] = values
        self._count += len(values)

    def latency(self) -> Latency:
        """Return the median and what 99 % of them stay below."""
        if self._count == 0:
            return Latency(math.nan, math.nan)
        median, p99 = np.percentile(self._values[: min(self._count, _KEPT)], [50, 99])
        return Latency(float(median), float(p99))


class Watch:
    """Counts frames and updates, and times stages."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(("frames", "used", "skipped", "dropped", "updates"), 0)
        self._times = {stage: Reservoir() for stage in STAGES}
        self._lately: deque[tuple[float, int]] = deque()
        self._begun = self._now = math.nan
        self._latency: dict[str, Latency] = {}
        self._told = -math.inf

    def took(self, now: float, frames: int, used: int, dropped: int) -> None:
        """Count frames that were taken from the source."""
        if math.isnan(self._begun):
            self._begun = now
        counts = self._counts
        counts["frames"] += frames
        counts["used"] += used
        counts["skipped"] += frames - used
        counts["dropped"] += dropped
        self._now = now
        self._lately.append((now, counts["frames"]))
        while now - self._lately[0][0] > _LATELY:
            self._lately.popleft()

    def updated(self) -> None:
        """Count an update."""
        self._counts["updates"] += 1

    def time(self, stage: str, seconds: float | NDArray[np.float64]) -> None:
        """Note how long a stage took, once or some times; what is no number is not noted."""
        values = np.atleast_1d(np.asarray(seconds, np.float64))
        self._times[stage].add(values[np.isfinite(values)])

    def status(self, fresh: bool = False) -> Status:
        """Return counts and times so far; percentiles may be a quarter of a second old, unless ``fresh``."""
        if fresh or not self._now - self._told < _FRESH:
            self._latency = {stage: times.latency() for stage, times in self._times.items()}
            self._told = self._now
        seconds = 0.0 if math.isnan(self._begun) else self._now - self._begun
        return Status(**self._counts, seconds=seconds, rate=self._rate(), latency=dict(self._latency))

    def _rate(self) -> float:
        """Return the frames a second that were taken lately."""
        if len(self._lately) < 2:
            return 0.0
        (first, before), (last, after) = self._lately[0], self._lately[-1]
        return (after - before) / (last - first) if last > first else 0.0
