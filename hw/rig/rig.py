"""A stage and a camera as one unit: a fault of either stops the stage."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, cast

from mirrorskin.hw.base.camera import Camera, Frames
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.drivers import STAGES, Driver, built_in, camera_driver, stage_driver
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.base.stage import Position, Report, Stage
from mirrorskin.hw.rig.trigger import Trigger, no_trigger
from mirrorskin.io import InputError
from mirrorskin.io.base.types import Closing

_TICK = 0.02  # interval of the guard's checks, seconds
_PAUSE = 0.5  # delay of the guard after which the times of frames are unknown, seconds
_STALL_PERIODS = 3  # minimum tolerance without a frame during a move, in periods
_UNTIMED = 3  # factor of the tolerance if the times of frames do not matter
_SLICE = 0.05  # interval at which a waiting reader checks for faults, seconds
_PATIENCE = 5.0  # seconds until the first frame
_JOIN = 5.0


class Move:
    """A move of the stage in progress; a thread waits for its end.

    In a `timed` move the positions of frames follow from their arrival times.
    """

    timed: bool
    reconnects: int
    began: float
    ended: float

    def __init__(self, stage: Stage, clock: Clock, began: float, timed: bool, reconnects: int) -> None:
        self._stage, self._clock, self.timed, self.reconnects = stage, clock, timed, reconnects
        self.began, self.ended = began, math.inf  # time at which rest was reported, seconds of time.monotonic
        self.error: Exception | None = None  # reason why it did not finish
        self.rest: Report | None = None  # report of rest at the end
        self._over = clock.event()
        self._thread = clock.thread(self._wait, f"{stage.name}: waits")
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether it has ended, successfully or not."""
        return self._over.is_set()

    def join(self, timeout: float) -> bool:
        """Wait for its end, at most for a timeout, and return whether it has ended."""
        return self._over.wait(timeout)

    def close(self) -> None:
        """Wait for the thread, after the stage was stopped or came to rest."""
        self._thread.join(_JOIN)

    def _wait(self) -> None:
        try:
            self.rest = self._stage.wait()
        except Exception as error:  # passed to the reader; see Rig.check
            self._stage.stop()
            self.error = error
        self.ended = self._clock.now()
        self._over.set()


