"""The calibration move: there and back, from which the camera's delay follows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.grbl.moves import SLOWEST
from mirrorskin.hw.rig.delay import Delay, block_means, estimate_delay
from mirrorskin.hw.rig.plans import AxialPlan, Plan, Trapezoid
from mirrorskin.hw.rig.rig import Move, Rig
from mirrorskin.hw.rig.track import Track, even_times
from mirrorskin.hw.rig_file import Axis
from mirrorskin.hw.stage import Position
from mirrorskin.io.types import Floats

_SECONDS = 1.5  # one way, or more
_FRAMES, _MOST_FRAMES = 60, 150  # one way, at least and at most
_PRESSED = 0.5  # share of a press that comes before the move
_LONGEST_DELAY = 0.6  # seconds that late frames are waited for
_BLOCK = 8  # frames
_STEADY = 1.3  # ratio of residuals of one line to lines near each frame, of a camera that keeps time
_SPEED_MARGIN = 0.9  # of an axis's greatest speed; as much above its least


@dataclass(frozen=True, slots=True)
class _Way:
    """From one place to another, and how far along it a place is."""

    begin: Position
    end: Position
    length: float
    along: Callable[[Position], float]
    fastest: float
    slowest: float


def measure_delay(rig: Rig, plan: Plan) -> Delay:
    """Move there and back in contact, and find out how late the camera's frames come.

    A press goes over the deeper half of its way; a rotation leans from phase 0 to the opposite one. Each way
    takes 1.5 s or 60 frames, whichever is longer, as far as the stage goes so slowly. The delay is that
    against the stage's reports: what these are late by themselves is part of it, as it should be.
    """
    way = _way(rig, plan)
    rests = rig.go(way.begin).time
    seconds = max(_SECONDS, _FRAMES * rig.period)
    speed = min(max(way.length / seconds, way.slowest), way.fastest)
    seconds = way.length / speed
    every = max(1, math.floor(seconds * rig.rate / _MOST_FRAMES))
    _FrameLog(rig, every).until(rests + _LONGEST_DELAY)  # earlier frames may show the way to there
    log = _FrameLog(rig, every)
    there = log.follow(rig.begin(lambda: rig.stage.move(way.end, speed)))
    back = log.follow(rig.begin(lambda: rig.stage.move(way.begin, speed)))
    log.until(back.ended + _LONGEST_DELAY)

    path = Trapezoid.planned(way.length, speed)
    turned = (there.ended + back.began) / 2
    down = _track(rig, way.along, path, there.began, turned)
    up = _track(rig, lambda place: way.length - way.along(place), path, back.began, back.ended)

    def place(times: Floats) -> Floats:
        return np.where(times < turned, down.at(times), way.length - up.at(times))

    clock, unsure = log.clock()
    delay = estimate_delay(clock, np.concatenate(log.pictures), place, rig.camera.name)
    rig.go(plan.first)
    of_reports = [one.spread / one.path.speed / math.sqrt(one.reports) / 2 for one in (down, up)]
    return replace(delay, error=math.hypot(delay.error, unsure, *of_reports))


def _way(rig: Rig, plan: Plan) -> _Way:
    stage = rig.settings.stage
    if isinstance(plan, AxialPlan):
        begin, end = plan.place(0.0), plan.place(math.pi)
        return _Way(begin, end, 2 * plan.tilt, lambda place: plan.tilt - place.pitch, *_speeds(stage.pitch))
    length = (1 - _PRESSED) * (plan.stop - plan.start)
    first, end = plan.stop - length, Position(plan.stop)
    return _Way(Position(first), end, length, lambda place: place.travel - first, *_speeds(stage.travel))


def _speeds(axis: Axis | None) -> tuple[float, float]:
    """Return how fast and how slowly an axis may go, mm/s or rad/s."""
    if axis is None:  # cannot be: what does not lean does not go round
        return math.inf, 0.0
    return _SPEED_MARGIN * axis.top_speed, SLOWEST / 60 / axis.scale / _SPEED_MARGIN


def _track(
    rig: Rig, along: Callable[[Position], float], path: Trapezoid, since: float, until: float
) -> Track:
    reports = [report for report in rig.stage.history(since) if report.time <= until]
    return Track([report.time for report in reports], [along(report.position) for report in reports], path)


class _FrameLog:
    """Frames of the move, of which only block means are kept."""

    def __init__(self, rig: Rig, every: int) -> None:
        self._rig, self._every = rig, every
        self._times: list[Floats] = []
        self._numbers: list[NDArray[np.int64]] = []
        self.pictures: list[Floats] = []

    def clock(self) -> tuple[Floats, float]:
        """Return when the frames arrived, (n,), seconds, and the standard error of all of them together.

        If the camera keeps time, that is taken from a straight line through all of them.
        """
        number, time = np.concatenate(self._numbers), np.concatenate(self._times)
        line = even_times(number, time, len(time))
        off, near_off = (np.std(time - even) for even in (line, even_times(number, time)))
        if off > _STEADY * near_off:
            return time, 0.0
        return line, float(off / math.sqrt(len(time)))

    def follow(self, move: Move) -> Move:
        """Watch until a move is over."""
        while not move.over:
            self._take()
        self._rig.end(move)
        return move

    def until(self, time: float) -> None:
        """Watch until frames arrive later than a time."""
        while self._take() < time:
            pass

    def _take(self) -> float:
        frames = self._rig.take(_BLOCK)
        some = frames.number % self._every == 0
        self._times.append(frames.time[some])
        self._numbers.append(frames.number[some])
        self.pictures.append(block_means(frames.pixels[some]))
        return float(frames.time[-1])
