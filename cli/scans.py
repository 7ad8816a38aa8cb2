"""What a rig is to do: the options that capture and live share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli.groups import Argument, Option

if TYPE_CHECKING:
    from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, Plan, RockPlan, TwistPlan, VerticalPlan
    from mirrorskin.hw.rig.rig import Rig
    from mirrorskin.hw.rig.scan import StepScan
    from mirrorskin.hw.rig.sweep import SweepScan
    from mirrorskin.hw.rig_file import RigSettings
    from mirrorskin.io import Calibration, StreamRecorder

SETTLE = "100ms"
"""From rest to the first exposure of a step."""

_START = "0mm"
_TILT = "2.5deg"
_TURNS = 1.0
_DIRECTION = _PHASE = "0deg"
_WAIT = "500ms"


class ScanName(StrEnum):
    """Motions that a rig can do."""

    vertical = "vertical"
    axial = "axial"
    horizontal = "horizontal"
    twist = "twist"


def _option(metavar: str, text: str, default: str | float | None = None) -> Any:
    return Option(metavar=metavar, help=text, show_default=False if default is None else str(default))


Motion = Annotated[ScanName, Argument(help="How the body moves.")]
RigFile = Annotated[
    Path, Option("--rig", metavar="RIG.toml", help="Rig file; 'mirrorskin rig new' writes a template.")
]
Start = Annotated[str | None, _option("LENGTH", "Vertical: first travel.", _START)]
Stop = Annotated[str | None, _option("LENGTH", "Vertical: last travel, deeper than the first.")]
Strokes = Annotated[
    int | None, Option(min=2, metavar="N", help="Vertical: go down and up, so many ways together.")
]
StrokeDepth = Annotated[
    str | None, _option("LENGTH", "Vertical, with --strokes: their depth, in place of --start.")
]
Step = Annotated[
    str | None, _option("LENGTH", "But axial, in steps: from place to place; of a twist an angle, 1deg.")
]
Speed = Annotated[
    str | None, _option("LENGTH/s", "But axial, without a halt: 0.5mm/s; of a twist an angle, 2deg/s.")
]
Press = Annotated[str | None, _option("LENGTH", "But vertical: how far the body is lowered.")]
Distance = Annotated[str | None, _option("LENGTH", "Horizontal: how far the body slides.")]
Direction = Annotated[str | None, _option("ANGLE", "Horizontal: from x towards y, where to.", _DIRECTION)]
Angle = Annotated[
    str | None, _option("ANGLE", "Twist: how far the body turns, counter-clockwise, or back if negative.")
]
Wait = Annotated[
    str | None, _option("TIME", "Horizontal and twist: at rest, pressed, before the body moves.", _WAIT)
]
Tilt = Annotated[str | None, _option("ANGLE", "Axial: half-angle of the precession.", _TILT)]
Rock = Annotated[
    bool, Option("--rock", help="Axial: from one side to the other, with --step or --speed as of a twist.")
]
Phase = Annotated[str | None, _option("ANGLE", "Axial, with --rock: where it leans to.", _PHASE)]
Turns = Annotated[float | None, _option("N", "Axial: how often it goes round.", 1)]
PhaseStep = Annotated[str | None, _option("ANGLE", "Axial, in steps: from place to place, 45deg.")]
Rate = Annotated[float | None, _option("HZ", "Axial, without a halt: turns a second.")]
Settle = Annotated[str | None, _option("TIME", "In steps: from rest to the first exposure.", SETTLE)]
StepFrames = Annotated[int | None, Option("--frames", min=1, help="In steps: at each place.")]


# The motions of an option that not all have; threshold, hold and window are live's.
_OF: Mapping[str, str] = {
    **dict.fromkeys(("start", "stop", "strokes", "stroke_depth", "threshold", "hold"), "vertical"),
    **dict.fromkeys(("step", "speed"), "vertical horizontal twist rock"),
    **dict.fromkeys(("turns", "phase_step", "rate", "window"), "axial"),
    "tilt": "axial rock",
    "phase": "rock",
    "press": "axial rock horizontal twist",
    **dict.fromkeys(("distance", "direction"), "horizontal"),
    "angle": "twist",
    **dict.fromkeys(("wait", "contact"), "horizontal twist"),
}


def make_plan(words: Mapping[str, Any], settings: RigSettings) -> Plan:
    """Turn a command's options into a plan that the rig can do."""
    from mirrorskin.hw.rig.plans import check_plan
    from mirrorskin.io import InputError

    motion, rock = str(words["motion"]), words.get("rock")
    if rock and motion != "axial":
        raise InputError(f"--rock says nothing of a motion that is {motion}: leave it out, or choose axial")
    kind = "rock" if rock else motion
    foreign = [name for name, of in _OF.items() if words.get(name) is not None and kind not in of.split()]
    if foreign:
        raise InputError(
            f"--{foreign[0].replace('_', '-')} says nothing of a motion that is {kind}:"
            " leave it out, or choose the other"
        )
    makers = {
        "vertical": _vertical,
        "axial": _axial,
        "rock": _rock,
        "horizontal": _horizontal,
        "twist": _twist,
    }
    plan: Plan = makers[kind](words)
    check_steps(plan, words["settle"], words["frames"])
    check_plan(plan, settings.stage, settings.name)
    return plan


def make_scan(
    rig: Rig, plan: Plan, settle: str | None, frames: int | None, turn_frames: int | None = None
) -> StepScan | SweepScan:
    """Join a rig and a plan to a source of frames; see ``StepScan`` and ``SweepScan``."""
    from mirrorskin.cli.quantity import duration
    from mirrorskin.hw.rig.scan import StepScan
    from mirrorskin.hw.rig.sweep import SweepScan

    check_steps(plan, settle, frames)
    if plan.in_steps:
        return StepScan(rig, plan, duration(settle or SETTLE, "--settle"), frames or 1)
    return SweepScan(rig, plan, turn_frames)


