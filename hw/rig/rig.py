"""A stage and a camera as one: whatever goes wrong with either, the stage stops."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import cast

from mirrorskin.hw.camera import Camera, Frames
from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.rig.trigger import Trigger
from mirrorskin.hw.rig_file import CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.stage import Position, Report, Stage
from mirrorskin.io import InputError
from mirrorskin.io.own_class import load_class
from mirrorskin.io.types import Closing

_TICK = 0.02  # seconds from one look of the guard to the next
_PAUSE = 0.5  # seconds that the guard may be late: frames that come meanwhile have no time
_STALL_PERIODS = 3  # without a frame, that a move bears at least
_UNTIMED = 3  # times as long a silence is borne where it does not matter when frames came
_SLICE = 0.05  # seconds that the reader waits before it looks whether all is well
_PATIENCE = 5.0  # seconds that a camera may take for its first frame
_JOIN = 5.0


class Move:
    """A move of the stage that is under way, begun at a time; a thread waits for its end.

    Of one that is `timed`, frames' arrivals tell where the body was.
    """

    timed: bool
    reconnects: int
    began: float
    ended: float

    def __init__(self, stage: Stage, clock: Clock, began: float, timed: bool, reconnects: int) -> None:
        self._stage, self._clock, self.timed, self.reconnects = stage, clock, timed, reconnects
        self.began, self.ended = began, math.inf  # when it was known to rest, seconds of time.monotonic
        self.error: Exception | None = None  # why it did not come to its end
        self.rest: Report | None = None  # where it came to rest
        self._over = clock.event()
        self._thread = clock.thread(self._wait, f"{stage.name}: waits")
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether it has ended, well or not."""
        return self._over.is_set()

    def join(self, timeout: float) -> bool:
        """Wait for its end, at most so many seconds, and return whether it came."""
        return self._over.wait(timeout)

    def close(self) -> None:
        """Wait for the thread, of a stage that was stopped or rests."""
        self._thread.join(_JOIN)

    def _wait(self) -> None:
        try:
            self.rest = self._stage.wait()
        except Exception as error:  # handed to whoever reads; see Rig.check
            self._stage.stop()
            self.error = error
        self.ended = self._clock.now()
        self._over.set()


