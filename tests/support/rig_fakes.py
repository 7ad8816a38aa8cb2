"""A fake stage and a fake camera that obey at once, without threads or a twin."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

import numpy as np

from mirrorskin.hw.base.camera import Counts, Frames
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import (
    CameraSettings,
    RigSettings,
    ShiftAxis,
    StageSettings,
    TiltAxis,
    TravelAxis,
    TwistAxis,
)
from mirrorskin.hw.base.stage import Limits, Position, Report
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.stages.moves import Axes
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

LIMITS = Limits((-5.0, 3.0), 0.1, 2.0, (-1.0, 1.0), (-1.0, 1.0), (-0.5, 0.5))
PERIOD = 0.05  # seconds between reports


def settings(shape=(8, 8), **camera):
    degrees = math.degrees(0.1)
    pitch, roll = (
        TiltAxis(letter=letter, limits=(-degrees, degrees), speed=math.degrees(20.0)) for letter in "XY"
    )
    stage = StageSettings(
        port="none",
        timeout=1.0,
        home=False,
        press=2.0,
        pivot=(0.0, 0.0, 0.0),
        travel=TravelAxis(letter="Z", limits=(-5.0, 3.0), speed=20.0),
        pitch=pitch,
        roll=roll,
        x=ShiftAxis(letter="A", limits=(-1.0, 1.0), speed=20.0),
        y=ShiftAxis(letter="B", limits=(-1.0, 1.0), speed=20.0),
        twist=TwistAxis(letter="C", limits=(-math.degrees(0.5), math.degrees(0.5)), speed=600.0),
    )
    eye = CameraSettings(**{"source": 0, "size": shape[::-1], **camera})
    return RigSettings(Path("rig.toml"), "fake", stage, eye)


class FakeStage:
    """Goes along trapezoids, exactly; what it reports is rounded as GRBL does."""

    name = "fake stage"
    axes = Axes(settings().stage, name)
    check_move, check_precession = axes.check_move, axes.check_precession

    def __init__(self, clock, limits=LIMITS, acceleration=100.0, late=0.0, seed=0):
        self.clock, self.limits = clock, limits
        self.error = None
        self.stops, self.closed = [], False
        self.moves = []
        self._acceleration = acceleration
        self._late, self._random = late, np.random.default_rng(seed)
        self._start = self.clock.now()
        self._reports = []
        self._legs = [(self._start, None, lambda moved: Position(-1.0, 0.0, 0.0))]

    def position(self, at=None):
        at = self.clock.now() if at is None else at
        if self.stops:
            at = min(at, self.stops[0])
        began, path, place = [leg for leg in self._legs if leg[0] <= at or leg is self._legs[0]][-1]
        return place(0.0 if path is None else float(path.place(at - began)))

    def moving(self):
        began, path, _ = self._legs[-1]
        return not self.stops and path is not None and self.clock.now() < began + path.duration

    def move(self, place, speed=None):
        self.follow([place], speed)

    def follow(self, places, speed=None):
        for place in places:
            self.limits.check(place, self.name)
            self.moves.append(place)
            self._straight(place, speed)

    def _straight(self, place, speed):
        start = np.array(astuple(self.position(math.inf)))
        gap = np.array(astuple(place)) - start
        shift = np.linalg.norm(gap[[0, 3, 4]])
        length = float(shift if shift else np.linalg.norm(gap))
        if length == 0:
            return
        self._add(length, speed or 100.0, lambda moved: Position(*(start + gap * moved / length)))

    def precess(self, tilt, turns, rate, start=0.0):
        travel = self.position(math.inf).travel

        def place(moved):
            return Position(travel, tilt * math.cos(start + moved), tilt * math.sin(start + moved))

        self._add(math.tau * turns, math.tau * rate, place)

    def wait(self, timeout=None):
        began, path, _ = self._legs[-1]
        while path is not None and self.clock.now() < began + path.duration + PERIOD / 2:
            self.clock.sleep(0.002)
            if self.error is not None:
                raise self.error
            if self.stops:
                raise HardwareError("fake stage was stopped")
        return Report(self.clock.now(), self.position(), "idle")

    def report(self):
        if self.error is not None:
            raise self.error
        return Report(self.clock.now(), self.position(), "run" if self.moving() else "idle")

    def history(self, since=-math.inf):
        while (due := self._start + len(self._reports) * PERIOD) < self.clock.now() - 0.002:
            place = self.position(due)
            reported = due + float(
                np.clip(self._late * self._random.standard_normal(), -PERIOD / 3, PERIOD / 3)
            )
            rounded = np.round(astuple(place), 6)
            self._reports.append(Report(reported, Position(*map(float, rounded)), "run"))
        return [report for report in self._reports if since < report.time]

    def stop(self):
        self.stops.append(self.clock.now())

    def close(self):
        self.closed = True

    def _add(self, length, speed, place):
        path = Trapezoid(length, speed, self._acceleration * speed)
        began, last, _ = self._legs[-1]
        begins = max(self.clock.now() + 0.01, began + (0.0 if last is None else last.duration))
        self._legs = [*self._legs, (begins, path, place)]


class FakeCamera:
    """Shows `picture(position)` at the time of each exposure; its frames come late, and unevenly."""

    name = "fake camera"
    dtype = np.dtype(np.uint8)

    def __init__(
        self,
        clock,
        where: Callable[[float], Position],
        picture: Callable[[Position], np.ndarray],
        rate=200.0,
        delay=0.0,
        jitter=0.0,
        seed=0,
    ):
        self.clock, self._where, self._picture = clock, where, picture
        self.shape = picture(Position()).shape
        self._rate, self._delay, self._jitter = rate, delay, jitter
        self._random = np.random.default_rng(seed)
        self._start = self.clock.now()
        self._next, self._last, self._dropped = 0, -math.inf, 0
        self._silent = math.inf
        self.reconnects = 0
        self.error = None
        self.closed = False

    @property
    def counts(self):
        return Counts(self._next, 0, 0, self._rate, self.reconnects)

    @property
    def latest(self):
        now = min(self.clock.now(), self._silent)
        return self._start + math.floor((now - self._start) * self._rate) / self._rate

    def stall(self):
        self._silent = self.clock.now()

    def lose(self):
        self.error = HardwareError("fake camera was lost: look at its cable")
        self.stall()

    def flush(self):
        self._next = max(self._next, math.ceil((self.clock.now() - self._start - self._delay) * self._rate))

    def take(self, limit, timeout):
        if self.error is not None:
            raise self.error
        until = self.clock.now() + timeout
        due = self._start + self._next / self._rate + self._delay
        self.clock.sleep(max(0.0, min(due + 4 * self._jitter, until) - self.clock.now()))
        count = math.floor((min(self.clock.now(), self._silent) - due) * self._rate + 1e-6) + 1
        if count < 1:
            self.clock.sleep(max(0.0, until - self.clock.now()))
            raise HardwareError("fake camera: no frame")
        number = np.arange(self._next, self._next + min(limit, count))
        self._next += len(number)
        exposed = self._start + number / self._rate
        arrival = exposed + self._delay + self._jitter * self._random.standard_normal(len(number))
        arrival = np.maximum.accumulate(np.maximum(arrival, self._last))
        self._last = arrival[-1]
        pixels = np.stack([self._picture(self._where(float(instant))) for instant in exposed])
        return Frames(pixels, number, arrival, 0)

    def close(self):
        self.closed = True


def fake_rig(picture, clock=None, *, late=0.0, seed=0, delay=0.0, stated=None, **camera):
    """Open a rig of both on a simulated clock; `stated` are settings of the camera in its file."""
    clock = clock or SimulatedClock()
    stage = FakeStage(clock, late=late, seed=seed)
    eye = FakeCamera(clock, stage.position, picture, delay=delay, seed=seed, **camera)
    return Rig(stage, eye, settings(eye.shape, **{"delay": delay, **(stated or {})}), clock)


def spreading(shape=(32, 32), steepness=0.05):
    """Return a picture of light that spreads with travel, and moves with the lean."""
    y, x = np.mgrid[: shape[0], : shape[1]] / shape[0]

    def picture(place):
        edge = np.hypot(x - 0.5 - 2 * place.pitch, y - 0.5 - 2 * place.roll) - 0.5 * place.travel
        return (255 / (1 + np.exp(np.clip(edge / steepness, -50, 50)))).astype(np.uint8)

    return picture
