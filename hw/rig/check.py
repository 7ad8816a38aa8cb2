"""Opens a rig and looks at all of it before anyone relies on it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.camera import Camera, Counts
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.rig_file import Axis, CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.stage import Limits, Position, Report, Stage
from mirrorskin.hw.video import VideoCamera
from mirrorskin.io import InputError

if TYPE_CHECKING:
    from mirrorskin.hw.grbl.stage import GrblStage

Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    part : str
        Of the rig: stage, camera or move.
    what : str
        What was looked at.
    found : str
        What it is, with its unit.
    verdict : {"ok", "warning", "failed"}
        Whether a recording can be made with it.
    remedy : str
        What is wrong and what to do; empty if all is well.
    """

    part: str
    what: str
    found: str
    verdict: Verdict = "ok"
    remedy: str = ""


_FIRST = 5.0  # seconds that a camera may take to its first frame
_PERIOD = 1.0  # seconds that frames are counted for
_MOST = 64  # frames taken at once
_OFF = 0.05  # share that a rate may differ from the one asked
_SATURATED = 0.01  # share of the pixels that may be


def check_camera(camera: Camera, settings: CameraSettings) -> Iterator[Finding]:
    """Look at a camera that was opened, for about a second.

    Raises
    ------
    HardwareError
        No frame came, or the camera was lost meanwhile.
    """
    rows, columns = camera.shape
    yield Finding("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
    before, picture, dropped = _watch(camera)
    after = camera.counts
    yield _rate(after, settings)
    yield _losses(dropped, after, before)
    yield _brightness(picture)


def _watch(camera: Camera) -> tuple[Counts, NDArray[Any], int]:
    """Take all frames of a second; return the counts before, the last frame, and how many were lost."""
    camera.take(1, _FIRST)
    camera.flush()
    before, dropped, end = camera.counts, 0, time.monotonic() + _PERIOD
    while True:
        frames = camera.take(_MOST, _FIRST)
        dropped += frames.dropped
        if time.monotonic() >= end:
            return before, frames.pixels[-1].copy(), dropped


def _rate(counts: Counts, settings: CameraSettings) -> Finding:
    found = f"{counts.rate:.2f} Hz"
    if settings.rate is None:
        return Finding("camera", "rate", found)
    found += f", asked {settings.rate:g} Hz"
    if abs(counts.rate - settings.rate) <= _OFF * settings.rate:
        return Finding("camera", "rate", found)
    remedy = f"the exposure or the line may be too long for it; set camera.rate = {counts.rate:.3g}"
    return Finding("camera", "rate", found, "warning", remedy)


def _losses(dropped: int, after: Counts, before: Counts) -> Finding:
    total, late = after.frames - before.frames, after.late - before.late
    found = f"{total} frames, {dropped} lost, {late} late, {after.reconnects} reconnections"
    if dropped or after.reconnects:
        return Finding(
            "camera", "frames", found, "warning", "frames are lost; lower the rate, or use a faster line"
        )
    return Finding("camera", "frames", found)


def _brightness(picture: NDArray[Any]) -> Finding:
    known = picture[~np.isnan(picture)]
    if not known.size:
        return Finding("camera", "brightness", "NaN", "warning", "no pixel has a value; look at camera.dtype")
    low, middle, high = (float(value) for value in np.percentile(known, (0, 50, 100)))
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else np.inf
    saturated, dark = float(np.mean(picture >= top)), float(np.mean(picture <= 0))
    found = f"{low:g} to {high:g}, median {middle:g}; {saturated:.2%} saturated, {dark:.2%} black"
    if saturated > _SATURATED:
        return Finding("camera", "brightness", found, "warning", "too much light; shorten the exposure")
    if high <= low:
        return Finding(
            "camera", "brightness", found, "warning", "all pixels are alike; look at the light and the lid"
        )
    return Finding("camera", "brightness", found)


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
        with _recorded_warnings() as told, closing(open_camera(settings.camera)) as camera:
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
def _recorded_warnings() -> Iterator[list[str]]:
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
