"""The plan of a rig's motion: the options that capture and live share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli.declared import Terms, term
from mirrorskin.cli.groups import Argument, Option, refuse_foreign
from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from mirrorskin.hw.base.rig_file import RigSettings
    from mirrorskin.hw.rig.plans import Plan
    from mirrorskin.hw.rig.scan import PlannedScan
    from mirrorskin.io import Calibration, StreamRecorder

SETTLE = 0.1
"""Seconds from rest to the first exposure, of a motion with stops."""


Motion = Annotated[MotionName, Argument(help="How the body moves.")]
RigFile = Annotated[
    Path, Option("--rig", metavar="RIG.toml", help="Rig file; 'mirrorskin rig new' writes a template.")
]
_PRESS, _TURN, _ROCK = ("vertical",), ("axial",), ("rock",)
_SIDEWAYS = ("horizontal", "twist")
_ALONG = (*_PRESS, *_SIDEWAYS, *_ROCK)

PLAN = Terms(
    [
        term("start", "first travel", "mm", "0mm", motions=_PRESS),
        term("stop", "last travel, deeper than the first", "mm", motions=_PRESS),
        term("strokes", "this number of strokes down and up", kind="integer", least=2, motions=_PRESS),
        term("stroke_depth", "depth of the strokes, in place of --start", "mm", motions=_PRESS),
        term(
            "step",
            "distance between the places where it stops; of a twist or rocking an angle, 1deg",
            "LENGTH",
            kind="text",
            motions=_ALONG,
        ),
        term(
            "speed",
            "speed of a motion without stops, 0.5mm/s; of a twist or rocking an angle, 2deg/s",
            "LENGTH/s",
            kind="text",
            motions=_ALONG,
        ),
        term("press", "travel at which the body moves", "mm", motions=(*_TURN, *_ROCK, *_SIDEWAYS)),
        term("distance", "how far the body slides", "mm", motions=("horizontal",)),
        term("direction", "direction of the slide, from x towards y", "rad", "0deg", motions=("horizontal",)),
        term("angle", "counter-clockwise angle of the twist", "rad", motions=("twist",)),
        term("wait", "time at rest, pressed, before the body moves", "s", "500ms", motions=_SIDEWAYS),
        term("tilt", "half-angle of the precession", "rad", "2.5deg", motions=(*_TURN, *_ROCK)),
        term(
            "rock",
            "lean from one side to the other, with --step or --speed as of a twist",
            kind="switch",
            motions=(*_TURN, *_ROCK),
        ),
        term("phase", "with --rock: direction of leaning", "rad", "0deg", motions=_ROCK),
        term("turns", "number of turns", default="1", motions=_TURN),
        term("phase_step", "angle between the places where it stops, 45deg", "rad", motions=_TURN),
        term("rate", "turns a second, of a motion without stops", "Hz", motions=_TURN),
        term("settle", "with stops: time from rest to the first exposure", "s", f"{SETTLE * 1000:g}ms"),
        term("frames", "with stops: frames at each place", kind="integer", least=1),
    ]
)
"""The options of a plan."""


def make_plan(context: click.Context, chosen: Mapping[str, Any], settings: RigSettings) -> Plan:
    """Return the plan described by a command's options; the rig can follow it."""
    from mirrorskin.hw.rig.plans import check_plan

    motion = str(context.params["motion"])
    kind = "rock" if chosen.get("rock") and motion == "axial" else motion
    refuse_foreign(context, kind)
    plan = _plan(kind, PLAN.filled(chosen), chosen)
    check_steps(plan, chosen)
    check_plan(plan, settings.stage, settings.name)
    return plan


def check_steps(plan: Plan, chosen: Mapping[str, Any]) -> None:
    """Raise InputError for options of motions with stops if the motion has none."""
    from mirrorskin.io import InputError

    if chosen.get("settle", 0) < 0:
        raise InputError(f"--settle {chosen['settle']:g}s: a time of at least 0 is needed")
    for name in ("settle", "frames"):
        if name in chosen and not plan.in_steps:
            raise InputError(f"--{name} needs a motion with stops. Remove it, or give a step")