class Rig(Closing):
    """Stage and camera, guarded. A context manager: leaving it, for whatever reason, stops the stage first.

    While a move is under way a thread looks fifty times a second whether frames still arrive and whether
    stage and camera are well. If not, it stops the stage, also while everyone else is busy, and whoever asks
    the rig for anything gets the reason. Frames are missed after ``camera.stall`` or three periods, whichever
    is longer, and three times that in steps and on the way to the start, where arrival times do not
    matter; a computer that is too busy to look that often gives the camera more time. If it does not look
    for 0.5 s in a timed move, when frames came is not known, and the move ends. Only moves that the rig
    begins are guarded.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml")) as rig:  # doctest: +SKIP
    ...     rig.go(Position(travel=1.0))
    """

    stage: Stage
    camera: Camera
    settings: RigSettings

    def __init__(self, stage: Stage, camera: Camera, settings: RigSettings, clock: Clock = SYSTEM) -> None:
        self.stage, self.camera, self.settings, self.clock = stage, camera, settings, clock
        self.name: str = settings.name
        self._move: Move | None = None
        self._fault: HardwareError | None = None
        self.trigger: Trigger | None = None  # what takes frames one by one, if the rig file says so
        if settings.camera.trigger is not None:
            self.trigger = Trigger(stage, camera, settings.camera, self.check, clock)
        self._looked = -math.inf  # when the guard last did
        self._closing = clock.event()
        self._guard = clock.thread(self._watch, f"{self.name}: guard")
        self._guard.start()

    @property
    def rate(self) -> float:
        """Frames a second: as measured, or as the rig file says."""
        measured = self.camera.counts.rate
        said = self.settings.camera.rate
        return measured if math.isfinite(measured) and measured > 0 else said or math.nan

    @property
    def period(self) -> float:
        """Seconds from frame to frame; 0 as long as nobody knows."""
        rate = self.rate
        return 1 / rate if math.isfinite(rate) else 0.0

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""
        return self._move is not None and not self._move.over

    def check(self) -> None:
        """Raise what went wrong with stage or camera, if anything did; the stage was stopped then."""
        move = self._move
        if self._fault is None and move is not None and move.error is not None:
            if not isinstance(move.error, HardwareError):
                raise move.error
            self._fault = move.error
        if self._fault is not None:
            raise self._fault

    def begin(self, move: Callable[[], None], timed: bool = False) -> Move:
        """Tell the stage to move by calling `move`, and return while it does; see `Move`."""
        self.check()
        if self.trigger is None and self.camera.latest == -math.inf:
            self.take(1)  # a camera that is still starting is not missed later
        began, reconnects = self.clock.now(), self.camera.counts.reconnects
        move()
        self._move = Move(self.stage, self.clock, began, timed, reconnects)
        return self._move

    def end(self, move: Move) -> Report:
        """Wait until a move is over, and return where the body rests; HardwareError if the rig failed."""
        while not move.join(_SLICE):
            self.check()
        while move.timed and self._looked < move.ended and self._guard.is_alive():
            self.clock.sleep(_TICK)
        self.check()
        if move.rest is None:
            raise HardwareError(f"{self.stage.name} did not say where it came to rest: look at its cable")
        return move.rest

    def go(self, place: Position, speed: float | None = None) -> Report:
        """Move the body to a place and wait until it rests there; see ``end``."""
        return self.end(self.begin(lambda: self.stage.move(place, speed)))

    def take(self, most: int) -> Frames:
        """Take the frames that wait, or wait for one, as ``Camera.take``; HardwareError if the rig failed.

        Of a rig with a trigger, one frame is triggered.
        """
        if self.trigger is not None:
            return self.trigger.expose()
        until = self.clock.now() + _PATIENCE
        while True:
            self.check()
            try:
                return self.camera.take(most, _SLICE + 2 * self.period)
            except HardwareError:
                self.check()
                if self.camera.error is not None or self.clock.now() > until:
                    raise

    def close(self) -> None:
        """Stop the stage if it moves, and let go of everything."""
        self._leave(self.moving)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._leave(kind is not None or self.moving)

    def _leave(self, stop: bool) -> None:
        with ExitStack() as leaving:  # the last is done first, and all of it whatever fails
            leaving.callback(self.camera.close)
            leaving.callback(self.stage.close)
            leaving.callback(self._end_threads)
            if stop:
                self.stage.stop()

    def _end_threads(self) -> None:
        self._closing.set()
        self._guard.join()
        if self._move is not None:
            self._move.close()

    def _watch(self) -> None:
        """Guard: stop the stage when something is wrong while it moves."""
        looked, seen, silence, last = self._move, -math.inf, 0.0, self.clock.now()
        while not self._closing.wait(_TICK):
            # A guard that woke late means a busy machine, on which the camera's thread may be late as well.
            passed, last = self.clock.now() - last, self.clock.now()
            move, latest = self._move, self.camera.latest
            paused = passed > _PAUSE and move is not None and move.timed and move.ended > last - passed
            if move is None or (move.over and not paused):
                self._looked = last
                continue
            if move is not looked or latest != seen:
                looked, seen, silence = move, latest, 0.0
            else:
                silence += _TICK if passed < 2 * _TICK else _TICK / 2
            fault = _paused(passed) if paused else self._fault_after(move, silence)
            if fault is not None:
                self._fault = self._fault or fault  # first, or the stop would pass for the cause
                self.stage.stop()
                return
            self._looked = last

    def _fault_after(self, move: Move, silence: float) -> HardwareError | None:
        """Return what is wrong with a move after so many seconds without a frame."""
        wrong = self.stage.error or self.camera.error
        if wrong is not None:
            return wrong
        if move.timed and self.camera.counts.reconnects > move.reconnects:
            return HardwareError(
                f"{self.camera.name} was lost while the stage moved, which was stopped; it is back, and its"
                " frames may be later than before: begin anew"
            )
        bound = longest_wait(self.settings.camera, self.period) * (1 if move.timed else _UNTIMED)
        if self.trigger is not None or silence < bound:
            return None
        return HardwareError(
            f"{self.camera.name} gave no frame for {silence:.2f} s while the stage moved, which was stopped:"
            " look at its cable and its load"
        )


