"""Measurement of a camera's delay: a move back and forth must look the same in both directions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import Axis
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import AxialPlan, Plan, RockPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Move, Rig
from mirrorskin.hw.rig.track import Track, even_times
from mirrorskin.hw.stages.moves import SLOWEST
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io.base.types import Floats, InputError

# Parameters of the move
_SECONDS = 1.5  # minimum duration in one direction
_FRAMES, _MOST_FRAMES = 60, 150  # minimum and maximum number of frames in one direction
_PRESSED = 0.5  # share of a press before the move starts
_LONGEST_DELAY = 0.6  # maximum time to wait for late frames, seconds
_BLOCK = 8  # frames
_WANDER = 0.5  # seconds during which frames have a common delay
_EVEN_RATIO = 1.3  # ratio of the residuals of one line and of local lines, for a camera with a constant rate
_SPEED_MARGIN = 0.9  # of an axis's maximum speed; its inverse applies to the minimum speed

# Parameters of the estimate
_REMEDY = "use steps, or, unless the camera is a stream, set 'delay' of the camera in the rig file"
_BLOCKS = 16  # along each side of the picture
_COMPONENTS = 6  # number of principal components of the picture's change
_RANGE = (-0.05, 0.6)  # seconds
_TRIALS = 66
_KNOTS = (5, 40)
_FRAMES_A_KNOT = 5
_STIFFNESS = 1e-6
_EXPLAINED = 0.5  # minimum share of the picture's change that the position explains
_ERROR_MAX = 0.01  # seconds


@dataclass(frozen=True, slots=True)
class Delay:
    """Time from the middle of an exposure to the arrival of the frame."""

    seconds: float
    error: float  # standard error, seconds


@dataclass(frozen=True, slots=True)
class _Stroke:
    """A move between two positions, and the distance travelled along it."""

    begin: Position
    end: Position
    length: float
    along: Callable[[Position], float]
    fastest: float
    slowest: float


def measure_delay(rig: Rig, plan: Plan) -> Delay:
    """Move back and forth in contact, and return the camera's delay.

    A press moves over the deeper half of its travel. So do slides and twists, where friction would make the
    two directions look different. A rotation leans from phase 0 to the opposite phase. Each direction takes
    1.5 s or 60 frames, whichever is longer, if the stage can move that slowly. The delay is relative to the
    stage's reports and includes their latency, as it should.
    """
    stroke = _stroke(rig, plan)
    rests = rig.go(stroke.begin).time
    seconds = max(_SECONDS, _FRAMES * rig.period)
    speed = min(max(stroke.length / seconds, stroke.slowest), stroke.fastest)
    seconds = stroke.length / speed
    every = max(1, math.floor(seconds * rig.rate / _MOST_FRAMES))
    _FrameLog(rig, every).until(rests + _LONGEST_DELAY)  # earlier frames may show the approach
    log = _FrameLog(rig, every)
    outward = log.follow(rig.begin(lambda: rig.stage.move(stroke.end, speed), timed=True))
    back = log.follow(rig.begin(lambda: rig.stage.move(stroke.begin, speed), timed=True))
    log.until(back.ended + _LONGEST_DELAY)

    path = Trapezoid.planned(stroke.length, speed)
    turned = (outward.ended + back.began) / 2
    down = _track(rig, stroke.along, path, outward.began, turned)
    up = _track(rig, lambda place: stroke.length - stroke.along(place), path, back.began, back.ended)

    def place(times: Floats) -> Floats:
        return np.where(times < turned, down.at(times), stroke.length - up.at(times))

    clock, clock_error = frame_times(*log.arrivals())
    delay = estimate_delay(clock, np.concatenate(log.pictures), place, rig.camera.name)
    rig.go(plan.first)
    report_errors = [track.spread / track.path.speed / math.sqrt(track.reports) / 2 for track in (down, up)]
    return replace(delay, error=math.hypot(delay.error, clock_error, *report_errors))


def _stroke(rig: Rig, plan: Plan) -> _Stroke:
    stage = rig.settings.stage
    if isinstance(plan, AxialPlan):
        begin, end = plan.place(0.0), plan.place(math.pi)
        return _Stroke(
            begin, end, 2 * plan.tilt, lambda place: plan.tilt - place.pitch, *_speeds(stage.pitch)
        )
    if isinstance(plan, RockPlan):
        along = partial(plan.distance_of, expected=0.0)
        return _Stroke(plan.first, plan.ends[0], plan.length, along, *_speeds(stage.pitch))
    start, stop = (plan.start, plan.stop) if isinstance(plan, VerticalPlan) else (0.0, plan.first.travel)
    length = (1 - _PRESSED) * (stop - start)
    if length <= 0:
        raise InputError(f"the camera's delay cannot be measured with a press of {stop:g} mm: {_REMEDY}")
    first, end = stop - length, Position(stop)
    return _Stroke(Position(first), end, length, lambda place: place.travel - first, *_speeds(stage.travel))


def _speeds(axis: Axis | None) -> tuple[float, float]:
    """Return the maximum and the minimum speed of an axis, mm/s or rad/s."""
    if axis is None:  # not possible: a rotation needs an axis of lean
        return math.inf, 0.0
    return _SPEED_MARGIN * axis.top_speed, SLOWEST / 60 / axis.scale / _SPEED_MARGIN


def _track(
    rig: Rig, along: Callable[[Position], float], path: Trapezoid, since: float, until: float
) -> Track:
    reports = [report for report in rig.stage.history(since) if report.time <= until]
    return Track([report.time for report in reports], [along(report.position) for report in reports], path)


class _FrameLog:
    """Frames of the move, reduced to block means."""

    def __init__(self, rig: Rig, every: int) -> None:
        self._rig, self._every = rig, every
        self._times: list[Floats] = []
        self._numbers: list[NDArray[np.int64]] = []
        self.pictures: list[Floats] = []

    def arrivals(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the frames' numbers, (n,), and times of arrival, (n,), seconds."""
        return np.concatenate(self._numbers), np.concatenate(self._times)

    def follow(self, move: Move) -> Move:
        """Collect frames until a move is over."""
        while not move.over:
            self._take()
        self._rig.end(move)
        return move

    def until(self, time: float) -> None:
        """Collect frames until a time."""
        while self._take() < time:
            pass

    def _take(self) -> float:
        frames = self._rig.take(_BLOCK)
        some = frames.number % self._every == 0
        self._times.append(frames.time[some])
        self._numbers.append(frames.number[some])
        self.pictures.append(block_means(frames.pixels[some]))
        return float(frames.time[-1])


