"""A rig that the application drives: one thread moves the stage and reads the camera, anyone may stop it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.reconstruction import method_for
from mirrorskin.engine.live import LiveRun, Loop
from mirrorskin.engine.live.status import Status, Update
from mirrorskin.engine.live.touch import Taken, recordings_of, touch
from mirrorskin.engine.rotation.last_turn import choose_window
from mirrorskin.engine.rotation.rotation import Rotation
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import RigSettings, StageSettings
from mirrorskin.hw.base.stage import Position, Stage
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, Plan, RockPlan, TwistPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import PlannedScan
from mirrorskin.hw.rig.sweep import make_scan
from mirrorskin.hw.rig.touch import RigTouch
from mirrorskin.io.base.selection import Region
from mirrorskin.io.watch.saturation import scale_top

State = Literal["disconnected", "connecting", "ready", "moving"]

_SLOW = 0.1  # of an axis's speed, for moves by hand
_LOOK = 0.02  # seconds from one look at a move to the next
_MOST = 64  # frames that are taken at once
_WAIT = 0.5  # s at rest, pressed, before the body slides or twists
_JOIN = 30.0  # seconds that the thread may take to close the rig
_STOPPED = "The stage was stopped. Look at it, then connect again."


@dataclass(frozen=True)
class Seen:
    """What the rig shows: the newest frame, and the maps of a live run, or the surface of a touch."""

    frame: NDArray[Any] | None = None
    frames: int = 0
    rate: float = float("nan")
    update: Update | None = None
    status: Status | None = None
    surface: io.Result | None = None
    note: str = ""  # what a touch expects, and why it ended


class RigControl:
    """A rig behind buttons: connect, jog, lift, run, and stop, which works at any time.

    One thread opens the rig, moves the stage and reads the camera. Whatever ends it stops the stage if it
    moves: a fault, `stop`, `close`, or an error of this program. `stop` calls the stage from the caller's
    thread, also while the rig is being opened and homed; afterwards the rig must be connected again.

    Parameters
    ----------
    settings : RigSettings
    clock : Clock
    operation : type, optional
        Class of operations or methods for the runs; by default the method of the motion.

    Attributes
    ----------
    state : {"disconnected", "connecting", "ready", "moving"}
    problem : str
        Why the last request was refused or the rig was disconnected.
    seen : Seen
    result : Result or None
        That of the last run.
    recorded : Path or None
        The recording of the last run.
    stop_address : str
        An address at which a POST calls `stop`; empty without one.
    """

    def __init__(
        self,
        settings: RigSettings,
        clock: Clock = SYSTEM,
        operation: type[Operation | Method] | None = None,
    ) -> None:
        self.settings, self._clock, self._operation = settings, clock, operation
        self.state: State = "disconnected"
        self.problem = ""
        self.seen = Seen()
        self.result: io.Result | None = None
        self.recorded: Path | None = None
        self.stop_address = ""
        self._stage: Stage | None = None
        self._task: Callable[[Rig], None] | None = None
        self._stopping, self._closing = clock.event(), clock.event()
        self._thread: Any = None

    @property
    def position(self) -> Position | None:
        """Where the body stands; None if that is unknown."""
        stage = self._stage
        if stage is None:
            return None
        try:
            return stage.report().position
        except HardwareError:  # stopped, or lost; the thread finds out why
            return None

    def connect(self) -> None:
        """Open the rig; a stage that has switches is homed."""
        if self.state != "disconnected":
            return
        self._join()
        self._stopping, self._closing = self._clock.event(), self._clock.event()
        self._stage, self._task, self.problem, self.state = None, None, "", "connecting"
        self._thread = self._clock.thread(self._work, f"{self.settings.name}: application")
        self._thread.start()

    def stop(self) -> None:
        """Stop the stage at once; the rig is then disconnected."""
        self._stopping.set()
        if self._stage is not None:
            self._stage.stop()

    def close(self) -> None:
        """Stop what moves, and let the rig go."""
        self._closing.set()  # before the look at the state, so that no request can start in between
        if self.state in ("connecting", "moving"):
            self.stop()
        self._join()

    def jog(self, axis: str, by: float) -> None:
        """Move one axis slowly by some mm or radians, within its limits."""

        def task(rig: Rig) -> None:
            here = rig.stage.report().position
            place = replace(here, **{axis: getattr(here, axis) + by})
            self._go(rig, place, _SLOW * self.settings.stage.axes[axis].top_speed)

        self._give(task)

    def lift(self) -> None:
        """Set the body upright, lift it, and bring it to the middle."""

        def task(rig: Rig) -> None:
            for place in rig.stage.limits.retreat_path(rig.stage.report().position):
                self._go(rig, place, None)

        self._give(task)

    def run(self, plan: Plan, record: Path | None = None) -> None:
        """Move as planned, reconstruct meanwhile, and record if a file is given."""
        if self._can_write(record):
            self._give(lambda rig: self._run(rig, plan, record))

    def touch(
        self,
        sigma: float,
        share: float,
        press: float,
        tilt: float,
        record: Path | None = None,
        region: Region | None = None,
    ) -> None:
        """Press and turn until a share of the pixels has a standard deviation, mm; record if asked to."""

        def task(rig: Rig) -> None:
            self._touch(_WatchedTouch(self, rig, press, tilt=tilt), sigma, share, record, region)

        if self._can_write(record):
            self._give(task)

    def _can_write(self, record: Path | None) -> bool:
        """Return whether a recording can be written, if one is asked for; otherwise tell the problem."""
        if record is not None:
            try:
                io.check_output(record, replaces="nothing")
            except io.InputError as error:
                self.problem = str(error)
                return False
        return True

    def _give(self, task: Callable[[Rig], None]) -> None:
        if self.state != "ready" or self._task is not None:
            self.problem = "Connect first." if self.state == "disconnected" else "Wait until the stage rests."
            return
        self.problem, self._task = "", task

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(_JOIN)
            self._thread = None

    def _open_stage(self, settings: StageSettings) -> Stage:
        """Open the stage, which can be stopped from then on."""
        self._stage = rigs.open_stage(settings)
        if self._stopping.is_set():
            self._stage.stop()
        return self._stage

    def _work(self) -> None:
        """Open the rig, do the requested tasks, and close it; the thread."""
        try:
            with rigs.open_rig(self.settings, open_stage=self._open_stage) as rig:
                self.state = "ready"
                while not self._closing.is_set():
                    self._look(rig)
                    if self._task is not None:
                        self._do(rig, self._task)
        except Exception as error:
            named = str(error) if hasattr(error, "exit_code") else f"{type(error).__name__}: {error}"
            self.problem = _STOPPED if self._stopping.is_set() else named
        finally:
            self._stage, self._task, self.state = None, None, "disconnected"

    def _do(self, rig: Rig, task: Callable[[Rig], None]) -> None:
        self.state = "moving"
        try:
            self._check_ending()
            task(rig)
        except io.InputError as error:  # refused before anything moved, or the run has no result
            self.problem = str(error)
            rig.check()
        self._task = None
        self.state = "ready"

    def _go(self, rig: Rig, place: Position, speed: float | None) -> None:
        """Move to a place, and show what the camera sees meanwhile."""
        move = rig.begin(lambda: rig.stage.move(place, speed))
        while not move.join(_LOOK):
            self._look(rig)
        rig.end(move)

    def _look(self, rig: Rig) -> None:
        """Take the frames that wait, and keep the newest; raise what is wrong with the rig."""
        rig.check()
        if rig.stage.error is not None:
            raise rig.stage.error
        taken = rig.take(_MOST)
        self._show(rig, taken.pixels[-1].copy(), len(taken.pixels))

    def _show(self, rig: Rig, frame: NDArray[Any], count: int, **more: Any) -> None:
        self.seen = replace(
            self.seen,
            frame=frame,
            frames=self.seen.frames + count,
            rate=rig.camera.counts.rate,
            **more,
        )

    def _run(self, rig: Rig, plan: Plan, record: Path | None) -> None:
        self.result = self.recorded = None
        self.seen = replace(self.seen, update=None, status=None)
        scan = make_scan(rig, plan)
        self._live(PlannedScan(self.settings, plan), plan, rig.rate)  # refused before anything moves
        recorder = None if record is None else io.StreamRecorder(scan, record)
        source: io.LiveSource = scan if recorder is None else recorder

        def on_update(update: Update, status: Status) -> None:
            self._show(rig, update.picture, 1, update=update, status=status)

        with ExitStack() as stack:
            stack.enter_context(source)
            run = self._live(source, plan, rig.rate)
            run.precompile()
            mark = None if recorder is None else recorder.mark
            self._check_ending()
            Loop(source, run, on_update=on_update, stop=self._ending, mark=mark).run()
            self._check_ending()  # the scan then stops the stage, and does not lift the body
        self.recorded = None if recorder is None else recorder.path
        self.result = run.result()

    def _touch(
        self, sensor: RigTouch, sigma: float, share: float, record: Path | None, region: Region | None
    ) -> None:
        self.result = self.recorded = None
        self.seen = replace(self.seen, update=None, status=None, surface=None, note="")
        taken: list[Taken] = []

        def on_update(text: str, surface: io.Result | None) -> None:
            self.seen = replace(self.seen, note=text, surface=surface or self.seen.surface)

        try:
            with sensor:
                outcome = touch(sensor, sigma, share=share, region=region, taken=taken, on_update=on_update)
        finally:
            press, turn = recordings_of(sensor, taken)
            if record is not None and press is not None:
                io.save_touch(record, press, turn)
        self.result = outcome.result
        on_update(str(outcome), outcome.result)

    def _live(self, source: io.LiveSource, plan: Plan, rate: float) -> LiveRun:
        """Return the operation of the runs, with a window of one turn for the method of a rotation."""
        computed = (self._operation or method_for(plan.motion))()
        if not (isinstance(plan, AxialPlan) and isinstance(computed, Rotation)):
            return LiveRun(source, computed)
        window, every = choose_window(plan.frames_a_turn(rate))
        return LiveRun(source, computed.with_options(window_frames=window), every=every)

    def _ending(self) -> bool:
        return self._stopping.is_set() or self._closing.is_set()

    def _check_ending(self) -> None:
        """Raise after a stop, which the stage may not have obeyed yet, and while the rig is closed."""
        if self._ending():
            raise HardwareError(_STOPPED)


class _WatchedTouch(RigTouch):
    """A rig whose frames are shown, and whose touch ends when it is stopped."""

    def __init__(self, control: RigControl, rig: Rig, press: float, *, tilt: float) -> None:
        super().__init__(rig, press, tilt=tilt)
        self._control, self._watched = control, rig

    def take(self, travel: float, tilt: float = 0.0, phase: float = 0.0, /) -> NDArray[Any]:
        """Return a frame of the body at rest, and show it; HardwareError after a stop."""
        self._control._check_ending()
        frame = super().take(travel, tilt, phase)
        self._control._show(self._watched, frame, 1)
        return frame


def vertical_plan(start: float, stop: float, speed: float) -> Plan:
    """Return the plan of a press without a halt, mm and mm/s."""
    return VerticalPlan(start, stop, speed=speed)


def axial_plan(press: float, tilt: float, turns: float, rate: float) -> Plan:
    """Return the plan of a rotation without a halt: mm, radians, and turns per second."""
    return AxialPlan(press, tilt, turns, rate=rate)


def slide_plan(press: float, distance: float, direction: float, speed: float) -> Plan:
    """Return the plan of a slide without a halt: mm, radians, and mm/s."""
    return HorizontalPlan(press, distance, direction, speed=speed, wait=_WAIT)


def twist_plan(press: float, angle: float, speed: float) -> Plan:
    """Return the plan of a twist without a halt: mm, radians, and radians per second."""
    return TwistPlan(press, angle, speed=speed, wait=_WAIT)


def rock_plan(press: float, tilt: float, phase: float, speed: float) -> Plan:
    """Return the plan of rocking without a halt: mm, radians, and radians per second."""
    return RockPlan(press, tilt, phase, speed=speed)


@dataclass(frozen=True)
class Judged:
    """What a frame shows of exposure and focus.

    Attributes
    ----------
    saturated : float
        Share of the pixels at the end of the scale.
    sharpness : float
        Standard deviation of the Laplacian, counts: the sharper the picture, the larger.
    counts, edges : ndarray
        Histogram of the brightness.
    """

    saturated: float
    sharpness: float
    counts: NDArray[np.int64]
    edges: NDArray[np.float64]


def judge(frame: NDArray[Any], bins: int = 64) -> Judged:
    """Return exposure and focus of a frame.

    Examples
    --------
    >>> judge(np.full((4, 4), 255, np.uint8)).saturated
    1.0
    """
    import cv2

    full_scale = float(np.iinfo(frame.dtype).max) if frame.dtype.kind == "u" else float(np.nanmax(frame))
    values = np.nan_to_num(frame.astype(np.float32))
    counts, edges = np.histogram(values, bins, (0.0, max(full_scale, 1e-9)))
    top = scale_top(float(values.max()), frame.dtype.kind == "u")
    saturated = 0.0 if top is None else float(np.mean(values >= top))
    return Judged(saturated, float(cv2.Laplacian(values, cv2.CV_32F).std()), counts, edges)
