"""Updates of the maps while the body moves, and the status of the live loop."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Motion, Result
from mirrorskin.io.base.threads import computes
from mirrorskin.io.model.result import display_order

WAITED, PUSHED, UPDATED, SHOWN, RAISED = "waited", "push", "update", "frame to map", "frame to height"
STAGES = (WAITED, PUSHED, UPDATED, SHOWN, RAISED)
"""The timed stages: the wait of a frame from its arrival, a push, an update, and the delays of the maps, with
the answers of trackers, and of the heights since the arrival of the newest frame that they include."""

_KEPT = 4096  # number of times per stage
_LATELY = 1.0  # seconds over which the rate is computed
_FRESH = 0.25  # seconds for which percentiles are reused


@dataclass(frozen=True, slots=True)
class Event:
    """A quantity that rose above its limit, or fell back; see `Limit`.

    Attributes
    ----------
    name : str
    started : bool
        Whether the quantity rose above the limit, rather than fell back.
    time : float
        That of the update, seconds.
    value : float
        The quantity in this frame.
    """

    name: str
    started: bool
    time: float
    value: float


@dataclass(frozen=True, slots=True)
class Update:
    """Maps of the frames so far, and answers of the trackers; no other object writes to them.

    Attributes are the maps by name or quantity, as those of a result: ``update.height`` is an array, or None
    if it is not available.

    Attributes
    ----------
    frames : int
        Number of frames used so far.
    time : float
        Time of the newest frame's exposure, seconds on the scale of ``Block.time``, which may be the arrival;
        NaN if the source has no times.
    motion : {"vertical", "axial", "horizontal", "twist"}
    position : float
        Position of the body in the newest frame: travel, mm; phase, twist or, of a body that rocks, tilt,
        radians; of a slide, the length of the displacement, mm.
    picture : ndarray, (H, W), uint8, uint16 or float32
        The newest frame, raw counts.
    maps : Result
        The maps that the operation shows, and numbers, with their declarations; see `first`.
        Of built-in operations: ``height``, ``normals``, ``contact``, ``edges`` (which may be of earlier
        frames), ``displacement`` since the first frame, and of a body that rocks ``slope``.
    latency : float
        Seconds from ``time`` to this update; NaN without a time.
    latency_p99 : float
        99th percentile of the latencies of the last 4096 updates, seconds; up to a quarter of a second old.
    tracked : mapping of str to object
        Answers of the trackers by name, such as a pose or forces; None if a tracker has none for this frame,
        as without contact.
    lost : mapping of str to str
        The reasons of those that have none.
    events : tuple of Event
        What started or ended with this frame.
    """

    frames: int
    time: float
    motion: Motion
    position: float
    picture: NDArray[Any]
    maps: Result = field(default_factory=Result)
    latency: float = math.nan
    latency_p99: float = math.nan
    tracked: Mapping[str, Any] = field(default_factory=dict)
    lost: Mapping[str, str] = field(default_factory=dict)
    events: tuple[Event, ...] = ()

    def __getattr__(self, name: str) -> Any:
        if name in Update.__slots__:  # the constructor failed
            raise AttributeError(name)
        return getattr(self.maps, name)

    @property
    def first(self) -> str | None:
        """Name of the map that a display shows first; None without one."""
        return next(iter(display_order(self.maps)), None)

    @property
    def contact_area(self) -> float | None:
        """Square millimetres where sheet and object touch; None if that is unknown."""
        return self.maps.get("contact_area")

    @property
    def height_lag(self) -> int:
        """Number of updates since the frames of the heights."""
        return int(self.maps.get("height_lag", 0))


@dataclass(frozen=True, slots=True)
class Latency:
    """Median and 99th percentile of the last 4096 times of a stage, seconds; NaN without any."""

    median: float
    p99: float


@dataclass(frozen=True, slots=True)
class Status:
    """Counts and times of the live loop.

    Attributes
    ----------
    frames : int
        Frames taken from the source: ``used`` and ``skipped``.
    used : int
        Frames pushed into the operation.
    skipped : int
        Frames that were too old, or omitted because of ``every``.
    dropped : int
        Frames that the camera or its ring buffer lost before they were taken.
    updates : int
    seconds : float
        Time since the first frame was taken.
    rate : float
        Frames taken per second, over the last second.
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


class Monitor:
    """Counts frames and updates, and times stages; several threads may use it at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = dict.fromkeys(("frames", "used", "skipped", "dropped", "updates"), 0)
        self._times = {stage: _Recent() for stage in STAGES}
        self._lately: deque[tuple[float, int]] = deque()
        self._started = self._now = math.nan
        self._latency: dict[str, Latency] = {}
        self._computed = -math.inf

    @property
    def used(self) -> int:
        """Number of frames pushed so far."""
        return self._counts["used"]

    def took(self, now: float, frames: int, used: int, dropped: int) -> None:
        """Count frames taken from the source."""
        with self._lock:
            if math.isnan(self._started):
                self._started = now
            self._now = now
            counts = {"frames": frames, "used": used, "skipped": frames - used, "dropped": dropped}
            for name, count in counts.items():
                self._counts[name] += count
            self._lately.append((now, self._counts["frames"]))
            while now - self._lately[0][0] > _LATELY:
                self._lately.popleft()

    def updated(self) -> None:
        """Count an update."""
        with self._lock:
            self._counts["updates"] += 1

    def time(self, stage: str, *seconds: float) -> None:
        """Record durations of a stage; NaN is ignored."""
        with self._lock:
            for duration in seconds:
                if math.isfinite(duration):
                    self._times[stage].add(duration)

    @computes  # NumPy's percentiles contain C++
    def status(self, fresh: bool = False) -> Status:
        """Return counts and times so far; percentiles may be a quarter of a second old, unless ``fresh``."""
        with self._lock:
            if fresh or not self._now - self._computed < _FRESH:
                self._latency = {stage: times.latency() for stage, times in self._times.items()}
                self._computed = self._now
            seconds = 0.0 if math.isnan(self._started) else self._now - self._started
            rate = 0.0
            if len(self._lately) > 1:
                (first, before), (last, after) = self._lately[0], self._lately[-1]
                rate = (after - before) / (last - first) if last > first else 0.0
            return Status(**self._counts, seconds=seconds, rate=rate, latency=dict(self._latency))


class _Recent:
    """The last durations of a stage, in an array, of which percentiles take less time than of a deque."""

    def __init__(self) -> None:
        self._values, self._count = np.zeros(_KEPT), 0

    def add(self, seconds: float) -> None:
        """Add a duration."""
        self._values[self._count % _KEPT] = seconds
        self._count += 1

    def latency(self) -> Latency:
        """Return their percentiles."""
        if not self._count:
            return Latency(math.nan, math.nan)
        median, p99 = np.percentile(self._values[: self._count], [50, 99])
        return Latency(float(median), float(p99))
