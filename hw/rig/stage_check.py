"""Looks at a stage at rest: what it says of itself, against what the rig file says of it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from mirrorskin.hw.rig.finding import Finding
from mirrorskin.hw.settings import Axis, StageSettings
from mirrorskin.hw.stage import Position, Report, Stage
from mirrorskin.io import InputError

if TYPE_CHECKING:
    from mirrorskin.hw.grbl.stage import GrblStage

_LETTERS = "XYZABC"  # the order of the settings that each axis has
_SOFT_LIMITS, _HOMING, _RATES, _LENGTHS = 20, 22, 110, 130  # numbers of GRBL's settings
_PERIOD = 1.0  # seconds that reports are counted for
_ENOUGH = 0.8  # of the reports asked for
_LOOK = 0.02  # seconds between two looks for more
_SLOW = 0.05  # seconds that a report may take
_ALIKE = 1e-6  # how far numbers of the controller may be beyond ours by rounding


def check_stage(stage: GrblStage, settings: StageSettings) -> Iterator[Finding]:
    """Look at a stage that was opened, for about a second; nothing moves.

    Raises
    ------
    HardwareError
        The stage was lost meanwhile.
    """
    yield Finding("stage", "firmware", stage.firmware)
    report, told = stage.report(), stage.parameters
    yield _state(report, settings)
    yield _position(report, stage, settings)
    yield _homing(told, settings)
    for name, axis in settings.axes.items():
        yield _length(name, axis, told)
        yield _speed(name, axis, told)
    if settings.pitch and settings.roll:
        yield _arcs(settings.pitch, settings.roll)
    yield from _reports(stage, settings)


def tell(position: Position, settings: StageSettings) -> str:
    """Return a position in the file's words and units."""
    places = [f"travel {position.travel:.3f} mm"]
    if settings.pitch:
        places += [f"{name} {math.degrees(getattr(position, name)):.3f} deg" for name in ("pitch", "roll")]
    return ", ".join(places)


def _state(report: Report, settings: StageSettings) -> Finding:
    if report.state == "idle":
        return Finding("stage", "state", "idle")
    if report.state == "alarm" and settings.home:
        return Finding("stage", "state", "alarm: locked until it is homed")
    remedy = "look at the machine, and unlock it" if report.state == "alarm" else "wait until it rests"
    return Finding("stage", "state", report.state, "failed", f"it cannot move from this; {remedy}")


def _position(report: Report, stage: Stage, settings: StageSettings) -> Finding:
    """Tell where the body is; before homing that says nothing."""
    found = tell(report.position, settings)
    if settings.home:
        return Finding("stage", "position", f"{found} (before homing)")
    try:
        stage.limits.check(report.position, "it")
    except InputError:
        return Finding(
            "stage",
            "position",
            found,
            "warning",
            "beyond the file's limits; move it there by hand, or correct zero",
        )
    return Finding("stage", "position", found)


def _homing(told: Mapping[int, float], settings: StageSettings) -> Finding:
    on = bool(int(told.get(_HOMING, 0)) & 1)
    found = ("on" if on else "off") if _HOMING in told else "not told"
    if settings.home and not on:
        remedy = "the file asks for homing; set stage.home = false, or switch it on ($22=1)"
        return Finding("stage", "homing ($22)", found, "failed", remedy)
    return Finding("stage", "homing ($22)", found)


