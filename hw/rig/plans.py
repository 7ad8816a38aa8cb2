"""Plans of scans: the trajectory of the body, in steps or continuous, and checks of its feasibility."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mirrorskin.hw.base.drivers import stage_driver
from mirrorskin.hw.base.rig_file import StageSettings
from mirrorskin.hw.base.stage import Position, Stage
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io import InputError
from mirrorskin.io.base.types import Floats, Motion

_STEPS_MAX = 10**6
_TURNS_MAX = 10_000
_STROKES_MAX = 10_000
_ROUNDING = 1e-9  # of a step


class Plan:
    """A scan; see `VerticalPlan`, `AxialPlan`, `HorizontalPlan`, `TwistPlan` and `RockPlan`.

    A position is described by the distance that the body has travelled along its trajectory: mm or
    radians.
    """

    __slots__ = ()
    motion: ClassVar[Motion]
    # name of each frame's position in a recording: travel, phase, displacement, twist or tilt
    series: ClassVar[str]

    @property
    def step(self) -> float | None:
        """Distance between two positions of a scan in steps, mm or radians; otherwise None."""
        raise NotImplementedError

    @property
    def speed(self) -> float | None:
        """Speed of a continuous scan, mm/s or rad/s; otherwise None."""
        raise NotImplementedError

    @property
    def length(self) -> float:
        """Length of the trajectory, mm or radians."""
        raise NotImplementedError

    def place(self, distance: float) -> Position:
        """Return the position of the body after a distance."""
        raise NotImplementedError

    def recorded(self, distances: Floats) -> Floats:
        """Return the recorded value after some distances, (n,) or (n, 2), mm or radians."""
        raise NotImplementedError

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the distance of a position; of several, the one closest to the expected distance."""
        raise NotImplementedError

    @property
    def in_steps(self) -> bool:
        """Whether the scan is in steps."""
        return self.step is not None

    @property
    def distances(self) -> Floats:
        """Distance at each step, (n,)."""
        assert self.step is not None
        return np.asarray(self.step * np.arange(_whole(self.length / self.step) + 1), np.float64)

    @property
    def path(self) -> Trapezoid:
        """Trajectory of a continuous scan."""
        assert self.speed is not None
        return Trapezoid.planned(self.length, self.speed)

    @property
    def ends(self) -> list[Position]:
        """End points of the straight moves of a continuous scan."""
        return [self.place(self.length)]

    def begin(self, stage: Stage) -> None:
        """Start the continuous motion of a stage that is at the first position."""
        stage.follow(self.ends, self.speed)

    @property
    def period(self) -> float:
        """Distance after which the trajectory repeats."""
        return math.inf

    @property
    def constants(self) -> dict[str, float]:
        """Recorded values that are the same for all frames, by the name of the series."""
        return {}

    @property
    def first(self) -> Position:
        """First position."""
        return self.place(0.0)

    @property
    def values(self) -> Floats:
        """Recorded value of each step, (n,) or (n, 2)."""
        return self.recorded(self.distances)

    @property
    def places(self) -> list[Position]:
        """Position of the body at each step."""
        return [self.place(float(distance)) for distance in self.distances]

    def _check(self, unit: str) -> None:
        _check_one_of(("step", self.step, unit), ("speed", self.speed, f"{unit}/s"))
        if self.step is not None:
            _check_steps(self.length / self.step, 1)


