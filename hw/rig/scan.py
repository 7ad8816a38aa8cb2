"""Base class of scans: checks, approach, references and retreat."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.references import read_reference
from mirrorskin.hw.base.rig_file import RigSettings
from mirrorskin.hw.base.stage import Position, Report
from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, Plan, RockPlan, TwistPlan, check_plan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.io.base.types import PROPERTIES, Block, Closing, Floats, Header, InputError

SETTLE = 0.1
"""Seconds from rest to the first exposure, of a motion with stops, by default."""

MARGIN = 0.3
"""Seconds of frames before and after a motion without stops."""

_RATE = 30.0  # assumed frames per second, before the rate of the camera is known
_DARK_FRAMES = 16

_UNKNOWN_DELAY = 0.2  # assumed maximum delay of frames, seconds, if it is unknown


class PlannedScan(Closing):
    """A scan before its rig is opened: a `mirrorskin.io.base.types.LiveSource` without frames.

    What cannot be done with the scan is refused with it before anything moves. Its header is that of the
    scan, with 0 in place of a dark reference that is still to be taken.

    Parameters
    ----------
    settings : RigSettings
    plan : Plan
    """

    rewindable = False

    def __init__(self, settings: RigSettings, plan: Plan) -> None:
        camera = settings.camera
        self.name, self.motion = settings.name, plan.motion
        if plan.in_steps:
            count = len(plan.distances)
        else:
            count = math.ceil((plan.path.duration + MARGIN) * (camera.rate or _RATE))
        self.shape, self.dtype = (count, *camera.shape), np.dtype(camera.dtype)
        header = make_header(settings, plan)
        dark = np.zeros(camera.shape, np.float32) if header.dark is None else header.dark
        self.header: Header = replace(header, dark=dark)

    def now(self) -> float:
        """Return 0."""
        return 0.0

    def positions(self) -> Mapping[str, Floats]:
        """Return an empty mapping."""
        return {}

    def rewind(self) -> None:
        """Raise: a live source cannot be rewound."""
        raise RuntimeError("a live source cannot be rewound")

    def read(self, out: NDArray[Any] | None = None, /) -> None:
        """Return None."""


class Scan(Closing):
    """A `mirrorskin.io.base.types.LiveSource`: the stage moves according to a plan while the camera records.

    Reading the header or entering the scan lifts the body, takes the references, and moves to the start of
    the scan. Leaving it without an error lifts the body again; leaving it during a move or by an error stops
    the stage. The rig must be closed by its owner.
    """

    rig: Rig
    plan: Plan
    name: str
    count: int
    dropped: int

    rewindable = False

    def __init__(self, rig: Rig, plan: Plan) -> None:
        self.rig, self.plan = rig, plan
        self.name, self.motion = rig.name, plan.motion
        self.dtype: np.dtype[Any] = rig.camera.dtype
        self.count = self.dropped = 0  # frames returned so far, and lost between them
        self._origin: float | None = None
        self._complete = False
        self._live: list[Floats] = []
        check_plan(plan, rig.settings.stage, rig.stage.name, rig.stage)

    @property
    def expected(self) -> int:
        """Expected number of frames."""
        raise NotImplementedError

    @property
    def rate(self) -> float:
        """Measured frames per second of the camera."""
        return self.rig.camera.counts.rate

    @property
    def remark(self) -> str:
        """Additional information for a summary line; often empty."""
        return ""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Expected frames, rows and columns."""
        return (self.expected, *self.rig.camera.shape)

    @functools.cached_property
    def header(self) -> Header:
        """Metadata of all frames; the first access prepares the scan."""
        header = make_header(self.rig.settings, self.plan)
        lifted = self.lift()
        if header.dark is None:
            late = max(_UNKNOWN_DELAY, self.rig.settings.camera.delay or 0.0) + self.rig.period
            header = replace(header, dark=take_dark(self.rig, lifted.time + late))
        self._prepare()
        return header

    def now(self) -> float:
        """Return the seconds since the first frame was requested, the scale of ``Block.time``."""
        return 0.0 if self._origin is None else self.rig.clock.now() - self._origin

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames so far; see ``LiveSource``."""
        return {self.plan.series: np.concatenate([self.plan.recorded(np.empty(0)), *self._live])}

    def rewind(self) -> None:
        """Raise: a live source cannot be rewound."""
        raise RuntimeError("a live source cannot be rewound")

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Return the next frames, at most ``len(out)``, as shared memory; None at the end of the plan."""
        if self._complete:
            return None
        if self._origin is None:
            _ = self.header
            self._origin = self.rig.clock.now()
        block = self._next(1 if out is None else len(out), self._origin)
        if block is None:
            self._complete = True
            return None
        self.count += len(block.frames)
        self.dropped += block.dropped
        self._live.append(getattr(block, self.plan.series))
        return block

    def lift(self) -> Report:
        """Set the body upright, lift it straight up to the end of its travel, and move it to the centre."""
        stage = self.rig.stage
        return self._visit(*stage.limits.retreat_path(stage.report().position))

    def close(self) -> None:
        """Lift the body; stop the stage if it is moving."""
        if self.rig.moving:
            self.rig.stage.stop()
        elif "header" in self.__dict__:  # otherwise it has not moved yet
            self.lift()

    def __enter__(self) -> Self:
        _ = self.header
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.rig.stage.stop()

    def _visit(self, *places: Position) -> Report:
        """Move to some positions in sequence, and return the final report of rest."""
        return [self.rig.go(place) for place in dict.fromkeys(places)][-1]

    def _next(self, limit: int, origin: float) -> Block | None:
        """Return the next frames, after waiting for the first if necessary."""
        raise NotImplementedError

    def _block(
        self, frames: NDArray[Any], arrival: Floats, place: Floats, dropped: int, origin: float
    ) -> Block:
        properties: dict[str, Any] = {self.plan.series: place}
        properties |= {name: np.full(len(frames), value) for name, value in self.plan.constants.items()}
        stays_valid = frames.flags.c_contiguous
        return Block(
            frames,
            self.count,
            arrival - origin,
            dropped=dropped,
            lateness=self._lateness,
            stays_valid=stays_valid,
            **properties,
        )

    @property
    def _lateness(self) -> float:
        """Seconds from an exposure to its arrival, 0 if unknown."""
        return self.rig.settings.camera.delay or 0.0

    def _prepare(self) -> None:
        """Move to the start of the scan, and wait there; the body leans only when it is pressed."""
        first = self.plan.first
        rests = self._visit(Position(first.travel), first).time
        if isinstance(self.plan, HorizontalPlan | TwistPlan):
            while self.rig.trigger is None and self.rig.take(1).time[-1] < rests + self.plan.wait:
                pass
            self._sleep_until(rests + self.plan.wait)

    def _sleep_until(self, due: float) -> None:
        self.rig.clock.sleep(max(0.0, due - self.rig.clock.now()))


