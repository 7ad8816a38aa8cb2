"""The homing cycle: to the switch, off it, slowly to it again, and off it."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

from mirrorskin.hw.emulator.grbl_errors import GrblError
from mirrorskin.hw.emulator.grbl_paths import Line
from mirrorskin.hw.emulator.planner import Move

if TYPE_CHECKING:
    from mirrorskin.hw.emulator.grbl_controller import Controller

_SEARCH = 1.5  # travels within which the switch must be found
_NOT_FOUND = 9
_FIRST_AXIS = 2  # the firmware homes Z before the others


def home(controller: Controller) -> Generator[float | Callable[[], bool], None, None]:
    """Home one axis after the other; the alarm is off afterwards.

    Raises
    ------
    GrblError
        5: homing is disabled by ``$22``.
    """
    if not controller.settings[22]:
        raise GrblError(5)
    controller.homing = True
    count = len(controller.axes)
    for axis in sorted(range(count), key=lambda axis: (axis != _FIRST_AXIS, axis)):
        yield from _home_axis(controller, axis)
    controller.be_homed()


def _home_axis(controller: Controller, axis: int) -> Generator[float | Callable[[], bool], None, None]:
    settings = controller.settings
    sign = -1 if int(settings[23]) >> axis & 1 else 1
    travel = settings[130 + axis]
    switch = 0.0 if sign > 0 else -travel
    off = switch - sign * settings[27]
    seek, locate = settings[25] / 60, settings[24] / 60
    here = controller.planner.place(controller.now)[axis]
    if (switch - here) * sign > _SEARCH * travel:
        yield from _go(controller, axis, here + sign * _SEARCH * travel, seek)
        controller.abort(_NOT_FOUND)
        yield lambda: False
    for goal, speed in ((switch, seek), (off, seek), (switch, locate), (off, seek)):
        yield from _go(controller, axis, goal, speed)


def _go(
    controller: Controller, axis: int, goal: float, speed: float
) -> Generator[float | Callable[[], bool], None, None]:
    """Drive one axis, and wait for the switch to settle."""
    planner, settings = controller.planner, controller.settings
    start = planner.place(controller.now)
    end = (*start[:axis], goal, *start[axis + 1 :])
    if start != end:
        move = Move(Line(start, end), speed, settings[120 + axis])
        planner.add(move, controller.now, settings[11], settings.per_axis(120))
        yield lambda: not planner.busy
    yield controller.now + settings[26] / 1000
