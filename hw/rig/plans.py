"""What a scan is to do: where the body goes, in steps or without a halt, and whether it may."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.hw.rig_file import StageSettings
from mirrorskin.hw.stage import Position
from mirrorskin.io import InputError
from mirrorskin.io.types import Floats

_RAMP = 0.1  # seconds in which a stage is taken to reach its speed, as long as nothing else is known
_STEPS_MAX = 10**6
_TURNS_MAX = 10_000
_ROUNDING = 1e-9  # of a step


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """A way that begins and ends at rest: the speed rises evenly, stays, and falls as it rose."""

    length: float  # mm or radians, above 0
    speed: float  # in the middle, mm/s or rad/s; not reached on a short way
    acceleration: float

    @classmethod
    def planned(cls, length: float, speed: float) -> Trapezoid:
        """Guess the acceleration, of which a plan says nothing."""
        return cls(length, speed, speed / _RAMP)

    @property
    def ramp(self) -> float:
        """Seconds that speeding up takes."""
        return min(self.speed, math.sqrt(self.length * self.acceleration)) / self.acceleration

    @property
    def duration(self) -> float:
        """Seconds for the whole way."""
        return self.length / (self.acceleration * self.ramp) + self.ramp

    def place(self, time: ArrayLike) -> Floats:
        """Return where it is so many seconds after the beginning; before that and at the end, it rests."""
        t = np.clip(np.asarray(time, np.float64), 0, self.duration)
        left = self.duration - t
        up, down = np.minimum(t, self.ramp), np.minimum(left, self.ramp)
        cruise = self.acceleration * self.ramp * (t - self.ramp / 2)
        early, late = self.acceleration / 2 * up**2, self.length - self.acceleration / 2 * down**2
        return np.where(t < self.ramp, early, np.where(left < self.ramp, late, cruise))

    def time(self, place: ArrayLike) -> Floats:
        """Return when it is at a place, seconds after the beginning; the inverse of ``place``."""
        s = np.clip(np.asarray(place, np.float64), 0, self.length)
        ramp_end = self.acceleration / 2 * self.ramp**2
        early = np.sqrt(2 * s / self.acceleration)
        late = self.duration - np.sqrt(2 * (self.length - s) / self.acceleration)
        cruise = s / (self.acceleration * self.ramp) + self.ramp / 2
        return np.where(s < ramp_end, early, np.where(self.length - s < ramp_end, late, cruise))


@dataclass(frozen=True, slots=True)
class VerticalPlan:
    """Lower the body from one travel to another; values that cannot be are an `InputError`.

    Attributes
    ----------
    start, stop : float
        First and last travel, mm; the second lies deeper.
    step : float or None
        From place to place, mm, where it goes in steps; the last place is the last that is not beyond `stop`.
    speed : float or None
        Where it goes without a halt, mm/s. Either `step` or `speed` is given.

    Examples
    --------
    >>> VerticalPlan(0.0, 1.0, step=0.5).values
    array([0. , 0.5, 1. ])
    """

    start: float
    stop: float
    step: float | None = None
    speed: float | None = None
    motion: ClassVar[Literal["vertical"]] = "vertical"

    def __post_init__(self) -> None:
        _check_number(self.start, "start", "mm")
        _check_number(self.stop, "stop", "mm")
        if not self.stop > self.start:
            raise InputError(
                f"a press from {self.start:g} to {self.stop:g} mm does not go down: give a deeper stop"
            )
        _check_one_of(("step", self.step, "mm"), ("speed", self.speed, "mm/s"))
        if self.step is not None:
            _check_steps((self.stop - self.start) / self.step, 1)

    @property
    def in_steps(self) -> bool:
        """Whether the body halts for each frame."""
        return self.step is not None

    @property
    def first(self) -> Position:
        """Where the scan begins."""
        return Position(travel=self.start)

    @property
    def values(self) -> Floats:
        """Travel of each step, (n,), mm."""
        assert self.step is not None
        count = _whole((self.stop - self.start) / self.step) + 1
        return np.asarray(self.start + self.step * np.arange(count), np.float64)

    @property
    def places(self) -> list[Position]:
        """Where the body stands at each step."""
        return [Position(travel=float(travel)) for travel in self.values]

    @property
    def path(self) -> Trapezoid:
        """The way without a halt, from 0 at the start, mm."""
        assert self.speed is not None
        return Trapezoid.planned(self.stop - self.start, self.speed)


@dataclass(frozen=True, slots=True)
class AxialPlan:
    """Press, lean, and go round: the body's axis precesses, from phase 0 on, counter-clockwise.

    Values that cannot be are an `InputError`.

    Attributes
    ----------
    press : float
        Travel at which the body goes round, mm.
    tilt : float
        Half-angle of the cone, radians, above 0.
    turns : float
        How often it goes round, above 0, at most 10 000 times.
    phase_step : float or None
        From place to place, radians, where it goes in steps; the end of the turns is no place of its own.
    rate : float or None
        Where it goes without a halt, turns a second. Either `phase_step` or `rate` is given.

    Examples
    --------
    >>> AxialPlan(1.0, math.radians(2.5), phase_step=math.pi / 4).values.shape
    (8,)
    """

    press: float
    tilt: float
    turns: float = 1.0
    phase_step: float | None = None
    rate: float | None = None
    motion: ClassVar[Literal["axial"]] = "axial"

    def __post_init__(self) -> None:
        _check_number(self.press, "press", "mm")
        _check_above_zero(self.tilt, "tilt", "radians")
        _check_above_zero(self.turns, "turns", "")
        if self.turns > _TURNS_MAX:
            raise InputError(f"{self.turns:g} turns are too many: go round {_TURNS_MAX} times at most")
        _check_one_of(("phase step", self.phase_step, "radians"), ("rate", self.rate, "turns/s"))
        if self.phase_step is not None:
            _check_steps(math.tau * self.turns / self.phase_step, 3)

    @property
    def in_steps(self) -> bool:
        """Whether the body halts for each frame."""
        return self.phase_step is not None

    @property
    def first(self) -> Position:
        """Where the scan begins: pressed, and leaning at phase 0."""
        return self.place(0.0)

    @property
    def values(self) -> Floats:
        """Phase of each step, (n,), radians."""
        assert self.phase_step is not None
        # The end of whole turns is their beginning; a step that ends short of it is taken.
        count = math.ceil(math.tau * self.turns / self.phase_step - _ROUNDING)
        return np.asarray(self.phase_step * np.arange(count), np.float64)

    @property
    def places(self) -> list[Position]:
        """Where the body stands at each step."""
        return [self.place(float(phase)) for phase in self.values]

    @property
    def path(self) -> Trapezoid:
        """The way without a halt, from phase 0, radians."""
        assert self.rate is not None
        return Trapezoid.planned(math.tau * self.turns, math.tau * self.rate)

    def frames_a_turn(self, frame_rate: float, each: int = 1) -> float:
        """Return how many frames a turn has, or what there is of the only one.

        Without a halt the camera's frame rate, Hz, must be known; in steps, each place has `each` frames.
        """
        if self.phase_step is not None:
            turn = math.tau / self.phase_step * each
        else:
            turn = frame_rate / (self.rate or math.inf)
            if not math.isfinite(turn) or turn <= 0:
                raise InputError(
                    "how many frames a turn has is not known: give the camera's rate in the rig file"
                )
        return turn * min(1.0, self.turns)

    def place(self, phase: float) -> Position:
        """Return where the body stands at a phase, radians."""
        return Position(self.press, self.tilt * math.cos(phase), self.tilt * math.sin(phase))


Plan = VerticalPlan | AxialPlan


def _whole(steps: float) -> int:
    """Return how many whole steps there are; a last one that rounding shortened counts."""
    return math.floor(steps + _ROUNDING * max(1.0, steps))


def _check_number(value: float, name: str, unit: str) -> None:
    if not math.isfinite(value):
        raise InputError(f"{name} {value} {unit} cannot be: give a finite number")


def _check_above_zero(value: float, name: str, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} {value:g} {unit}".rstrip() + " cannot be: give more than 0")


def _check_one_of(*both: tuple[str, float | None, str]) -> None:
    given = [(name, value, unit) for name, value, unit in both if value is not None]
    if len(given) != 1:
        (step, _, _), (speed, _, _) = both
        raise InputError(f"give either a {step}, to go in steps, or a {speed}, to go without a halt")
    name, value, unit = given[0]
    _check_above_zero(value, name, unit)


def _check_steps(count: float, least: int) -> None:
    if not least - _ROUNDING <= count <= _STEPS_MAX:
        raise InputError(
            f"{count:.3g} steps cannot be: {least} to {_STEPS_MAX} are possible; change the step or the way"
        )


def check_plan(plan: Plan, stage: StageSettings, name: str) -> None:
    """Refuse a plan that a stage cannot do: beyond its limits, too fast or slow, no axes for arcs."""
    from mirrorskin.hw.grbl.moves import Axes

    for place in (plan.first,) if isinstance(plan, AxialPlan) else (plan.first, Position(plan.stop)):
        stage.limits.check(place, name)
    if plan.in_steps:  # moves between steps go as fast as the axes do
        return
    axes = Axes(stage, name)
    if isinstance(plan, AxialPlan):
        # One turn is as possible as many, wherever the work coordinates begin.
        axes.arcs(plan.tilt, min(plan.turns, 1.0), plan.rate or 0.0, 0.0, axes.machine(Position()))
    else:
        axes.straight(plan.first, Position(plan.stop), plan.speed)