def check_steps(plan: Plan, settle: str | None, frames: int | None) -> None:
    """Refuse options of steps where the body does not halt; to be asked before a rig is opened."""
    from mirrorskin.cli.quantity import duration
    from mirrorskin.io import InputError

    if settle is not None and duration(settle, "--settle") < 0:
        raise InputError(f"--settle {settle}: a time is 0 or more")
    for name, value in (("--settle", settle), ("--frames", frames)):
        if value is not None and not plan.in_steps:
            raise InputError(f"{name} says nothing of a motion without a halt: leave it out, or give a step")


def open_calibration(path: Path | None, settings: RigSettings) -> Calibration | None:
    """Open a calibration, if there is one, and refuse that of another camera before anything moves."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.io.calibration.source import check_camera

    if path is None:
        return None
    calibration, camera = io.open_calibration(path), settings.camera
    known = io.CameraId(camera.name, camera.shape, np.dtype(camera.dtype))
    check_camera(calibration, known, settings.name)
    return calibration


@contextmanager
def kept(recorder: StreamRecorder | None) -> Iterator[None]:
    """Report which frames of a recording that was cut short were kept, and where; the exit code is 1."""
    from mirrorskin.hw.errors import HardwareError
    from mirrorskin.io import InputError
    from mirrorskin.io.layout import COMPLETE

    try:
        yield
    except (HardwareError, InputError) as error:
        if recorder is None or not recorder.count or recorder.state == COMPLETE:
            raise
        raise HardwareError(f"{error}; {_remains(recorder)}") from error
    except (KeyboardInterrupt, SystemExit):
        if recorder is not None and recorder.count:
            click.echo(_remains(recorder), err=True)
        raise


def _remains(recorder: StreamRecorder) -> str:
    if not recorder.written:
        return f"of {recorder.path} nothing was written"
    older = "" if recorder.file == recorder.path else f"; the older {recorder.path} is unchanged"
    return f"{recorder.file} was cut short and holds {recorder.written} frames{older}"


def _vertical(words: Mapping[str, Any]) -> VerticalPlan:
    from mirrorskin.cli.quantity import length
    from mirrorskin.hw.rig.plans import VerticalPlan
    from mirrorskin.io import InputError

    stop = length(_needed(words["stop"], "--stop", "2mm"), "--stop")
    strokes, depth = words["strokes"], words["stroke_depth"]
    if depth is None:
        start = length(words["start"] or _START, "--start")
    elif strokes is None or words["start"] is not None:
        raise InputError("--stroke-depth needs --strokes, and takes the place of --start")
    else:
        start = stop - length(depth, "--stroke-depth")
    return VerticalPlan(start, stop, strokes=strokes or 1, **_pace(words, length, "0.5mm/s"))


def _rock(words: Mapping[str, Any]) -> RockPlan:
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.hw.rig.plans import RockPlan

    return RockPlan(
        length(_needed(words["press"], "--press", "1mm"), "--press"),
        angle(words["tilt"] or _TILT, "--tilt"),
        angle(words["phase"] or _PHASE, "--phase"),
        **_pace(words, angle, "2deg/s"),
    )


def _horizontal(words: Mapping[str, Any]) -> HorizontalPlan:
    from mirrorskin.cli.quantity import angle, duration, length
    from mirrorskin.hw.rig.plans import HorizontalPlan

    return HorizontalPlan(
        length(_needed(words["press"], "--press", "1mm"), "--press"),
        length(_needed(words["distance"], "--distance", "0.5mm"), "--distance"),
        angle(words["direction"] or _DIRECTION, "--direction"),
        wait=duration(words["wait"] or _WAIT, "--wait"),
        **_pace(words, length, "0.5mm/s"),
    )


def _twist(words: Mapping[str, Any]) -> TwistPlan:
    from mirrorskin.cli.quantity import angle, duration, length
    from mirrorskin.hw.rig.plans import TwistPlan

    return TwistPlan(
        length(_needed(words["press"], "--press", "1mm"), "--press"),
        angle(_needed(words["angle"], "--angle", "10deg"), "--angle"),
        wait=duration(words["wait"] or _WAIT, "--wait"),
        **_pace(words, angle, "2deg/s"),
    )


def _axial(words: Mapping[str, Any]) -> AxialPlan:
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.hw.rig.plans import AxialPlan

    step, turns = words["phase_step"], words["turns"]
    return AxialPlan(
        length(_needed(words["press"], "--press", "1mm"), "--press"),
        angle(words["tilt"] or _TILT, "--tilt"),
        _TURNS if turns is None else turns,
        None if step is None else angle(step, "--phase-step"),
        words["rate"],
    )


def _pace(words: Mapping[str, Any], quantity: Callable[[str, str], float], example: str) -> dict[str, Any]:
    """Read the step and the speed, as in ``0.5mm/s``, of which one is given, in mm or rad."""
    from mirrorskin.io import InputError

    step, speed = words["step"], words["speed"]
    found = {"step": None if step is None else quantity(step, "--step"), "speed": None}
    if speed is not None:
        distance, slash, second = speed.strip().rpartition("/")
        if not slash or second.strip() != "s":
            raise InputError(f"--speed {speed}: so much each second is needed; write e.g. {example}")
        found["speed"] = quantity(distance, "--speed")
    return found


def _needed(value: str | None, option: str, example: str) -> str:
    from mirrorskin.io import InputError

    if value is None:
        raise InputError(f"{option} is missing: say how far the body goes, as in {option} {example}")
    return value
