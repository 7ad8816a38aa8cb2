"""The position of the body at any time, from reports, which are few, late and uneven."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.hw.base.stage import Report
from mirrorskin.hw.rig.plans import Plan
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io.base.types import Floats
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_RECENT = 8  # number of latest reports that determine the current position
_SLOPES = (0.2, 2.0)  # range of the ratio of planned to elapsed time
_AT_REST = 1e-3  # tolerance for rest, as a share of the trajectory's length
_RAMPS = (0.004, 2.0)  # range of the acceleration time of a stage, seconds
_REPORTS_MIN = 4  # minimum number of reports in motion to estimate more than the start time
_SYSTEMATIC = 1.5  # excess of the deviations over chance, as a ratio, above which they are systematic
_SMOOTH = 5  # reports on each side
_LOST_FRAME_GAP = 0.6  # periods in excess of one that may indicate a lost frame
_GAP_NEIGHBOURS = 9  # frames on each side of a gap


class Progress:
    """Converts reports of a continuous plan to travelled distance: mm, or radians without jumps."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._last: tuple[float, float] | None = None

    def __call__(self, report: Report) -> float:
        """Return the distance; reports must be in the order of their times."""
        expected = 0.0
        if self._last is not None:  # as planned, but half as far: the body may have been at rest meanwhile
            before, distance = self._last
            speed = self._plan.path.speed
            expected = distance + min(speed * (report.time - before) / 2, self._plan.period / 2)
        now = self._plan.distance_of(report.position, expected)
        self._last = report.time, now
        return now


class LiveTrack:
    """The live position: the planned trajectory, synchronised to the latest reports.

    A straight line through the recent reports gives the current time on the plan and its rate; the plan gives
    the position. It never moves backwards. The move was commanded at `began`.
    """

    def __init__(self, path: Trapezoid, began: float) -> None:
        self._path = path
        self._reports: list[tuple[float, float]] = []
        self._line = began, 0.0, 1.0
        self._last = 0.0
        self._done = math.inf

    def add(self, time: float, distance: float) -> None:
        """Add a report: the distance travelled at a time, seconds."""
        rest = _AT_REST * self._path.length
        if distance <= rest:
            self._line = max(time, self._line[0]), 0.0, 1.0
        elif distance >= self._path.length - rest:
            self._done = min(self._done, time)
        else:
            self._reports = [*self._reports[1 - _RECENT :], (time, float(self._path.time(distance)))]
            self._line = self._fit_line()

    def at(self, times: ArrayLike) -> Floats:
        """Return the distance at increasing times, in the shape of `times`."""
        t = np.asarray(times, np.float64)
        origin, start, slope = self._line
        distance = self._path.place(start + slope * (t - origin))
        distance = np.where(t >= self._done, self._path.length, distance)
        distance = np.maximum.accumulate(np.maximum(distance, self._last))
        self._last = float(distance[-1]) if distance.size else self._last
        return distance

    def _fit_line(self) -> tuple[float, float, float]:
        """Return a time, the corresponding time on the plan, and the ratio of their rates."""
        time, planned = np.array(self._reports).T
        slope = 1.0
        if len(time) >= 3:
            spread = time - time.mean()
            slope = float(np.clip(spread @ planned / (spread @ spread), *_SLOPES))
        return float(time.mean()), float(planned.mean()), slope


class Track:
    """The final position, fitted to all reports after the move.

    Start time, speed and acceleration of a trapezoidal profile are fitted to all reports together, so the
    jitter of single reports has little influence. Deviations that neighbouring reports agree on are added.
    `times`, (n,), seconds, and `distances`, (n,), mm or radians, are the reports; `path` is the planned
    trajectory. ``began`` and ``path`` are the fitted values; ``spread`` is the standard deviation of the
    reports about the result, mm or radians.
    """

    began: float
    path: Trapezoid

    def __init__(self, times: ArrayLike, distances: ArrayLike, path: Trapezoid) -> None:
        time, distance = np.asarray(times, np.float64), np.asarray(distances, np.float64)
        self.began, self.path = _fit(time, distance, path)
        residual = distance - self.path.place(time - self.began)
        self._extra = _smooth_residual(residual)
        self._time = time
        self.reports: int = len(time)
        self.spread: float = mad_sigma(residual - self._extra)

    @property
    def ended(self) -> float:
        """Time at which the body came to rest, seconds."""
        return self.began + self.path.duration

    def at(self, times: ArrayLike) -> Floats:
        """Return the distance at increasing times; it never decreases."""
        t = np.asarray(times, np.float64)
        distance = self.path.place(t - self.began)
        if self._extra.any():
            distance = np.clip(distance + np.interp(t, self._time, self._extra), 0, self.path.length)
        return np.maximum.accumulate(distance)