# The estimate from frames and positions


def frame_times(number: NDArray[np.int64], arrival: Floats) -> tuple[Floats, float]:
    """Return smoothed arrival times of frames, (n,), seconds, and their standard error.

    Numbers and arrivals are (n,). If the camera has a constant rate, the times are a straight line through
    all arrivals. Their standard error is the RMS deviation of means over half a second from that line. Random
    jitter hardly contributes to it; a varying latency of the connection or of a buffer does, since it may
    occur in a scan as well.
    """
    line = even_times(number, arrival, len(arrival))
    late = arrival - line
    blocks = min(max(2, round((arrival[-1] - arrival[0]) / _WANDER)), len(arrival))
    wander = math.sqrt(np.mean([np.mean(block) ** 2 for block in np.array_split(late, blocks)]))
    keeps_time = np.std(late) <= _EVEN_RATIO * np.std(arrival - even_times(number, arrival))
    return (line if keeps_time else arrival), wander


def block_means(frames: NDArray[Any], blocks: int = _BLOCKS) -> Floats:
    """Return the mean counts of a grid of blocks in each frame, (n, blocks x blocks), float64."""
    rows, columns = (np.linspace(0, size, min(blocks, size) + 1).astype(np.intp) for size in frames.shape[1:])
    sums = np.add.reduceat(frames, columns[:-1], axis=2, dtype=np.float64)
    sums = np.add.reduceat(sums, rows[:-1], axis=1)
    sizes = np.outer(np.diff(rows), np.diff(columns))
    return np.asarray((sums / sizes).reshape(len(frames), sizes.size))  # there may be no frames