def make_header(settings: RigSettings, plan: Plan) -> Header:
    """Return the metadata that are available before anything moves."""
    stage, camera = settings.stage, settings.camera
    header = Header(
        plan.motion,
        title=f"{settings.name}, {plan.motion} motion",
        start_time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        pixel_size=camera.pixel_sides,
        dark=read_reference(camera, "dark", settings.path),
        bright=read_reference(camera, "bright", settings.path),
        zenith_gain=_scalar(camera.counts_per_radian),
        zenith_offset=_scalar(camera.zenith_offset),
        camera=camera.name,
        **{
            name: getattr(getattr(settings, prop.of), name)
            for name, prop in PROPERTIES.items()
            if prop.in_steps or not plan.in_steps
        },
    )
    if isinstance(plan, AxialPlan):
        return replace(header, press=plan.press, tilt=plan.tilt, pivot=stage.pivot)
    if isinstance(plan, HorizontalPlan | TwistPlan):
        return replace(header, press=plan.press)
    if isinstance(plan, RockPlan):
        return replace(header, press=plan.press, pivot=stage.pivot)
    return header


def _scalar(value: float | None) -> Floats | None:
    return None if value is None else np.asarray(value, np.float64)


_OFF_TARGET = (0.02, 2e-3)  # tolerance of the position at rest, mm and rad