def _fit(time: Floats, distance: Floats, path: Trapezoid) -> tuple[float, Trapezoid]:
    """Fit start time, speed and acceleration to all reports."""
    rest = _AT_REST * path.length
    moving = (distance > rest) & (distance < path.length - rest)
    if not moving.any():
        before = time[distance <= rest]
        return (float(before[-1]) if len(before) else float(time[0])), path
    began = float(np.median(time[moving] - path.time(distance[moving])))
    if np.count_nonzero(moving) < _REPORTS_MIN:
        return began, path

    def trajectory(values: Floats) -> tuple[float, Trapezoid]:
        shift, speed, ramp = values
        faster = path.speed * math.exp(speed)
        return began + shift, replace(path, speed=faster, acceleration=faster / math.exp(ramp))

    def residuals(values: Floats) -> Floats:
        start, trial = trajectory(values)
        return trial.place(time - start) - distance

    scale = mad_sigma(residuals(np.array([0.0, 0.0, math.log(path.ramp)]))) + 1e-5 * path.length
    low, high = (math.log(ramp) for ramp in _RAMPS)
    loss, bounds = least_squares.soft_l1(0.3), (np.array([-np.inf, -3.0, low]), np.array([np.inf, 3.0, high]))
    starts = ([0.0, 0.0, math.log(ramp)] for ramp in (0.02, 0.1, 0.5))
    fits = [least_squares.fit(residuals, start, noise=scale, loss=loss, bounds=bounds) for start in starts]
    return trajectory(min(fits, key=lambda fit: fit.cost).parameters)


def _smooth_residual(residual: Floats) -> Floats:
    """Return the smoothed residual where neighbouring reports agree; 0 where it is random."""
    chance = mad_sigma(np.diff(residual)) / math.sqrt(2)
    if len(residual) <= 2 * _SMOOTH or mad_sigma(residual) <= _SYSTEMATIC * chance:
        return np.zeros_like(residual)
    weights = (1 - (np.abs(np.arange(-_SMOOTH, _SMOOTH + 1)) / (_SMOOTH + 1)) ** 3) ** 3
    edges = np.pad(residual, _SMOOTH, mode="edge")
    return np.asarray(np.convolve(edges, weights / weights.sum(), mode="valid"))


def even_times(number: ArrayLike, arrival: ArrayLike, window: int = 25) -> Floats:
    """Return the arrival times of a camera's frames without jitter.

    A camera exposes at a constant rate, independent of the transfer of its frames. Each time is taken from a
    straight line through the times of the surrounding frames, by frame number. Uncounted lost frames are
    detected because all later frames are late by whole periods.

    Numbers include the lost frames that were detected; `window` frames on each side are used. The result,
    (n,), seconds, never decreases.
    """
    t = np.asarray(arrival, np.float64)
    if len(t) < 3:
        return t
    n = _with_lost_frames(np.asarray(number, np.float64), t)
    frame = np.arange(len(n))
    first, end = np.maximum(frame - window, 0), np.minimum(frame + window + 1, len(n))

    def mean(values: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray((total[end] - total[first]) / (end - first))

    # Relative to the middle and to a constant rate, which avoids cancellation.
    n = n - n.mean()
    pace = (t[-1] - t[0]) / (n[-1] - n[0])
    late = t - t[0] - pace * n
    mean_n, mean_late = mean(n), mean(late)
    slope = (mean(n * late) - mean_n * mean_late) / (mean(n * n) - mean_n**2)
    return np.maximum.accumulate(t[0] + pace * n + mean_late + slope * (n - mean_n))


def _with_lost_frames(number: Floats, arrival: Floats) -> Floats:
    """Return numbers that include undetected lost frames: later frames are late by whole periods."""
    step = min(_GAP_NEIGHBOURS, len(number) // 2)  # averaging over some frames suppresses jitter
    period = float(np.median((arrival[step:] - arrival[:-step]) / (number[step:] - number[:-step])))
    late = arrival - period * (number - number[0])
    counted = number.copy()
    for gap in np.flatnonzero(np.diff(late) > _LOST_FRAME_GAP * period) + 1:
        before, after = late[max(0, gap - _GAP_NEIGHBOURS) : gap], late[gap : gap + _GAP_NEIGHBOURS]
        counted[gap:] += max(0, round((np.median(after) - np.median(before)) / period))
    return counted
