"""Moves each axis of a stage a little, there and back, and tells how near it came."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from mirrorskin.hw.rig.finding import Finding
from mirrorskin.hw.rig.stage_check import tell, unit_of
from mirrorskin.hw.settings import StageSettings
from mirrorskin.hw.stage import Limits, Position, Stage

_FARTHEST = {"mm": 0.5, "deg": math.radians(0.5)}  # how far an axis is moved at most, mm and rad
_SHARE = 0.1  # of how far it may go
_NEAR = {"mm": 0.02, "deg": math.radians(0.02)}  # how near it must come, mm and rad


def check_moves(stage: Stage, settings: StageSettings) -> Iterator[Finding]:
    """Home the stage if the file says so, set it upright within its limits, and move each axis from there.

    Raises
    ------
    HardwareError
        An alarm, or the stage was lost.
    """
    if settings.home:
        stage.home()
        yield Finding("move", "homing", f"done; now {tell(stage.report().position, settings)}")
    travel = stage.report().position.travel
    home = Position(min(max(travel, stage.limits.travel[0]), stage.limits.press))
    stage.move(home)
    stage.wait()
    for name in settings.axes:
        yield _there_and_back(stage, settings, name, home)


def _step(limits: Limits, name: str, unit: str, value: float) -> float:
    """Return how far an axis is moved: travel goes up if it can, so that nothing is pressed."""
    if name != "travel":
        return min(_FARTHEST[unit], _SHARE * limits.tilt)
    low = limits.travel[0]
    step = min(_FARTHEST[unit], _SHARE * (limits.press - low))
    return step if value - step < low else -step


def _there_and_back(stage: Stage, settings: StageSettings, name: str, home: Position) -> Finding:
    """Move one axis from its place and back to it."""
    axis, value = settings.axes[name], getattr(home, name)
    step, off = _step(stage.limits, name, axis.unit, value), 0.0
    for place in (value + step, value):
        stage.move(replace(home, **{name: place}))
        off = max(off, abs(getattr(stage.wait().position, name) - place))
    unit, scale = unit_of(axis)
    what = f"{name} ({axis.letter})"
    found = f"{step * scale:+.3g} {unit} and back, off by {off * scale:.4f} {unit}"
    if off > _NEAR[axis.unit]:
        remedy = f"it does not go where it is sent; look at {axis.letter} and its steps per unit"
        return Finding("move", what, found, "failed", remedy)
    return Finding("move", what, found)
