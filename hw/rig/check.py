"""Checks of a rig before it is used."""

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

from mirrorskin.hw.base.camera import Camera, Counts
from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.rig_file import Axis, CameraSettings, RigSettings, StageSettings
from mirrorskin.hw.base.stage import Limits, Position, Report, Stage
from mirrorskin.hw.rig.rig import longest_wait, open_camera, open_stage
from mirrorskin.hw.rig.trigger import Trigger
from mirrorskin.io import InputError
from mirrorskin.io.watch.saturation import scale_top

Verdict = Literal["ok", "warning", "failed"]

_PERIOD = 1.0  # seconds over which reports and frames are counted

_LETTERS = "XYZABC"  # order of the settings of the axes
_SOFT_LIMITS, _HOMING, _RATES, _LENGTHS = 20, 22, 110, 130  # numbers of GRBL's settings
_REPORT_SHARE = 0.8  # minimum share of the requested rate of reports
_POLL = 0.02  # interval of polling, seconds
_ROUND_TRIP_MAX = 0.05  # maximum duration of a report, seconds
_SPARE = 3.0  # recommended limit, in times of the longest wait; warned of below two thirds of it
_ROUNDING = 1e-6  # relative rounding of the controller's numbers

_FRAME_TIMEOUT = 5.0  # seconds until the first frame
_TRIGGERED = 3  # frames
_BATCH = 64  # frames taken at once
_RATE_TOLERANCE = 0.05  # tolerated relative deviation of a rate
_SATURATED_MAX = 0.01  # tolerated share of saturated pixels

_MOVE_MAX = {"mm": 0.5, "deg": math.radians(0.5)}  # maximum move of an axis, mm and rad
_MOVE_SHARE = 0.1  # maximum move, as a share of the axis
_POSITION_TOLERANCE = {"mm": 0.02, "deg": math.radians(0.02)}  # tolerance of a position, mm and rad


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check."""

    part: str  # stage, camera or move
    what: str  # what was checked
    found: str  # the value found, with its unit
    verdict: Verdict = "ok"  # whether a recording can be made with it
    remedy: str = ""  # the problem and the remedy; empty if there is none


def check_rig(
    settings: RigSettings,
    *,
    move: bool = False,
    open_stage: Callable[[StageSettings], Stage] = open_stage,
    open_camera: Callable[[CameraSettings], Camera] = open_camera,
    clock: Clock = SYSTEM,
) -> Generator[CheckResult, None, None]:
    """Open the stage and the camera, and yield the result of each check.

    With `move` the stage is homed if the file requires it, and each axis moves back and forth a little,
    unless a check failed before; otherwise nothing moves. In any case the stage is stopped and both are
    closed at the end. InputError if one of them cannot be opened as described in the file, HardwareError if
    one is lost or the stage raises an alarm.
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
            CheckResult(
                "camera",
                "message",
                line,
                "warning",
                "correct [camera] in the rig file, or the settings of the camera",
            )
            for line in logged
        )
        if move and sound:
            yield from check_moves(stage, settings.stage)
        elif move:
            yield CheckResult("move", "moves", "not tried", "failed", "correct the failures above first")
        stage.report()  # raises if the stage was lost meanwhile


@contextmanager
def _logged_warnings() -> Iterator[list[str]]:
    """Collect the warnings of hardware: settings that were not accepted, losses."""
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


# Checks of the stage at rest


def check_stage(stage: Stage, settings: StageSettings, clock: Clock = SYSTEM) -> Iterator[CheckResult]:
    """Check an open stage for about a second, without moving it."""
    yield CheckResult("stage", "firmware", getattr(stage, "firmware", settings.firmware))
    report = stage.report()
    yield _state(report, settings)
    yield _position(report, stage, settings)
    yield from _reports(stage, settings, clock)
    if hasattr(stage, "parameters"):
        yield from _controller(stage, settings)
    if not getattr(stage, "homing_stops", True):
        remedy = "build the firmware with EMERGENCY_PARSER, or be ready to switch off the power"
        yield CheckResult("stage", "stop of homing", "not certain", "warning", remedy)