class Rig(Closing):
    """A guarded stage and camera. A context manager: leaving it for any reason first stops the stage.

    During a move a thread checks fifty times per second whether frames arrive and whether stage and camera
    report faults. On a fault it stops the stage, even if all other threads are busy, and all later calls of
    the rig raise the reason. The timeout for frames is ``camera.stall`` or three periods, whichever is
    longer, and three times that in steps and during the approach, where arrival times do not matter. If the
    computer is too busy for these checks, the timeout is extended. If the guard does not run for 0.5 s in a
    timed move, the times of frames are unknown, and the move ends. Only moves started by the rig are guarded.

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
        self.trigger: Trigger | None = None  # takes frames one by one, if the rig file has a trigger
        if settings.camera.trigger is not None:
            self.trigger = Trigger(stage, camera, settings.camera, self.check, clock)
        self._looked = -math.inf  # time of the guard's last check
        self._closing = clock.event()
        self._guard = clock.thread(self._watch, f"{self.name}: guard")
        self._guard.start()

    @property
    def rate(self) -> float:
        """Frames per second: measured, or from the rig file."""
        measured = self.camera.counts.rate
        nominal = self.settings.camera.rate
        return measured if math.isfinite(measured) and measured > 0 else nominal or math.nan

    @property
    def period(self) -> float:
        """Frame period, seconds; 0 if unknown."""
        rate = self.rate
        return 1 / rate if math.isfinite(rate) else 0.0

    @property
    def moving(self) -> bool:
        """Whether a move is in progress."""
        return self._move is not None and not self._move.over

    def check(self) -> None:
        """Raise the fault of stage or camera, if any; the stage has then been stopped."""
        move = self._move
        if self._fault is None and move is not None and move.error is not None:
            if not isinstance(move.error, HardwareError):
                raise move.error
            self._fault = move.error
        if self._fault is not None:
            raise self._fault

    def begin(self, move: Callable[[], None], timed: bool = False) -> Move:
        """Call `move`, which starts a motion of the stage, and return it in progress; see `Move`."""
        self.check()
        if self.trigger is None and self.camera.latest == -math.inf:
            self.take(1)  # a camera that is still starting must not count as lost
        began, reconnects = self.clock.now(), self.camera.counts.reconnects
        move()
        self._move = Move(self.stage, self.clock, began, timed, reconnects)
        return self._move

    def end(self, move: Move) -> Report:
        """Wait until a move is over, and return the report of rest; HardwareError if the rig failed."""
        while not move.join(_SLICE):
            self.check()
        while move.timed and self._looked < move.ended and self._guard.is_alive():
            self.clock.sleep(_TICK)
        self.check()
        if move.rest is None:
            raise HardwareError(f"{self.stage.name} did not report its final position: check its cable")
        return move.rest

    def go(self, place: Position, speed: float | None = None) -> Report:
        """Move the body to a place and wait until it rests there; see ``end``."""
        return self.end(self.begin(lambda: self.stage.move(place, speed)))

    def take(self, limit: int) -> Frames:
        """Take waiting frames, or wait for one, as ``Camera.take``; HardwareError if the rig failed.

        With a trigger, one frame is triggered.
        """
        if self.trigger is not None:
            return self.trigger.expose()
        until = self.clock.now() + _PATIENCE
        while True:
            self.check()
            try:
                return self.camera.take(limit, _SLICE + 2 * self.period)
            except HardwareError:
                self.check()
                if self.camera.error is not None or self.clock.now() > until:
                    raise

    def close(self) -> None:
        """Stop the stage if it moves, and close everything."""
        self._leave(self.moving)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._leave(kind is not None or self.moving)

    def _leave(self, stop: bool) -> None:
        with ExitStack() as leaving:  # in reverse order, and completely even if something fails
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
        """Guard: stop the stage on a fault during a move."""
        looked, newest, silence, last = self._move, -math.inf, 0.0, self.clock.now()
        while not self._closing.wait(_TICK):
            # If the guard is late, the computer is busy, and the camera's thread may be late as well.
            passed, last = self.clock.now() - last, self.clock.now()
            move, latest = self._move, self.camera.latest
            paused = passed > _PAUSE and move is not None and move.timed and move.ended > last - passed
            if move is None or (move.over and not paused):
                self._looked = last
                continue
            if move is not looked or latest != newest:
                looked, newest, silence = move, latest, 0.0
            else:
                silence += _TICK if passed < 2 * _TICK else _TICK / 2
            fault = _paused(passed) if paused else self._fault_after(move, silence)
            if fault is not None:
                # before the stop, which would otherwise be reported as the cause
                self._fault = self._fault or fault
                self.stage.stop()
                return
            self._looked = last

    def _fault_after(self, move: Move, silence: float) -> HardwareError | None:
        """Return the fault of a move after some seconds without a frame."""
        wrong = self.stage.error or self.camera.error
        if wrong is not None:
            return wrong
        if move.timed and self.camera.counts.reconnects > move.reconnects:
            return HardwareError(
                f"{self.camera.name} was lost while the stage moved, so it was stopped; the "
                "camera is back, but the delay of its frames may have changed: start again"
            )
        bound = longest_wait(self.settings.camera, self.period) * (1 if move.timed else _UNTIMED)
        if self.trigger is not None or silence < bound:
            return None
        return HardwareError(
            f"{self.camera.name} delivered no frame for {silence:.2f} s while the stage moved, so "
            "it was stopped: check its cable and the load of the computer"
        )


def longest_wait(settings: CameraSettings, period: float) -> float:
    """Return the maximum time without a frame during a move, seconds, from the frame period."""
    return max(settings.stall, _STALL_PERIODS * period)


def _paused(seconds: float) -> HardwareError:
    return HardwareError(
        f"this program was paused for {seconds:.2f} s while the stage moved, so it was stopped: "
        "the times of the frames are unknown. End other programs, or move in steps (--step or"
        " --phase-step), which a pause does not disturb"
    )


def open_stage(settings: StageSettings, unlock: bool = False, clock: Clock = SYSTEM) -> Stage:
    """Open the stage that a rig file describes.

    With `unlock`, a GRBL controller's alarm, hold or open door is ended. InputError for other controllers,
    which have none; if the class or the stage does not exist; or if the stage does not match the file. A
    stage class of the user has its own clock.
    """
    driver = stage_driver(settings.firmware)
    if unlock and "unlock" not in driver.takes:
        titles = " or ".join(driver.title for driver in built_in(STAGES) if "unlock" in driver.takes)
        raise InputError(
            f"stage {settings.port}: only {titles} can be unlocked; switch this controller off and on"
        )
    return cast("Stage", _open(driver, settings, Stage, {"unlock": unlock, "clock": clock}))


def open_camera(settings: CameraSettings, clock: Clock = SYSTEM) -> Camera:
    """Open the camera that a rig file describes; InputError if it is missing or does not match."""
    camera = cast("Camera", _open(camera_driver(settings.source), settings, Camera, {"clock": clock}))
    frames, stated = (
        f"{shape[1]} x {shape[0]}, {dtype}"
        for shape, dtype in ((camera.shape, camera.dtype), (settings.shape, settings.dtype))
    )
    if frames != stated:
        camera.close()
        raise InputError(
            f"{settings.name}: frames are {frames}, but camera.size and dtype in the rig file are {stated}:"
            " correct the rig file"
        )
    return camera


def _open(
    driver: Driver,
    settings: StageSettings | CameraSettings,
    protocol: type[Stage] | type[Camera],
    options: Mapping[str, Any],
) -> Stage | Camera:
    """Open a stage or a camera with those of the options that its class takes."""
    device_class, what = driver.load(), protocol.__name__.lower()
    options = {name: options[name] for name in driver.takes}
    try:
        inspect.signature(device_class).bind(settings, **options)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{driver}(settings) failed: {error}; a {what} class takes one argument, the"
            f" {type(settings).__name__}"
        ) from None
    try:
        device = device_class(settings, **options)
    except OSError as error:  # includes SerialException
        source = "stage.port" if what == "stage" else "camera.source"
        raise InputError(f"{driver}: cannot be opened: {error}; check {source}") from None
    lacking = [name for name in vars(protocol) if name[0] != "_" and not hasattr(device, name)]
    if lacking:
        if hasattr(device, "close"):
            device.close()
        raise InputError(
            f"{driver} has no {', no '.join(lacking)}: mirrorskin.hw.{protocol.__name__} lists the methods of"
            f" a {what}"
        )
    return cast("Stage | Camera", device)


def open_rig(
    settings: RigSettings,
    steps: bool = False,
    *,
    clock: Clock = SYSTEM,
    open_stage: Callable[[StageSettings], Stage] = open_stage,
    open_camera: Callable[[CameraSettings], Camera] = open_camera,
) -> Rig:
    """Open the stage and the camera that a rig file describes, and wait for the first frame.

    With a trigger there is no first frame; `steps` states that only a ``StepScan`` will follow.

    A stage with switches is homed, because a controller does not report whether it was homed or only
    unlocked. InputError if a device is missing, in use, or does not match the file; HardwareError if no frame
    arrives.
    """
    if settings.camera.trigger is not None and not steps:
        raise untriggered(settings)
    if settings.camera.trigger is not None and not stage_driver(settings.stage.firmware).outputs:
        raise no_trigger(f"stage {settings.stage.port}")
    with ExitStack() as opening:
        camera = open_camera(settings.camera)
        opening.callback(camera.close)
        if settings.camera.trigger is None:
            camera.take(1, _PATIENCE)
        stage = open_stage(settings.stage)
        opening.callback(stage.close)
        if settings.camera.trigger is not None and not hasattr(stage, "switch"):
            raise no_trigger(stage.name)
        if settings.stage.home:
            stage.home()
        rig = Rig(stage, camera, settings, clock)
        opening.pop_all()
    return rig


def untriggered(settings: RigSettings) -> InputError:
    """Return the error of operations that need continuous frames."""
    return InputError(
        f"{settings.path}: camera.trigger works only for captures in steps: give --step or "
        "--phase-step, or remove it from the rig file"
    )