class StepScan(Scan):
    """A scan that is at rest for each frame; see ``Scan``.

    A frame is used if its exposure started after the body had settled. It arrives later by the camera's delay
    (0.2 s unless in the rig file, for a stream at least 0.2 s) and half an exposure. With a trigger in the
    rig file, each frame is triggered once the body has settled.

    Parameters
    ----------
    rig : Rig
    plan : Plan
        With steps.
    settle : float
        Seconds from rest to the first exposure.
    frames : int
        Frames at each position, 1 or more.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml")) as rig:  # doctest: +SKIP
    ...     with StepScan(rig, VerticalPlan(0.0, 1.5, step=0.1)) as scan:
    ...         scan.read().travel
    array([0.])
    """

    settle: float
    frames: int

    def __init__(self, rig: Rig, plan: Plan, settle: float = SETTLE, frames: int = 1) -> None:
        if not 0 <= settle < np.inf:
            raise InputError(f"a settling time of {settle} s is not possible: give 0 or more")
        if frames < 1:
            raise InputError(f"{frames} frames per step are not possible: give 1 or more")
        super().__init__(rig, plan)
        self.settle, self.frames = settle, frames
        self._values, self._places = plan.values, plan.places
        self._step = -1
        self._left = 0
        self._since = 0.0

    @property
    def expected(self) -> int:
        """Number of frames."""
        return len(self._values) * self.frames

    def _next(self, limit: int, origin: float) -> Block | None:
        if self._left == 0:
            if self._step + 1 == len(self._values):
                if self.rig.trigger is not None:
                    self.rig.trigger.check(wait=True)
                return None
            self._go_on()
        frames, arrival, dropped = self._take(min(limit, self._left))
        self._left -= len(frames)
        place = np.repeat(self._values[self._step : self._step + 1], len(frames), axis=0)
        return self._block(frames, arrival, place, dropped, origin)

    def _go_on(self) -> None:
        """Move to the next position, and compute the time after which frames show the settled body."""
        self._step += 1
        self._since = settle_at(self.rig, self._places[self._step], self.settle)
        self._left = self.frames

    def _take(self, limit: int) -> tuple[NDArray[Any], Floats, int]:
        """Take frames that are new enough; losses before the first frame of a position are ignored."""
        while True:
            taken = self.rig.take(limit)
            new = int(np.searchsorted(taken.time, self._since, side="right"))
            if new < len(taken.time):
                first = self._left == self.frames
                return taken.pixels[new:], taken.time[new:], 0 if first else taken.dropped


def settle_at(rig: Rig, place: Position, settle: float) -> float:
    """Move to a place, and return the arrival time after which frames show the settled body."""
    rest = rig.go(place)
    check_there(rest, place, rig.stage.name)
    if rig.trigger is not None:
        rig.clock.sleep(max(0.0, rest.time + settle - rig.clock.now()))
        return -math.inf
    camera = rig.settings.camera
    delay = camera.delay or 0.0
    if camera.delay is None or camera.streamed:
        delay = max(_UNKNOWN_DELAY, delay)
    exposure = rig.period if camera.exposure is None else camera.exposure
    rig.camera.flush()
    return rest.time + settle + delay + exposure / 2


def check_there(rest: Report, place: Position, name: str) -> None:
    """Refuse a stage that does not rest at its target."""
    off, turned = (
        max(abs(getattr(rest.position, motion) - getattr(place, motion)) for motion in motions)
        for motions in (("travel", "x", "y"), ("pitch", "roll", "twist"))
    )
    if off > _OFF_TARGET[0] or turned > _OFF_TARGET[1]:
        raise HardwareError(
            f"{name} rests {off:.3f} mm and {math.degrees(turned):.3f} degrees from its target: "
            "check its steps per mm, and whether something blocks it"
        )


def take_dark(rig: Rig, since: float, count: int = _DARK_FRAMES) -> NDArray[np.float32]:
    """Return the mean of some frames that arrived after a time, (H, W); there must be no contact."""
    total = np.zeros(rig.camera.shape)
    remaining = count
    if rig.trigger is not None:
        since = -math.inf
    rig.camera.flush()
    while remaining:
        frames = rig.take(remaining)
        new = frames.pixels[frames.time > since]
        total += new.sum(axis=0, dtype=np.float64)
        remaining -= len(new)
    return (total / count).astype(np.float32)