def _controller(stage: Any, settings: StageSettings) -> Iterator[CheckResult]:
    """Compare the settings of a GRBL controller with the rig file."""
    yield _homing(stage.parameters, settings)
    for name, axis in settings.axes.items():
        yield _length(name, axis, stage.parameters)
        yield _speed(name, axis, stage.parameters)
    if settings.pitch and settings.roll:
        yield _arcs(settings.pitch, settings.roll)
    remedy = ""
    if stage.round_trip > _ROUND_TRIP_MAX:
        remedy = "positions in motion have an uncertainty of this length; use a shorter or faster connection"
    yield _rated("stage", "round trip of a report", f"{stage.round_trip * 1e3:.1f} ms", remedy)
    yield _wait("stage", "longest round trip", stage.longest_trip, stage.longest_silence, "stage.silence")


def _rated(part: str, what: str, value: str, remedy: str = "", verdict: Verdict = "warning") -> CheckResult:
    """Return a finding that is ok unless there is a remedy."""
    return CheckResult(part, what, value, verdict if remedy else "ok", remedy)


def in_words(position: Position, settings: StageSettings) -> str:
    """Return the position of the body, axis by axis, in their units."""
    return ", ".join(
        f"{name} {getattr(position, name) * axis.scale:.3f} {axis.unit}"
        for name, axis in settings.axes.items()
    )


def _state(report: Report, settings: StageSettings) -> CheckResult:
    if report.state == "idle":
        return CheckResult("stage", "state", "idle")
    if report.state == "alarm" and settings.home:
        return CheckResult("stage", "state", "alarm: locked until it is homed")
    remedy = "check the machine, and unlock it" if report.state == "alarm" else "wait until it is at rest"
    return CheckResult(
        "stage", "state", report.state, "failed", f"no moves are possible in this state; {remedy}"
    )


def _position(report: Report, stage: Stage, settings: StageSettings) -> CheckResult:
    value = in_words(report.position, settings)
    if settings.home:
        return CheckResult("stage", "position", f"{value} (before homing)")
    try:
        stage.limits.check(report.position, "it")
    except InputError:
        remedy = "outside the file's limits; move it inside by hand, or correct zero"
        return CheckResult("stage", "position", value, "warning", remedy)
    return CheckResult("stage", "position", value)


def _homing(parameters: Mapping[int, float], settings: StageSettings) -> CheckResult:
    on = bool(int(parameters.get(_HOMING, 0)) & 1)
    value = ("on" if on else "off") if _HOMING in parameters else "not told"
    wrong = settings.home and not on
    remedy = "the file requires homing; set stage.home = false, or enable it ($22=1)" if wrong else ""
    return _rated("stage", "homing ($22)", value, remedy, "failed")


def _length(name: str, axis: Axis, parameters: Mapping[int, float]) -> CheckResult:
    """Compare the length of an axis; after homing GRBL counts down from 0, or up if built so."""
    unit, (low, high) = axis.unit, axis.limits
    number = _LENGTHS + _LETTERS.index(axis.letter)
    length = parameters.get(number)
    what = f"{name}: limits against ${number}"
    value = f"{low:g} to {high:g} {unit}, {_of_controller(length, unit)}"
    if length is None:
        return CheckResult("stage", what, value)
    ends = sorted(axis.zero + axis.direction * value for value in (low, high))
    bound, remedy = length * (1 + _ROUNDING), ""
    within = -bound <= ends[0] <= ends[1] <= 0 or 0 <= ends[0] <= ends[1] <= bound
    if high - low > bound:
        remedy = (
            f"the limits are {high - low:g} {unit} apart, but the axis is shorter; correct "
            f"stage.{name}.limits"
        )
    elif parameters.get(_SOFT_LIMITS) and not within:
        remedy = (
            f"the limits are {ends[0]:g} to {ends[1]:g} in machine coordinates, partly outside "
            f"its soft limits ($20); correct stage.{name}.limits or its zero"
        )
    return _rated("stage", what, value, remedy)


