"""Opens a rig and looks at all of it before anyone relies on it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.camera import Camera, Counts
from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.rig.rig import longest_wait, open_camera, open_stage
from mirrorskin.hw.rig.trigger import Trigger
from mirrorskin.hw.rig_file import Axis, CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.stage import Limits, Position, Report, Stage
from mirrorskin.io import InputError

Verdict = Literal["ok", "warning", "failed"]

_PERIOD = 1.0  # seconds that reports and frames are counted for

_LETTERS = "XYZABC"  # the order of the settings that each axis has
_SOFT_LIMITS, _HOMING, _RATES, _LENGTHS = 20, 22, 110, 130  # numbers of GRBL's settings
_REPORT_SHARE = 0.8  # of the reports asked for
_POLL = 0.02  # seconds between two looks for more
_ROUND_TRIP_MAX = 0.05  # seconds that a report may take
_SPARE = 3.0  # times the longest wait seen, that a limit should be; told if it is not twice that
_ROUNDING = 1e-6  # how far numbers of the controller may be beyond ours by rounding

_FRAME_TIMEOUT = 5.0  # seconds that a camera may take to its first frame
_TRIGGERED = 3  # frames
_BATCH = 64  # frames taken at once
_RATE_TOLERANCE = 0.05  # share that a rate may differ from the one asked
_SATURATED_MAX = 0.01  # share of the pixels that may be

_MOVE_MAX = {"mm": 0.5, "deg": math.radians(0.5)}  # how far an axis is moved at most, mm and rad
_MOVE_SHARE = 0.1  # of how far it may go
_POSITION_TOLERANCE = {"mm": 0.02, "deg": math.radians(0.02)}  # how near it must come, mm and rad


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    part: str  # of the rig: stage, camera or move
    what: str  # what was looked at
    found: str  # what it is, with its unit
    verdict: Verdict = "ok"  # whether a recording can be made with it
    remedy: str = ""  # what is wrong and what to do; empty if all is well


def check_rig(
    settings: RigSettings,
    *,
    move: bool = False,
    open_stage: Callable[[StageSettings], Stage] = open_stage,
    open_camera: Callable[[CameraSettings], Camera] = open_camera,
    clock: Clock = SYSTEM,
) -> Generator[Finding, None, None]:
    """Open the stage and the camera, and yield what is found, one thing at a time.

    With `move` the stage is homed if the file says so, and each axis moves a little, there and back, unless
    something failed before; without it nothing moves. However it ends, the stage is stopped and both are
    closed. InputError if one of them cannot be opened as the file says, HardwareError if one is lost or the
    stage raises an alarm.
    """
    sound = True
    with closing(open_stage(settings.stage)) as stage:
        for finding in check_stage(stage, settings.stage, clock):
            sound &= finding.verdict != "failed"
            yield finding
        with _logged_warnings() as logged, closing(open_camera(settings.camera)) as camera:
            looked = check_camera if settings.camera.trigger is None else partial(check_trigger, stage)
            yield from looked(camera, settings.camera, clock)
        yield from (
            Finding("camera", "message", line, "warning", "correct [camera] in the rig file, or the camera")
            for line in logged
        )
        if move and sound:
            yield from check_moves(stage, settings.stage)
        elif move:
            yield Finding("move", "moves", "not tried", "failed", "see to what failed before")
        stage.report()  # raises if it was lost meanwhile


@contextmanager
def _logged_warnings() -> Iterator[list[str]]:
    """Collect what hardware warns of: settings that were not taken, losses."""
    log, lines = logging.getLogger("mirrorskin.hw"), []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    propagate, log.propagate = log.propagate, False
    log.addHandler(handler)
    try:
        yield lines
    finally:
        log.propagate = propagate
        log.removeHandler(handler)


# The stage at rest: what it says of itself, against what the rig file says of it


def check_stage(stage: Stage, settings: StageSettings, clock: Clock = SYSTEM) -> Iterator[Finding]:
    """Look at a stage that was opened, for about a second; nothing moves."""
    yield Finding("stage", "firmware", getattr(stage, "firmware", settings.firmware))
    report = stage.report()
    yield _state(report, settings)
    yield _position(report, stage, settings)
    yield from _reports(stage, settings, clock)
    if settings.firmware == "grbl":
        yield from _controller(stage, settings)
    if not getattr(stage, "homing_stops", True):
        remedy = "build the firmware with EMERGENCY_PARSER, or stand by with the switch"
        yield Finding("stage", "stop of homing", "not certain", "warning", remedy)


def _controller(stage: Any, settings: StageSettings) -> Iterator[Finding]:
    """Compare what a GRBL controller was set to with the rig file."""
    yield _homing(stage.parameters, settings)
    for name, axis in settings.axes.items():
        yield _length(name, axis, stage.parameters)
        yield _speed(name, axis, stage.parameters)
    if settings.pitch and settings.roll:
        yield _arcs(settings.pitch, settings.roll)
    remedy = ""
    if stage.round_trip > _ROUND_TRIP_MAX:
        remedy = "positions in motion are as uncertain as this is long; use a shorter or faster line"
    yield _rated("stage", "round trip of a report", f"{stage.round_trip * 1e3:.1f} ms", remedy)
    yield _wait("stage", "longest round trip", stage.longest_trip, stage.longest_silence, "stage.silence")


def _rated(part: str, what: str, found: str, remedy: str = "", verdict: Verdict = "warning") -> Finding:
    """Return a finding that is ok unless there is a remedy."""
    return Finding(part, what, found, verdict if remedy else "ok", remedy)


def in_words(position: Position, settings: StageSettings) -> str:
    """Return where the body stands, axis by axis, in their units."""
    return ", ".join(
        f"{name} {getattr(position, name) * axis.scale:.3f} {axis.unit}"
        for name, axis in settings.axes.items()
    )


def _state(report: Report, settings: StageSettings) -> Finding:
    if report.state == "idle":
        return Finding("stage", "state", "idle")
    if report.state == "alarm" and settings.home:
        return Finding("stage", "state", "alarm: locked until it is homed")
    remedy = "look at the machine, and unlock it" if report.state == "alarm" else "wait until it rests"
    return Finding("stage", "state", report.state, "failed", f"it cannot move from this; {remedy}")


def _position(report: Report, stage: Stage, settings: StageSettings) -> Finding:
    found = in_words(report.position, settings)
    if settings.home:
        return Finding("stage", "position", f"{found} (before homing)")
    try:
        stage.limits.check(report.position, "it")
    except InputError:
        remedy = "beyond the file's limits; move it there by hand, or correct zero"
        return Finding("stage", "position", found, "warning", remedy)
    return Finding("stage", "position", found)


def _homing(parameters: Mapping[int, float], settings: StageSettings) -> Finding:
    on = bool(int(parameters.get(_HOMING, 0)) & 1)
    found = ("on" if on else "off") if _HOMING in parameters else "not told"
    wrong = settings.home and not on
    remedy = "the file asks for homing; set stage.home = false, or switch it on ($22=1)" if wrong else ""
    return _rated("stage", "homing ($22)", found, remedy, "failed")


def _length(name: str, axis: Axis, parameters: Mapping[int, float]) -> Finding:
    """Compare how far an axis goes: homed, GRBL counts down from 0, or up if it was built so."""
    unit, (low, high) = axis.unit, axis.limits
    number = _LENGTHS + _LETTERS.index(axis.letter)
    length = parameters.get(number)
    what = f"{name}: limits against ${number}"
    found = f"{low:g} to {high:g} {unit}, of {_of_controller(length, unit)}"
    if length is None:
        return Finding("stage", what, found)
    ends = sorted(axis.zero + axis.direction * value for value in (low, high))
    most, remedy = length * (1 + _ROUNDING), ""
    within = -most <= ends[0] <= ends[1] <= 0 or 0 <= ends[0] <= ends[1] <= most
    if high - low > most:
        remedy = f"they are {high - low:g} {unit} apart, and the axis is shorter; correct stage.{name}.limits"
    elif parameters.get(_SOFT_LIMITS) and not within:
        remedy = (
            f"they are {ends[0]:g} to {ends[1]:g} in the machine's coordinates; its soft limits ($20) "
            f"refuse a part; correct stage.{name}.limits or its zero"
        )
    return _rated("stage", what, found, remedy)


def _speed(name: str, axis: Axis, parameters: Mapping[int, float]) -> Finding:
    """Compare how fast an axis is; GRBL counts by the minute."""
    unit, number = axis.unit, _RATES + _LETTERS.index(axis.letter)
    theirs = parameters[number] / 60 if number in parameters else None
    found = f"{axis.speed:g} {unit}/s, of {_of_controller(theirs, f'{unit}/s')}"
    remedy = ""
    if theirs is not None and axis.speed > theirs * (1 + _ROUNDING):
        remedy = f"the controller moves more slowly than the file says; set stage.{name}.speed = {theirs:g}"
    return _rated("stage", f"{name}: speed against ${number}", found, remedy)


def _of_controller(value: float | None, unit: str) -> str:
    return "what the controller does not tell" if value is None else f"{value:g} {unit} of the controller"


def _arcs(pitch: Axis, roll: Axis) -> Finding:
    """Return whether the axes span a plane that GRBL knows arcs in."""
    remedy = ""
    if not {pitch.letter, roll.letter} <= set("XYZ"):
        remedy = "GRBL has none there, so rotations go in steps only; put pitch and roll on two of X, Y and Z"
    return _rated("stage", "arcs", f"in {pitch.letter} and {roll.letter}", remedy)


def _reports(stage: Stage, settings: StageSettings, clock: Clock) -> Iterator[Finding]:
    """Measure how often reports come, and how long one takes."""
    times, asked = _listen(stage, settings, clock), settings.report_rate
    if len(times) < 2:
        yield Finding("stage", "reports", "none", "failed", "none came; look at the line and at stage.baud")
        return
    rate = (len(times) - 1) / (times[-1] - times[0])
    remedy = ""
    if rate < _REPORT_SHARE * asked:
        remedy = f"the line is slow; set stage.report_rate = {max(1, round(rate))}, or raise stage.baud"
    yield _rated("stage", "reports", f"{rate:.1f} Hz, asked {asked:g} Hz", remedy)


def _wait(part: str, what: str, longest: float, limit: float, key: str) -> Finding:
    """Compare the longest wait for something with how long a move bears to wait for it."""
    remedy = ""
    if longest > 2 / _SPARE * limit:
        remedy = f"good runs may be stopped; set {key} = {_SPARE * longest:.2g}, or run less beside it"
    return _rated(part, what, f"{longest * 1e3:.1f} ms, of {limit * 1e3:.0f} ms that a move bears", remedy)


def _listen(stage: Stage, settings: StageSettings, clock: Clock) -> list[float]:
    """Return the times of the reports of a second, or of the first two."""
    begun = clock.now()
    clock.sleep(_PERIOD)
    while len(times := [report.time for report in stage.history(begun)]) < 2:
        stage.report()  # raises if it is lost
        if clock.now() > begun + _PERIOD + settings.timeout + 2 / settings.report_rate:
            break
        clock.sleep(_POLL)
    return times


# The camera: its frames, their rate, and how much light they have


def check_camera(camera: Camera, settings: CameraSettings, clock: Clock = SYSTEM) -> Iterator[Finding]:
    """Look at a camera that was opened, for about a second."""
    rows, columns = camera.shape
    yield Finding("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
    camera.take(1, _FRAME_TIMEOUT)
    camera.flush()
    before, dropped, end = camera.counts, 0, clock.now() + _PERIOD
    times: list[float] = []
    while True:
        frames = camera.take(_BATCH, _FRAME_TIMEOUT)
        dropped += frames.dropped
        times += frames.time.tolist()
        if clock.now() >= end:
            break
    after = camera.counts
    yield _rate(after, settings)
    yield _losses(dropped, after, before)
    longest = float(np.max(np.diff(times), initial=0.0))
    bound = longest_wait(settings, 1 / after.rate if after.rate > 0 else 0.0)
    yield _wait("camera", "longest wait for a frame", longest, bound, "camera.stall")
    yield _brightness(frames.pixels[-1].copy())


def check_trigger(
    stage: Stage, camera: Camera, settings: CameraSettings, clock: Clock = SYSTEM
) -> Iterator[Finding]:
    """Trigger a camera that was opened, at rest."""
    rows, columns = camera.shape
    yield Finding("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
    trigger = Trigger(stage, camera, settings, lambda: None, clock)
    frames = [trigger.expose() for _ in range(_TRIGGERED)]
    trigger.check(wait=True)
    found = f"{_TRIGGERED} frames, at most {1e3 * trigger.longest:.0f} ms after '{settings.trigger}' went on"
    yield Finding("camera", "trigger", found)
    yield _brightness(frames[-1].pixels[-1].copy())


def _rate(counts: Counts, settings: CameraSettings) -> Finding:
    found, remedy = f"{counts.rate:.2f} Hz", ""
    if settings.rate is not None:
        found += f", asked {settings.rate:g} Hz"
        if not abs(counts.rate - settings.rate) <= _RATE_TOLERANCE * settings.rate:
            remedy = f"the exposure or the line may be too long for it; set camera.rate = {counts.rate:.3g}"
    return _rated("camera", "rate", found, remedy)


def _losses(dropped: int, after: Counts, before: Counts) -> Finding:
    total, late = after.frames - before.frames, after.late - before.late
    found = f"{total} frames, {dropped} lost, {late} late, {after.reconnects} reconnections"
    lost = dropped or after.reconnects
    remedy = "frames are lost; lower the rate, or use a faster line" if lost else ""
    return _rated("camera", "frames", found, remedy)


def _brightness(picture: NDArray[Any]) -> Finding:
    known = picture[~np.isnan(picture)]
    if not known.size:
        return Finding("camera", "brightness", "NaN", "warning", "no pixel has a value; look at camera.dtype")
    low, middle, high = (float(value) for value in np.percentile(known, (0, 50, 100)))
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else np.inf
    saturated, dark = float(np.mean(picture >= top)), float(np.mean(picture <= 0))
    found = f"{low:g} to {high:g}, median {middle:g}; {saturated:.2%} saturated, {dark:.2%} black"
    remedy = ""
    if saturated > _SATURATED_MAX:
        remedy = "too much light; shorten the exposure"
    elif high <= low:
        remedy = "all pixels are alike; look at the light and the lid"
    return _rated("camera", "brightness", found, remedy)


# Moves: each axis a little, there and back


def check_moves(stage: Stage, settings: StageSettings) -> Iterator[Finding]:
    """Home the stage if the file says so, set it upright within its limits, and move each axis from there.

    For x, y and twist the body is lifted first, so that it is not dragged over anything.
    """
    if settings.home:
        stage.home()
        yield Finding("move", "homing", f"done; now {in_words(stage.report().position, settings)}")
    home = stage.limits.nearest(stage.report().position)
    stage.move(home)
    stage.wait()
    for name in settings.axes:
        if name in ("x", "y", "twist"):
            home = replace(home, travel=stage.limits.travel[0])
            stage.move(home)
            stage.wait()
        yield _there_and_back(stage, settings, name, home)


def _step(limits: Limits, name: str, unit: str, value: float) -> float:
    """Return how far an axis is moved: down if it can, so that travel goes up, and nothing is pressed."""
    if name in ("pitch", "roll"):
        return min(_MOVE_MAX[unit], _MOVE_SHARE * limits.tilt)
    low, high = (limits.travel[0], limits.press) if name == "travel" else getattr(limits, name)
    step = min(_MOVE_MAX[unit], _MOVE_SHARE * (high - low))
    return step if value - step < low else -step


def _there_and_back(stage: Stage, settings: StageSettings, name: str, home: Position) -> Finding:
    axis, value = settings.axes[name], getattr(home, name)
    step, off = _step(stage.limits, name, axis.unit, value), 0.0
    for place in (value + step, value):
        stage.move(replace(home, **{name: place}))
        off = max(off, abs(getattr(stage.wait().position, name) - place))
    unit, scale = axis.unit, axis.scale
    found = f"{step * scale:+.3g} {unit} and back, off by {off * scale:.4f} {unit}"
    lost = off > _POSITION_TOLERANCE[unit]
    remedy = f"it does not go where it is sent; look at {axis.letter} and its steps per unit" if lost else ""
    return _rated("move", f"{name} ({axis.letter})", found, remedy, "failed")