def estimate_delay(
    arrival: ArrayLike, pictures: ArrayLike, place: Callable[[Floats], Floats], name: str = "the camera"
) -> Delay:
    """Estimate the delay at which the picture is one function of the position in both directions.

    `arrival`, (n,), seconds, and `pictures`, (n, k), block means, describe the frames; `place` returns the
    position, (n,), at given times. The function is a linear spline with some twenty knots, fitted together
    with a linear drift to the principal components of the picture's change. The delay minimises the sum of
    squares. Its standard error is computed from the residual of each frame, converted to a time.
    """
    from scipy.optimize import minimize_scalar

    time = np.asarray(arrival, np.float64)
    change = _principal_components(np.asarray(pictures, np.float64))
    total = float(np.sum(change**2))

    def cost(delay: float) -> float:
        return float(np.sum(_fit(place(time - delay), time, change)[0] ** 2))

    trials = np.linspace(*_RANGE, _TRIALS)
    costs = [cost(float(delay)) for delay in trials]
    best = int(np.argmin(costs))
    if not total > 0 or best in (0, _TRIALS - 1) or costs[best] > (1 - _EXPLAINED) * total:
        raise HardwareError(
            f"{name}: the delay cannot be measured, because the picture hardly changes with the "
            f"position: press deeper, or {_REMEDY}"
        )
    around = tuple(trials[[best - 1, best + 1]])
    minimum = minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 1e-5})
    error = _error(float(minimum.x), time, change, place)
    if not error < _ERROR_MAX:
        raise HardwareError(
            f"{name}: the delay is {minimum.x:.3f} ± {error:.3f} s, which is too uncertain: press "
            f"deeper, or {_REMEDY}"
        )
    return Delay(float(minimum.x), error)


def _principal_components(pictures: Floats) -> Floats:
    """Return the largest principal components of the pictures' change, (n, c)."""
    change = pictures - pictures.mean(axis=0)
    modes, size, _ = np.linalg.svd(change, full_matrices=False)
    return np.asarray((modes * size)[:, :_COMPONENTS])


def _fit(place: Floats, time: Floats, change: Floats) -> tuple[Floats, Floats, int]:
    """Fit a linear spline of the position, and a drift with time, to each component.

    Return the residual and the spline's slope at each frame, (n, c), and the number of parameters.
    """
    count = int(np.clip(len(place) // _FRAMES_A_KNOT, *_KNOTS))
    low, high = float(place.min()), float(place.max())
    width = (high - low) / (count - 1) or 1.0
    along = np.clip((place - low) / width, 0, count - 1)
    knot = np.minimum(along.astype(np.intp), count - 2)
    spline = _LinearSpline(knot, along - knot, count)

    since = (time - time.mean())[:, None]
    of_change, of_since = spline.fit(change), spline.fit(since)
    bent = since - spline.at(of_since)  # part of the drift that is orthogonal to all splines
    drift = np.sum(bent * change, axis=0) / max(float(np.sum(bent * since)), 1e-300)
    line = of_change - of_since * drift
    slope = (line[knot + 1] - line[knot]) / width
    return change - spline.at(line) - since * drift, slope, count + 1


class _LinearSpline:
    """Least squares of linear splines; each frame has the index of its knot and its share of the next."""

    def __init__(self, knot: NDArray[np.intp], fraction: Floats, count: int) -> None:
        self._knot, self._near, self._next, self._count = knot, 1 - fraction, fraction, count
        diagonal = np.bincount(knot, self._near**2, count) + np.bincount(knot + 1, self._next**2, count)
        above = np.bincount(knot + 1, self._near * self._next, count)
        # A weak regularisation determines knots without frames.
        self._bands = np.stack([above - _STIFFNESS, diagonal + (2 + _STIFFNESS) * _STIFFNESS])

    def fit(self, values: Floats) -> Floats:
        """Return the splines' values at the knots, (count, c), for values at the frames, (n, c)."""
        from scipy.linalg import solveh_banded

        sums = [
            np.bincount(self._knot, self._near * value, self._count)
            + np.bincount(self._knot + 1, self._next * value, self._count)
            for value in values.T
        ]
        return np.asarray(solveh_banded(self._bands, np.stack(sums, axis=1)))

    def at(self, line: Floats) -> Floats:
        """Return the splines' values at the frames, (n, c)."""
        interpolated: Floats = (
            self._near[:, None] * line[self._knot] + self._next[:, None] * line[self._knot + 1]
        )
        return interpolated


def _error(delay: float, time: Floats, change: Floats, place: Callable[[Floats], Floats]) -> float:
    """Return the standard error of a delay; a frame is weighted by the rate of change of its picture."""
    step = 1e-3
    residual, slope, parameters = _fit(place(time - delay), time, change)
    speed = (place(time - delay + step) - place(time - delay - step)) / (2 * step)
    per_second = slope * speed[:, None]
    weight = np.sum(per_second**2, axis=1)
    late = np.sum(per_second * residual, axis=1)  # error of the frame in time, times its weight
    free = max(1, len(time) - parameters) / len(time)
    return math.sqrt(float(np.sum(late**2)) / free) / max(float(weight.sum()), 1e-300)
