"""Opens a rig and looks at all of it before anyone relies on it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager

from mirrorskin.hw.camera import Camera
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig.camera_check import check_camera
from mirrorskin.hw.rig.finding import Finding
from mirrorskin.hw.rig.move_check import check_moves
from mirrorskin.hw.rig.stage_check import check_stage
from mirrorskin.hw.settings import CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.video import VideoCamera


def check_rig(
    settings: RigSettings,
    *,
    move: bool = False,
    open_stage: Callable[[StageSettings], GrblStage] = GrblStage,
    open_camera: Callable[[CameraSettings], Camera] = VideoCamera,
) -> Generator[Finding, None, None]:
    """Open the stage and the camera, and tell what is found, one thing at a time.

    However it ends, the stage is stopped and both are closed.

    Parameters
    ----------
    settings : RigSettings
        What the rig file says.
    move : bool
        Home the stage if the file says so, and move each axis a little, there and back, unless something
        failed before. Without it nothing moves.
    open_stage, open_camera : callable
        What opens them.

    Yields
    ------
    Finding

    Raises
    ------
    InputError
        One of them cannot be opened as the file says.
    HardwareError
        One of them was lost, or raised an alarm.
    """
    sound = True
    with closing(open_stage(settings.stage)) as stage:
        for finding in check_stage(stage, settings.stage):
            sound &= finding.verdict != "failed"
            yield finding
        with _told() as told, closing(open_camera(settings.camera)) as camera:
            yield from check_camera(camera, settings.camera)
        yield from (Finding("camera", "message", line, "warning", "see docs/camera.md") for line in told)
        if move and sound:
            yield from check_moves(stage, settings.stage)
        elif move:
            yield Finding("move", "moves", "not tried", "failed", "see to what failed before")
        stage.report()  # raises if it was lost meanwhile


class _Lines(logging.Handler):
    """Keeps what is logged."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def _told() -> Iterator[list[str]]:
    """Collect what hardware warns of: settings that were not taken, losses."""
    log, handler = logging.getLogger("mirrorskin.hw"), _Lines(logging.WARNING)
    propagate = log.propagate
    log.addHandler(handler)
    log.propagate = False
    try:
        yield handler.lines
    finally:
        log.propagate = propagate
        log.removeHandler(handler)