def _speed(name: str, axis: Axis, parameters: Mapping[int, float]) -> CheckResult:
    """Compare the speed of an axis; GRBL's settings are per minute."""
    unit, number = axis.unit, _RATES + _LETTERS.index(axis.letter)
    theirs = parameters[number] / 60 if number in parameters else None
    value = f"{axis.speed:g} {unit}/s, {_of_controller(theirs, f'{unit}/s')}"
    remedy = ""
    if theirs is not None and axis.speed > theirs * (1 + _ROUNDING):
        remedy = f"the controller is slower than the file; set stage.{name}.speed = {theirs:g}"
    return _rated("stage", f"{name}: speed against ${number}", value, remedy)


def _of_controller(value: float | None, unit: str) -> str:
    return "unknown in the controller" if value is None else f"{value:g} {unit} in the controller"


def _arcs(pitch: Axis, roll: Axis) -> CheckResult:
    """Return whether GRBL supports arcs in the plane of the axes."""
    remedy = ""
    if not {pitch.letter, roll.letter} <= set("XYZ"):
        remedy = (
            "GRBL does not support arcs there, so rotations need steps; put pitch and roll on two of "
            "X, Y and Z"
        )
    return _rated("stage", "arcs", f"in {pitch.letter} and {roll.letter}", remedy)


def _reports(stage: Stage, settings: StageSettings, clock: Clock) -> Iterator[CheckResult]:
    """Measure the rate of reports, and their duration."""
    times, asked = _listen(stage, settings, clock), settings.report_rate
    if len(times) < 2:
        yield CheckResult(
            "stage", "reports", "none", "failed", "none arrived; check the connection and stage.baud"
        )
        return
    rate = (len(times) - 1) / (times[-1] - times[0])
    remedy = ""
    if rate < _REPORT_SHARE * asked:
        remedy = (
            f"the connection is slow; set stage.report_rate = {max(1, round(rate))}, or increase stage.baud"
        )
    yield _rated("stage", "reports", f"{rate:.1f} Hz, requested {asked:g} Hz", remedy)


def _wait(part: str, what: str, longest: float, limit: float, key: str) -> CheckResult:
    """Compare the longest wait for something with its limit during a move."""
    remedy = ""
    if longest > 2 / _SPARE * limit:
        remedy = f"a good run may be stopped; set {key} = {_SPARE * longest:.2g}, or end other programs"
    return _rated(part, what, f"{longest * 1e3:.1f} ms; the limit in motion is {limit * 1e3:.0f} ms", remedy)


def _listen(stage: Stage, settings: StageSettings, clock: Clock) -> list[float]:
    """Return the times of the reports of a second, or of the first two."""
    begun = clock.now()
    clock.sleep(_PERIOD)
    while len(times := [report.time for report in stage.history(begun)]) < 2:
        stage.report()  # raises if the stage is lost
        if clock.now() > begun + _PERIOD + settings.timeout + 2 / settings.report_rate:
            break
        clock.sleep(_POLL)
    return times


# Checks of the camera: frames, their rate, and brightness


def check_camera(camera: Camera, settings: CameraSettings, clock: Clock = SYSTEM) -> Iterator[CheckResult]:
    """Check an open camera for about a second."""
    rows, columns = camera.shape
    yield CheckResult("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
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
) -> Iterator[CheckResult]:
    """Trigger an open camera, at rest."""
    rows, columns = camera.shape
    yield CheckResult("camera", "pictures", f"{columns} x {rows} {camera.dtype.name}")
    trigger = Trigger(stage, camera, settings, lambda: None, clock)
    frames = [trigger.expose() for _ in range(_TRIGGERED)]
    trigger.check(wait=True)
    value = (
        f"{_TRIGGERED} frames, at most {1e3 * trigger.longest:.0f} ms after '{settings.trigger}' was "
        "switched on"
    )
    yield CheckResult("camera", "trigger", value)
    yield _brightness(frames[-1].pixels[-1].copy())


