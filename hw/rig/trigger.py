"""Triggered frames: an output of the controller is switched on for each frame."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from mirrorskin.hw.base.camera import Camera, Frames
from mirrorskin.hw.base.clock import Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.base.stage import Stage
from mirrorskin.io import InputError

_PATIENCE = 2.0  # seconds that a frame may take, in addition to exposure and delay
_SLICE = 0.05


class Trigger:
    """Takes exactly one frame each time that an output of the controller is switched on.

    The output is on until the frame has arrived, and is then switched off in any case, as long as the
    controller obeys; a stop of the stage resets the controller, which also switches it off.

    Parameters
    ----------
    stage : Stage
        A stage at rest with a method ``switch``, like `GrblStage`.
    camera : Camera
        A camera in its triggered mode.
    settings : CameraSettings
        Settings with the output as ``trigger``.
    check : callable
        Raises the fault of the rig, if there is one.
    clock : Clock
    """

    def __init__(
        self, stage: Stage, camera: Camera, settings: CameraSettings, check: Callable[[], None], clock: Clock
    ) -> None:
        switch = getattr(stage, "switch", None)
        if switch is None:
            raise no_trigger(stage.name)
        self._switch, self._line = switch, settings.trigger
        self._camera, self._check, self._clock = camera, check, clock
        self._patience = _PATIENCE + (settings.exposure or 0.0) + (settings.delay or 0.0)
        self._before: int | None = None  # frames that arrived before the first trigger
        self._given = 0
        self.longest: float = 0.0  # longest time from a trigger to its frame, seconds

    def expose(self) -> Frames:
        """Trigger the camera once, and return the frame; HardwareError if there is not exactly one."""
        self.check()
        if self._before is None:
            self._camera.flush()
            self._before = self._camera.counts.frames
        began = self._clock.now()
        try:
            self._switch(self._line, True)
            frames = self._take()
        finally:
            with suppress(HardwareError):  # raised by a stopped stage, whose output is off anyway
                self._switch(self._line, False)
        self._given += 1
        self.longest = max(self.longest, self._clock.now() - began)
        return frames

    def check(self, wait: bool = False) -> None:
        """Raise HardwareError if there were more frames than triggers; `wait` for one in transfer."""
        if wait:
            self._clock.sleep(self.longest)
        self._check()
        if self._before is None:
            return
        more = self._camera.counts.frames - self._before - self._given
        if more > 0:
            raise HardwareError(
                f"{self._camera.name} delivered frames without a trigger ({more}): "
                "check that it is in its triggered mode, that it triggers on one edge, and that "
                "the signal does not bounce"
            )

    def _take(self) -> Frames:
        until = self._clock.now() + self._patience
        while True:
            self._check()
            try:
                return self._camera.take(1, _SLICE)
            except HardwareError:
                if self._camera.error is not None:
                    raise
                if self._clock.now() > until:
                    raise HardwareError(
                        f"{self._camera.name} delivered no frame within {self._patience:.3g} s of "
                        f"its trigger: check the controller's output '{self._line}', its wiring, "
                        "and the camera's triggered mode"
                    ) from None


def no_trigger(stage: str) -> InputError:
    """Return the error of a stage, by name, that has no outputs."""
    return InputError(f"{stage}: camera.trigger needs a GRBL controller; remove it from the rig file")
