"""What is known while the body still moves, and how well the work keeps up with the camera."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import Motion

WAITED, PUSHED, UPDATED, SHOWN, RAISED = "waited", "push", "update", "frame to map", "frame to height"
STAGES = (WAITED, PUSHED, UPDATED, SHOWN, RAISED)
"""What is timed: a frame from its arrival until it was taken, a push of frames, an update, and from the
newest frame's arrival until the maps that it is in; of heights, which may be of an earlier one, from that."""

_KEPT = 4096  # times of a stage
_LATELY = 1.0  # seconds over which a rate is counted
_FRESH = 0.25  # seconds for which percentiles are returned again


class Maps(TypedDict, total=False):
    """Maps of the frames so far; see `Update`. Those that are not known, or not yet, are missing or None."""

    height: NDArray[np.float32] | None
    normals: NDArray[np.float32] | None
    contact: NDArray[np.uint8] | None
    edges: NDArray[np.uint8] | None
    contact_area: float | None
    height_lag: int
    offset_unknown: bool
    displacement: NDArray[np.float32] | None
    slope: NDArray[np.float32] | None


@dataclass(frozen=True, slots=True)
class Update:
    """What is known after the frames so far.

    Maps are the receiver's own: nothing writes to them any more. Those that are not known, or not yet, are
    None.

    Attributes
    ----------
    frames : int
        That were used so far.
    time : float
        Of the newest of them, seconds on the scale of ``Block.time``; NaN where the source has none.
    motion : {"vertical", "axial", "horizontal", "twist"}
    position : float
        Of the body in the newest frame: travel, mm; phase, twist or, of a body that rocks, tilt, radians; of
        a slide the length of its displacement, mm.
    picture : ndarray, (H, W), uint8, uint16 or float32
        The newest frame, raw counts.
    height : ndarray, (H, W), float32
        Millimetres; NaN where there is no answer.
    height_lag : int
        Updates since the one whose frames the heights are of.
    normals : ndarray, (H, W, 3), float32
        Unit vectors; NaN where there is no answer.
    contact : ndarray, (H, W), uint8
        1 where sheet and object touch: of a press so far, of a rotation in all frames of its window.
    edges : ndarray, (H, W), uint8
        1 on thin lines where the normal jumps or contact ends; of the last frames for which there was time.
    contact_area : float
        Square millimetres.
    offset_unknown : bool
        Whether heights are relative, the mean of each connected piece being 0.
    displacement : ndarray, (H, W, 2), float32
        Millimetres along x and y that the skin has moved since the first frame.
    slope : ndarray, (H, W), float32
        Of a body that rocks: millimetres that the surface rises for each along its way.
    """

    frames: int
    time: float
    motion: Motion
    position: float
    picture: NDArray[Any]
    height: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    contact: NDArray[np.uint8] | None = None
    edges: NDArray[np.uint8] | None = None
    contact_area: float | None = None
    height_lag: int = 0
    offset_unknown: bool = False
    displacement: NDArray[np.float32] | None = None
    slope: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True)
class Latency:
    """Median and 99th percentile of the seconds that a stage took, of the last few thousand; NaN before."""

    median: float
    p99: float


@dataclass(frozen=True, slots=True)
class Status:
    """How well the work keeps up with the camera.

    Attributes
    ----------
    frames : int
        That were taken from the source: ``used`` and ``skipped``.
    used : int
        That were pushed into the estimator.
    skipped : int
        That were too old when they were taken, or more than the estimator asks for.
    dropped : int
        That the camera or its ring lost before they could be taken.
    updates : int
    seconds : float
        Since the first frame was taken.
    rate : float
        Frames a second that were taken lately.
    latency : mapping of str to Latency
        By stage; see `STAGES`.
    """

    frames: int = 0
    used: int = 0
    skipped: int = 0
    dropped: int = 0
    updates: int = 0
    seconds: float = 0.0
    rate: float = 0.0
    latency: Mapping[str, Latency] = field(default_factory=dict)


class Monitor(ThreadSafe):
    """Counts frames and updates, and times stages."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(("frames", "used", "skipped", "dropped", "updates"), 0)
        self._times: dict[str, deque[float]] = {stage: deque(maxlen=_KEPT) for stage in STAGES}
        self._lately: deque[tuple[float, int]] = deque()
        self._begun = self._now = math.nan
        self._latency: dict[str, Latency] = {}
        self._computed = -math.inf

    @property
    def used(self) -> int:
        """Frames that were pushed so far."""
        return self._counts["used"]

    def took(self, now: float, frames: int, used: int, dropped: int) -> None:
        """Count frames that were taken from the source."""
        if math.isnan(self._begun):
            self._begun = now
        self._now = now
        counts = {"frames": frames, "used": used, "skipped": frames - used, "dropped": dropped}
        for name, count in counts.items():
            self._counts[name] += count
        self._lately.append((now, self._counts["frames"]))
        while now - self._lately[0][0] > _LATELY:
            self._lately.popleft()

    def updated(self) -> None:
        """Count an update."""
        self._counts["updates"] += 1

    def time(self, stage: str, *seconds: float) -> None:
        """Note how long a stage took, once or some times; NaN is not noted."""
        self._times[stage].extend(one for one in seconds if math.isfinite(one))

    def status(self, fresh: bool = False) -> Status:
        """Return counts and times so far; percentiles may be a quarter of a second old, unless ``fresh``."""
        if fresh or not self._now - self._computed < _FRESH:
            self._latency = {stage: _latency(times) for stage, times in self._times.items()}
            self._computed = self._now
        seconds = 0.0 if math.isnan(self._begun) else self._now - self._begun
        return Status(**self._counts, seconds=seconds, rate=self._rate(), latency=dict(self._latency))

    def _rate(self) -> float:
        """Return the frames a second that were taken lately."""
        if len(self._lately) < 2:
            return 0.0
        (first, before), (last, after) = self._lately[0], self._lately[-1]
        return (after - before) / (last - first) if last > first else 0.0


def _latency(times: deque[float]) -> Latency:
    if not times:
        return Latency(math.nan, math.nan)
    median, p99 = np.percentile(np.array(times), [50, 99])
    return Latency(float(median), float(p99))