def _rate(counts: Counts, settings: CameraSettings) -> CheckResult:
    value, remedy = f"{counts.rate:.2f} Hz", ""
    if settings.rate is not None:
        value += f", requested {settings.rate:g} Hz"
        if not abs(counts.rate - settings.rate) <= _RATE_TOLERANCE * settings.rate:
            remedy = (
                f"the exposure or the transfer may be too slow for it; set camera.rate = {counts.rate:.3g}"
            )
    return _rated("camera", "rate", value, remedy)


def _losses(dropped: int, after: Counts, before: Counts) -> CheckResult:
    total, late = after.frames - before.frames, after.late - before.late
    value = f"{total} frames, {dropped} lost, {late} late, {after.reconnects} reconnections"
    lost = dropped or after.reconnects
    remedy = "frames are lost; reduce the rate, or use a faster connection" if lost else ""
    return _rated("camera", "frames", value, remedy)


def _brightness(picture: NDArray[Any]) -> CheckResult:
    finite = picture[~np.isnan(picture)]
    if not finite.size:
        return CheckResult(
            "camera", "brightness", "NaN", "warning", "no pixel has a value; check camera.dtype"
        )
    low, middle, high = (float(value) for value in np.percentile(finite, (0, 50, 100)))
    top = scale_top(high, picture.dtype.kind == "u")
    saturated = 0.0 if top is None else float(np.mean(picture >= top))
    dark = float(np.mean(picture <= 0))
    value = f"{low:g} to {high:g}, median {middle:g}; {saturated:.2%} saturated, {dark:.2%} black"
    remedy = ""
    if saturated > _SATURATED_MAX:
        remedy = "too much light; shorten the exposure"
    elif high <= low:
        remedy = "all pixels are equal; check the light and the lens cap"
    return _rated("camera", "brightness", value, remedy)


# Checks of the axes: each moves back and forth a little


def check_moves(stage: Stage, settings: StageSettings) -> Iterator[CheckResult]:
    """Home the stage if the file requires it, set it upright, and move each axis a little.

    For x, y and twist the body is lifted first, so that it is not dragged over anything.
    """
    if settings.home:
        stage.home()
        yield CheckResult("move", "homing", f"done; now {in_words(stage.report().position, settings)}")
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
    """Return the distance to move an axis: negative if possible, which lifts the body."""
    if name in ("pitch", "roll"):
        return min(_MOVE_MAX[unit], _MOVE_SHARE * limits.tilt)
    low, high = (limits.travel[0], limits.press) if name == "travel" else getattr(limits, name)
    step = min(_MOVE_MAX[unit], _MOVE_SHARE * (high - low))
    return step if value - step < low else -step


def _there_and_back(stage: Stage, settings: StageSettings, name: str, home: Position) -> CheckResult:
    axis, value = settings.axes[name], getattr(home, name)
    step, off = _step(stage.limits, name, axis.unit, value), 0.0
    for place in (value + step, value):
        stage.move(replace(home, **{name: place}))
        off = max(off, abs(getattr(stage.wait().position, name) - place))
    unit, scale = axis.unit, axis.scale
    text = f"{step * scale:+.3g} {unit} and back, off by {off * scale:.4f} {unit}"
    lost = off > _POSITION_TOLERANCE[unit]
    remedy = f"the axis does not reach its target; check {axis.letter} and its steps per unit" if lost else ""
    return _rated("move", f"{name} ({axis.letter})", text, remedy, "failed")