def open_calibration(path: Path | None, settings: RigSettings) -> Calibration | None:
    """Open a calibration, if one is given; InputError for another camera, before anything moves."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.io.model.calibrated import check_camera

    if path is None:
        return None
    calibration, camera = io.open_calibration(path), settings.camera
    camera_id = io.CameraId(camera.name, camera.shape, np.dtype(camera.dtype))
    check_camera(calibration, camera_id, settings.name)
    return calibration


def check_recording(
    planned: PlannedScan,
    path: Path,
    *inputs: Path | None,
    calibration: Calibration | None = None,
    overwrite: bool = False,
) -> None:
    """Raise InputError for a recording of a scan that could not be written, before the rig is opened."""
    from mirrorskin import io

    io.check_output(path, *inputs, replaces="anything" if overwrite else "nothing")
    io.StreamRecorder(planned, path, calibration=calibration)


@contextmanager
def kept(recorder: StreamRecorder | None) -> Iterator[None]:
    """Report which frames of an interrupted recording were kept, and where; the exit code is 1."""
    from mirrorskin.hw.base.errors import HardwareError
    from mirrorskin.io import InputError
    from mirrorskin.io.storage.layout import COMPLETE

    try:
        yield
    except (HardwareError, InputError) as error:
        if recorder is None or not recorder.count or recorder.state == COMPLETE:
            raise
        raise HardwareError(f"{error}; {_remains(recorder)}") from None
    except (KeyboardInterrupt, SystemExit):
        if recorder is not None and recorder.count:
            click.echo(_remains(recorder), err=True)
        raise


def _remains(recorder: StreamRecorder) -> str:
    if not recorder.written:
        return f"of {recorder.path} nothing was written"
    older = "" if recorder.file == recorder.path else f"; the older {recorder.path} is unchanged"
    return f"{recorder.file} was cut short and holds {recorder.written} frames{older}"


def _plan(kind: str, values: Mapping[str, Any], chosen: Mapping[str, Any]) -> Plan:
    from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan, VerticalPlan
    from mirrorskin.io import InputError

    if kind == "vertical":
        start, stop = values["start"], _needed(chosen, "stop", "2mm")
        if "stroke_depth" in chosen:
            if "strokes" not in chosen or "start" in chosen:
                raise InputError("--stroke-depth needs --strokes, and takes the place of --start")
            start = stop - chosen["stroke_depth"]
        return VerticalPlan(start, stop, strokes=chosen.get("strokes", 1), **_pace(chosen, "mm", "0.5mm/s"))
    press = _needed(chosen, "press", "1mm")
    if kind == "axial":
        return AxialPlan(press, *(values[name] for name in ("tilt", "turns", "phase_step", "rate")))
    if kind == "rock":
        return RockPlan(press, values["tilt"], values["phase"], **_pace(chosen, "rad", "2deg/s"))
    if kind == "horizontal":
        distance, pace = _needed(chosen, "distance", "0.5mm"), _pace(chosen, "mm", "0.5mm/s")
        return HorizontalPlan(press, distance, values["direction"], wait=values["wait"], **pace)
    angle, pace = _needed(chosen, "angle", "10deg"), _pace(chosen, "rad", "2deg/s")
    return TwistPlan(press, angle, wait=values["wait"], **pace)


def _pace(chosen: Mapping[str, Any], unit: str, example: str) -> dict[str, Any]:
    """Return the step or the speed, such as ``0.5mm/s``, in mm or rad."""
    from mirrorskin.cli import quantity
    from mirrorskin.io import InputError

    read = quantity.length if unit == "mm" else quantity.angle
    pace: dict[str, Any] = {
        "step": read(chosen["step"], "--step") if "step" in chosen else None,
        "speed": None,
    }
    if "speed" in chosen:
        distance, slash, second = chosen["speed"].strip().rpartition("/")
        if not slash or second.strip() != "s":
            raise InputError(
                f"--speed {chosen['speed']}: a distance or angle per second is needed; write e.g. {example}"
            )
        pace["speed"] = read(distance, "--speed")
    return pace


def _needed(chosen: Mapping[str, Any], name: str, example: str) -> float:
    from mirrorskin.io import InputError

    if name not in chosen:
        raise InputError(f"--{name} is missing: write e.g. --{name} {example}")
    return float(chosen[name])