def longest_wait(settings: CameraSettings, period: float) -> float:
    """Return the seconds without a frame that a move bears, of a camera with a frame each period."""
    return max(settings.stall, _STALL_PERIODS * period)


def _paused(seconds: float) -> HardwareError:
    return HardwareError(
        f"this program stood still for {seconds:.2f} s while the stage moved, which was stopped: when frames"
        " came is not known; let nothing pause it, and run less beside it"
    )


def open_stage(settings: StageSettings, unlock: bool = False, clock: Clock = SYSTEM) -> Stage:
    """Open the stage that a rig file describes, of whatever firmware.

    With `unlock`, a GRBL controller's alarm, hold or open door is ended; InputError for others, which have
    none, and if there is no such class or stage, or it is not what the file says. A stage of
    the user's own class has a clock of its own.
    """
    firmware = settings.firmware
    if firmware == "grbl":
        from mirrorskin.hw.grbl.stage import GrblStage

        return GrblStage(settings, unlock=unlock, clock=clock)
    if unlock:
        raise InputError(f"stage {settings.port}: only GRBL is unlocked; switch this one off and on")
    if firmware == "marlin":
        from mirrorskin.hw.marlin.stage import MarlinStage

        return MarlinStage(settings, clock=clock)
    return _open_own(settings)


def _open_own(settings: StageSettings) -> Stage:
    """Open a stage of the user's own class."""
    name = settings.firmware
    made = load_class(name)
    try:
        inspect.signature(made).bind(settings)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}(settings) cannot be made: {error}; a stage's class takes one argument, the StageSettings"
        ) from error
    try:
        stage = made(settings)
    except OSError as error:  # a SerialException is one
        raise InputError(f"{name}: cannot be opened: {error}; look at stage.port") from error
    lacking = [one for one in vars(Stage) if one[0] != "_" and not hasattr(stage, one)]
    if lacking:
        if hasattr(stage, "close"):
            stage.close()
        raise InputError(
            f"{name} has no {', no '.join(lacking)}: mirrorskin.hw.stage.Stage lists what a stage has"
        )
    return cast("Stage", stage)


def open_camera(settings: CameraSettings, clock: Clock = SYSTEM) -> Camera:
    """Open the camera that a rig file describes; InputError if it is not there, or not what the file says."""
    if settings.genicam:
        from mirrorskin.hw.genicam import GenicamCamera

        return GenicamCamera(settings, clock=clock)
    from mirrorskin.hw.video import VideoCamera

    return VideoCamera(settings, clock=clock)


def open_rig(
    settings: RigSettings,
    steps: bool = False,
    *,
    clock: Clock = SYSTEM,
    open_stage: Callable[[StageSettings], Stage] = open_stage,
    open_camera: Callable[[CameraSettings], Camera] = open_camera,
) -> Rig:
    """Open the stage and the camera that a rig file describes, and wait for the first frame.

    With a trigger in the rig file there is none yet: `steps` promises that only a ``StepScan`` follows.

    A stage that the file says to have switches is homed, since a controller does not tell whether it was,
    or was only unlocked. InputError if one of them is missing, busy, or not what the file says; HardwareError
    if no frame came.
    """
    if settings.camera.trigger is not None and not steps:
        raise untriggered(settings)
    with ExitStack() as opening:
        camera = open_camera(settings.camera)
        opening.callback(camera.close)
        if settings.camera.trigger is None:
            camera.take(1, _PATIENCE)
        stage = open_stage(settings.stage)
        opening.callback(stage.close)
        if settings.stage.home:
            stage.home()
        rig = Rig(stage, camera, settings, clock)
        opening.pop_all()
    return rig


def untriggered(settings: RigSettings) -> InputError:
    """Return the refusal of what needs frames all the time."""
    return InputError(
        f"{settings.path}: camera.trigger takes frames of a capture in steps, and of nothing else: give"
        " --step or --phase-step, or leave it out"
    )