@dataclass(frozen=True, slots=True)
class VerticalPlan(Plan):
    """Lower the body from one travel to another; with several strokes, oscillate between them.

    Impossible values are an `InputError`.

    Attributes
    ----------
    start, stop : float
        First travel, and travel at the end of the first stroke, mm; the second is deeper.
    step : float or None
        Distance between positions, mm, in a scan in steps; a stroke ends at the last position that is not
        beyond `stop`.
    speed : float or None
        Speed of a continuous scan, mm/s. Either `step` or `speed` is given.
    strokes : int
        Number of strokes down or up, at most 10 000; the first stroke goes down.

    Examples
    --------
    >>> VerticalPlan(0.0, 1.0, step=0.5).values
    array([0. , 0.5, 1. ])
    >>> VerticalPlan(0.0, 1.0, step=0.5, strokes=3).values.tolist()
    [0.0, 0.5, 1.0, 0.5, 0.0, 0.5, 1.0]
    """

    start: float
    stop: float
    step: float | None = None
    speed: float | None = None
    strokes: int = 1
    motion: ClassVar[Motion] = "vertical"
    series: ClassVar[str] = "travel"

    def __post_init__(self) -> None:
        _check_number(self.start, "start", "mm")
        _check_number(self.stop, "stop", "mm")
        if not self.stop > self.start:
            raise InputError(
                f"a press from {self.start:g} to {self.stop:g} mm does not go down: give a deeper stop"
            )
        if not 1 <= self.strokes <= _STROKES_MAX:
            raise InputError(f"{self.strokes} strokes are not possible: give 1 to {_STROKES_MAX}")
        self._check("mm")

    @property
    def length(self) -> float:
        """Total length of all strokes, mm."""
        return self.strokes * self._depth

    @property
    def path(self) -> Trapezoid:
        """Trajectory of a continuous scan: a leg for each stroke."""
        assert self.speed is not None
        return Trapezoid.planned(self.length, self.speed, self.strokes)

    @property
    def period(self) -> float:
        """Length of a stroke down and one up, mm."""
        return math.inf if self.strokes == 1 else 2 * self._depth

    @property
    def ends(self) -> list[Position]:
        """Turning points and end."""
        return [Position(self.start if number % 2 else self.stop) for number in range(self.strokes)]

    def place(self, distance: float) -> Position:
        """Return the position of the body after a distance."""
        return Position(travel=float(self.recorded(np.asarray(distance))))

    def recorded(self, distances: Floats) -> Floats:
        """Return the travel, (n,), mm."""
        number = np.clip(distances // self._depth, 0, self.strokes - 1)
        along = distances - number * self._depth
        return np.asarray(self.start + np.where(number % 2, self._depth - along, along))

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the distance travelled, mm, in the stroke closest to the expected distance."""
        depth = min(max(position.travel - self.start, 0.0), self._depth)
        number = np.arange(self.strokes)
        distances = np.where(number % 2, (number + 1) * self._depth - depth, number * self._depth + depth)
        return float(distances[np.argmin(abs(distances - expected))])

    @property
    def _depth(self) -> float:
        """Length of a stroke, mm."""
        depth = self.stop - self.start
        return depth if self.step is None else self.step * _whole(depth / self.step)


@dataclass(frozen=True, slots=True)
class HorizontalPlan(Plan):
    """Press, wait, and slide along a straight line.

    Impossible values are an `InputError`.

    Attributes
    ----------
    press : float
        Travel at which the body slides, mm.
    distance : float
        Length of the slide, mm, above 0.
    direction : float
        Radians from x, counter-clockwise: y is at pi/2.
    step : float or None
        Distance between positions, mm, in a scan in steps.
    speed : float or None
        Speed of a continuous scan, mm/s. Either `step` or `speed` is given.
    wait : float
        Seconds at rest, pressed, before it slides.

    Examples
    --------
    >>> HorizontalPlan(1.0, 0.5, step=0.25).values.tolist()
    [[0.0, 0.0], [0.25, 0.0], [0.5, 0.0]]
    """

    press: float
    distance: float
    direction: float = 0.0
    step: float | None = None
    speed: float | None = None
    wait: float = 0.0
    motion: ClassVar[Motion] = "horizontal"
    series: ClassVar[str] = "displacement"

    def __post_init__(self) -> None:
        _check_number(self.press, "press", "mm")
        _check_number(self.direction, "direction", "radians")
        _check_above_zero(self.distance, "distance", "mm")
        _check_wait(self.wait)
        self._check("mm")

    @property
    def length(self) -> float:
        """Length of the slide, mm."""
        return self.distance

    def place(self, distance: float) -> Position:
        """Return the position of the body after a distance."""
        x, y = distance * self._along
        return Position(self.press, x=float(x), y=float(y))

    def recorded(self, distances: Floats) -> Floats:
        """Return the displacement, (n, 2), mm."""
        return distances[:, np.newaxis] * self._along

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the distance of the slide so far, mm."""
        return min(max(float(np.dot((position.x, position.y), self._along)), 0.0), self.length)

    @property
    def _along(self) -> Floats:
        """Unit vector of the direction; right angles are exact, so that no other axis moves."""
        return np.round([math.cos(self.direction), math.sin(self.direction)], 15) + 0.0


@dataclass(frozen=True, slots=True)
class TwistPlan(Plan):
    """Press, wait, and turn the body about its own axis; impossible values are an `InputError`.

    Attributes
    ----------
    press : float
        Travel at which the body turns, mm.
    angle : float
        Angle, radians, counter-clockwise if positive; not 0.
    step : float or None
        Angle between positions, radians, above 0, in a scan in steps.
    speed : float or None
        Speed of a continuous scan, rad/s. Either `step` or `speed` is given.
    wait : float
        Seconds at rest, pressed, before it turns.

    Examples
    --------
    >>> TwistPlan(1.0, -0.5, step=0.25).values.tolist()
    [-0.0, -0.25, -0.5]
    """

    press: float
    angle: float
    step: float | None = None
    speed: float | None = None
    wait: float = 0.0
    motion: ClassVar[Motion] = "twist"
    series: ClassVar[str] = "twist"

    def __post_init__(self) -> None:
        _check_number(self.press, "press", "mm")
        if not (math.isfinite(self.angle) and self.angle):
            raise InputError(f"angle {self.angle:g} radians is not possible: give one that is not 0")
        _check_wait(self.wait)
        self._check("radians")

    @property
    def length(self) -> float:
        """Absolute value of the angle, radians."""
        return abs(self.angle)

    def place(self, distance: float) -> Position:
        """Return the position of the body after an angle."""
        return Position(self.press, twist=math.copysign(distance, self.angle))

    def recorded(self, distances: Floats) -> Floats:
        """Return the twist, (n,), radians."""
        return np.copysign(distances, self.angle)

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the angle so far, radians."""
        return min(max(math.copysign(1.0, self.angle) * position.twist, 0.0), self.length)


@dataclass(frozen=True, slots=True)
class AxialPlan(Plan):
    """Press, lean, and precess: the body's axis rotates from phase 0 on, counter-clockwise.

    Impossible values are an `InputError`.

    Attributes
    ----------
    press : float
        Travel during the rotation, mm.
    tilt : float
        Half-angle of the cone, radians, above 0.
    turns : float
        Number of turns, above 0, at most 10 000.
    phase_step : float or None
        Angle between positions, radians, in a scan in steps; the end of the turns is not a position.
    rate : float or None
        Rate of a continuous scan, turns per second. Either `phase_step` or `rate` is given.

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
    motion: ClassVar[Motion] = "axial"
    series: ClassVar[str] = "phase"

    def __post_init__(self) -> None:
        _check_number(self.press, "press", "mm")
        _check_above_zero(self.tilt, "tilt", "radians")
        _check_above_zero(self.turns, "turns", "")
        if self.turns > _TURNS_MAX:
            raise InputError(f"{self.turns:g} turns are too many: the maximum is {_TURNS_MAX}")
        _check_one_of(("phase step", self.phase_step, "radians"), ("rate", self.rate, "turns/s"))
        if self.phase_step is not None:
            _check_steps(self.length / self.phase_step, 3)

    @property
    def step(self) -> float | None:
        """The phase step, radians."""
        return self.phase_step

    @property
    def speed(self) -> float | None:
        """The rate in rad/s."""
        return None if self.rate is None else math.tau * self.rate

    @property
    def length(self) -> float:
        """Phase of all turns, radians."""
        return math.tau * self.turns

    @property
    def period(self) -> float:
        """A whole turn."""
        return math.tau

    @property
    def distances(self) -> Floats:
        """Phase of each step, (n,), radians."""
        assert self.phase_step is not None
        # The end of whole turns is their start; a step that ends before it is included.
        count = math.ceil(self.length / self.phase_step - _ROUNDING)
        return np.asarray(self.phase_step * np.arange(count), np.float64)

    @property
    def ends(self) -> list[Position]:
        """Empty: the motion is a precession."""
        return []

    def begin(self, stage: Stage) -> None:
        """Start the precession of a stage that leans at phase 0."""
        stage.precess(self.tilt, self.turns, self.rate or 0.0)

    def frames_a_turn(self, frame_rate: float, each: int = 1) -> float:
        """Return the number of frames in a turn, or in the only, incomplete one.

        A continuous scan requires the camera's frame rate, Hz; in steps, each position has `each` frames.
        """
        if self.phase_step is not None:
            turn = math.tau / self.phase_step * each
        else:
            turn = frame_rate / (self.rate or math.inf)
            if not math.isfinite(turn) or turn <= 0:
                raise InputError(
                    "the number of frames per turn is unknown: give the camera's rate in the rig file"
                )
        return turn * min(1.0, self.turns)

    def place(self, distance: float) -> Position:
        """Return the position of the body at a phase, radians."""
        return Position(self.press, self.tilt * math.cos(distance), self.tilt * math.sin(distance))

    def recorded(self, distances: Floats) -> Floats:
        """Return the phase, (n,), radians."""
        return distances

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the phase without jumps, radians."""
        return position.phase + math.tau * round((expected - position.phase) / math.tau)


@dataclass(frozen=True, slots=True)
class RockPlan(Plan):
    """Press, lean, and rock about one axis: from a tilt on one side to the same tilt on the other.

    Impossible values are an `InputError`.

    Attributes
    ----------
    press : float
        Travel at which the body rocks, mm.
    tilt : float
        Maximum half-angle, radians, above 0; the scan starts at its negative.
    phase : float
        Phase of the lean at positive tilts, radians, as in a precession.
    step : float or None
        Angle between positions, radians, in a scan in steps.
    speed : float or None
        Speed of a continuous scan, rad/s. Either `step` or `speed` is given.

    Examples
    --------
    >>> RockPlan(1.0, 0.04, step=0.02).values.round(3).tolist()
    [-0.04, -0.02, 0.0, 0.02, 0.04]
    """

    press: float
    tilt: float
    phase: float = 0.0
    step: float | None = None
    speed: float | None = None
    motion: ClassVar[Motion] = "axial"
    series: ClassVar[str] = "tilt"

    def __post_init__(self) -> None:
        _check_number(self.press, "press", "mm")
        _check_number(self.phase, "phase", "radians")
        _check_above_zero(self.tilt, "tilt", "radians")
        self._check("radians")

    @property
    def length(self) -> float:
        """Angle from one side to the other, radians."""
        return 2 * self.tilt

    @property
    def constants(self) -> dict[str, float]:
        """The phase."""
        return {"phase": self.phase}

    def place(self, distance: float) -> Position:
        """Return the position of the body after an angle."""
        tilt = distance - self.tilt
        return Position(self.press, tilt * math.cos(self.phase), tilt * math.sin(self.phase))

    def recorded(self, distances: Floats) -> Floats:
        """Return the tilt, (n,), radians."""
        return distances - self.tilt

    def distance_of(self, position: Position, expected: float) -> float:
        """Return the angle so far, radians."""
        tilt = position.pitch * math.cos(self.phase) + position.roll * math.sin(self.phase)
        return min(max(tilt + self.tilt, 0.0), self.length)


def _whole(steps: float) -> int:
    """Return the number of whole steps, including a last one that rounding shortened."""
    return math.floor(steps + _ROUNDING * max(1.0, steps))


def _check_number(value: float, name: str, unit: str) -> None:
    if not math.isfinite(value):
        raise InputError(f"{name} {value} {unit} is not possible: give a finite number")


def _check_above_zero(value: float, name: str, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} {value:g} {unit}".rstrip() + " cannot be: give more than 0")


def _check_wait(seconds: float) -> None:
    if not 0 <= seconds < math.inf:
        raise InputError(f"a wait of {seconds:g} s is not possible: give 0 or more")


def _check_one_of(*both: tuple[str, float | None, str]) -> None:
    choices = [(name, value, unit) for name, value, unit in both if value is not None]
    if len(choices) != 1:
        (step, _, _), (speed, _, _) = both
        raise InputError(f"give either a {step}, for a scan in steps, or a {speed}, for a continuous one")
    name, value, unit = choices[0]
    _check_above_zero(value, name, unit)


def _check_steps(count: float, minimum: int) -> None:
    if not minimum - _ROUNDING <= count <= _STEPS_MAX:
        raise InputError(
            f"{count:.3g} steps are not possible: {minimum} to {_STEPS_MAX} are; change the step or "
            "the distance"
        )


def check_plan(plan: Plan, settings: StageSettings, name: str, stage: Stage | None = None) -> None:
    """Refuse a plan that a stage cannot execute: limits, speeds, or axes without arcs.

    The body is lowered at x, y and twist 0, and lifted straight up from the end of the scan, so the approach
    and the retreat are within the limits if both ends of the scan are. An open stage also knows the limits of
    its controller.
    """
    from mirrorskin.hw.stages.moves import Axes

    limits = settings.limits if stage is None else stage.limits
    for place in (plan.first, *plan.ends):
        limits.check(place, name)
    if plan.in_steps:  # moves between steps use the maximum speed
        return
    driver = stage_driver(settings.firmware)
    if stage is None and driver.motion == "steps":  # before it is homed unnecessarily
        raise InputError(f"{name}: {driver.title} does not report its position while it moves; use steps")
    if stage is None and driver.motion != "continuous":  # checked when the stage is open
        return
    able = Axes(settings, name) if stage is None else stage
    if isinstance(plan, AxialPlan):  # one turn suffices for the check
        able.check_precession(plan.tilt, min(plan.turns, 1.0), plan.rate or 0.0)
    else:
        able.check_move(plan.first, plan.ends[0], plan.speed)