def _length(name: str, axis: Axis, told: Mapping[int, float]) -> Finding:
    """Compare how far an axis goes: homed, GRBL counts down from 0, or up if it was built so."""
    unit, scale = unit_of(axis)
    number = _LENGTHS + _LETTERS.index(axis.letter)
    low, high, length = axis.low * scale, axis.high * scale, told.get(number)
    what, found = f"{name}: limits against ${number}", f"{low:g} to {high:g} {unit}, of {_told(length, unit)}"
    if length is None:
        return Finding("stage", what, found)
    ends = [axis.zero + axis.direction * value for value in (low, high)]
    most = length * (1 + _ALIKE)
    if high - low > most:
        remedy = f"they are {high - low:g} {unit} apart, and the axis is shorter; correct stage.{name}.limits"
        return Finding("stage", what, found, "warning", remedy)
    if told.get(_SOFT_LIMITS) and not (
        -most <= min(ends) <= max(ends) <= 0 or 0 <= min(ends) <= max(ends) <= most
    ):
        remedy = (
            f"they are {min(ends):g} to {max(ends):g} in the machine's coordinates; its soft limits ($20) "
            f"refuse a part; correct stage.{name}.limits or its zero"
        )
        return Finding("stage", what, found, "warning", remedy)
    return Finding("stage", what, found)


def _speed(name: str, axis: Axis, told: Mapping[int, float]) -> Finding:
    """Compare how fast an axis is; GRBL counts by the minute."""
    unit, scale = unit_of(axis)
    number = _RATES + _LETTERS.index(axis.letter)
    ours, theirs = axis.speed * scale, told.get(number)
    theirs = None if theirs is None else theirs / 60
    what = f"{name}: speed against ${number}"
    found = f"{ours:g} {unit}/s, of {_told(theirs, f'{unit}/s')}"
    if theirs is not None and ours > theirs * (1 + _ALIKE):
        remedy = f"the controller moves more slowly than the file says; set stage.{name}.speed = {theirs:g}"
        return Finding("stage", what, found, "warning", remedy)
    return Finding("stage", what, found)


def unit_of(axis: Axis) -> tuple[str, float]:
    """Return an axis's unit in the file, and how many of it make one of ours (mm or rad)."""
    return axis.unit, axis.scale


def _told(value: float | None, unit: str) -> str:
    return "what the controller does not tell" if value is None else f"{value:g} {unit} of the controller"


def _arcs(pitch: Axis, roll: Axis) -> Finding:
    """Tell whether the axes span a plane that GRBL knows arcs in."""
    found = f"in {pitch.letter} and {roll.letter}"
    if {pitch.letter, roll.letter} <= set("XYZ"):
        return Finding("stage", "arcs", found)
    remedy = "GRBL has none there, so rotations go in steps only; put pitch and roll on two of X, Y and Z"
    return Finding("stage", "arcs", found, "warning", remedy)


def _listen(stage: Stage, settings: StageSettings) -> list[float]:
    """Return the times of the reports of a second, or of the first two."""
    begun = time.monotonic()
    time.sleep(_PERIOD)
    while len(times := [report.time for report in stage.history(begun)]) < 2:
        stage.report()  # raises if it is lost
        if time.monotonic() > begun + _PERIOD + settings.timeout + 2 / settings.report_rate:
            break
        time.sleep(_LOOK)
    return times


def _reports(stage: GrblStage, settings: StageSettings) -> Iterator[Finding]:
    """Measure how often reports come, and how long one takes."""
    times = _listen(stage, settings)
    asked = settings.report_rate
    if len(times) < 2:
        yield Finding("stage", "reports", "none", "failed", "none came; look at the line and at stage.baud")
        return
    rate = (len(times) - 1) / (times[-1] - times[0])
    found = f"{rate:.1f} Hz, asked {asked:g} Hz"
    if rate < _ENOUGH * asked:
        remedy = f"the line is slow; set stage.report_rate = {max(1, round(rate))}, or raise stage.baud"
        yield Finding("stage", "reports", found, "warning", remedy)
    else:
        yield Finding("stage", "reports", found)
    found = f"{stage.round_trip * 1e3:.1f} ms"
    if stage.round_trip > _SLOW:
        remedy = "positions in motion are as uncertain as this is long; use a shorter or faster line"
        yield Finding("stage", "round trip of a report", found, "warning", remedy)
    else:
        yield Finding("stage", "round trip of a report", found)
