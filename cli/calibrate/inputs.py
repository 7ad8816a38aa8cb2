"""What a part of a calibration is found out from: presses that are named, or taken on a rig."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorskin.cli import scans

if TYPE_CHECKING:
    from mirrorskin.cli.stack import StackOptions
    from mirrorskin.hw.rig.plans import AxialPlan, Plan, VerticalPlan
    from mirrorskin.hw.rig.rig import Rig
    from mirrorskin.io import Calibration, CameraId, Source


def check_call(paths: Sequence[Path], rig: Path | None, **asked: str | None) -> None:
    """Refuse presses that are neither named nor taken, or both, and what a rig is asked for without one."""
    from mirrorskin.io import InputError

    if rig is None and not paths:
        raise InputError("no recordings: name those of a ball, or take them with --rig RIG.toml")
    if rig is not None and paths:
        raise InputError("recordings and --rig both give the presses: leave one of them out")
    for name, value in asked.items():
        if rig is None and value is not None:
            raise InputError(f"--{name} says how a rig is to press: give --rig, too, or leave it out")


def with_scale(told: StackOptions, known: Calibration | None) -> StackOptions:
    """Return what recordings are opened with, and the pixel size of the calibration's scale, if any."""
    from mirrorskin.io import InputError
    from mirrorskin.io.calibration.source import differ

    if known is None or known.lens is None:
        return told
    size, given = known.lens.pixel_size, told.get("pixel_size", known.lens.pixel_size)
    if differ(given, size):
        raise InputError(
            f"--pixel-size says {given[0]:.5g} mm, the scale of {known.name} {size[0]:.5g} mm: leave it out"
        )
    return told | {"pixel_size": size}


def camera_of(source: Source) -> CameraId:
    """Return the camera that a recording is of."""
    from mirrorskin.io import CameraId

    _, rows, columns = source.shape
    return CameraId(source.header.camera, (rows, columns), source.dtype)


def one_camera(
    names_of: Sequence[str], cameras: Sequence[CameraId], known: Calibration | None, output: Path
) -> CameraId:
    """Return the camera that all recordings are of, if it is that of the calibration."""
    from mirrorskin import io

    names = {camera.name for camera in cameras} - {""}
    if len(names) > 1:
        raise io.InputError(f"the recordings are of {' and '.join(sorted(names))}: take all with one camera")
    first = cameras[0]
    for name, camera in zip(names_of, cameras, strict=True):
        if (camera.shape, camera.dtype) != (first.shape, first.dtype):
            raise io.InputError(f"{name} is of {camera}, {names_of[0]} of {first}: take all with one camera")
    one = io.CameraId("".join(names), first.shape, first.dtype)
    if known is not None:
        io.check_camera(known, one, names_of[0], f"name another file than {output} with -o")
    return one


TILT, _STEP = "2.5deg", "45deg"
BALL = "put the ball at place {} of {}, all over the field"

_TOGETHER = 16
"""Frames that are read at a time, at most."""

_STILL = 0.05
"""How far the body moves in a recording in which it stands still, mm: a press has two steps at least."""

OptionalRig = Annotated[
    Path | None,
    typer.Option(
        "--rig", metavar="RIG.toml", help="Take what is needed first, on this rig; see docs/rig.md."
    ),
]
Settle = scans.Settle


@dataclass(frozen=True, slots=True)
class Place:
    """A recording that is to be taken."""

    name: str  # What the recording's file is told apart by: "dark", "ball-1"
    prompt: str  # What the user is to do before: "put the ball at place 1 of 9"
    plan: Plan  # What the body does then
    frames: int = 1  # At each step of a plan in steps


def take(rig_file: Path, calibration: Path, places: Sequence[Place], settle: str | None = None) -> list[Path]:
    """Take recordings, and keep them beside the calibration file.

    The body is lifted, then the user is asked to make each place ready and to press Enter.
    """
    from mirrorskin import io
    from mirrorskin.hw.rig.plans import check_plan
    from mirrorskin.hw.rig.rig import open_rig
    from mirrorskin.hw.rig_file import load_rig

    settings = load_rig(rig_file)
    paths = [calibration.with_name(f"{calibration.stem}-{place.name}.h5") for place in places]
    for place, path in zip(places, paths, strict=True):
        check_plan(place.plan, settings.stage, settings.name)
        io.check_output(path, rig_file)
    with open_rig(settings) as rig:
        for place, path in zip(places, paths, strict=True):
            _take_one(rig, place, path, settle)
    return paths


def at_each(part: str, prompt: str, count: int, plan: Plan, frames: int = 1) -> list[Place]:
    """Say that the same is to be done at several places."""
    numbers = range(1, count + 1)
    return [Place(f"{part}-{n}", prompt.format(n, count), plan, frames) for n in numbers]


def turn_plan(press: str | None, tilt: str | None, phase_step: str | None, example: str) -> AxialPlan:
    """Return the plan of a turn on a ball: eight steps and a tilt of 2.5 degrees unless given."""
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.hw.rig.plans import AxialPlan
    from mirrorskin.io import InputError

    if press is None:
        raise InputError(
            f"--press is missing: say how far the body is lowered on the ball, as in --press {example}"
        )
    return AxialPlan(
        length(press, "--press"),
        angle(tilt or TILT, "--tilt"),
        phase_step=angle(phase_step or _STEP, "--phase-step"),
    )


def still_plan(rig_file: Path, travel: float | None = None) -> VerticalPlan:
    """Return a plan in which the body all but stands still: two steps of 0.05 mm."""
    from mirrorskin.hw.rig.plans import VerticalPlan
    from mirrorskin.hw.rig_file import load_rig

    start = load_rig(rig_file).stage.limits.travel[0] if travel is None else travel - _STILL
    return VerticalPlan(start, start + _STILL, step=_STILL)


def _take_one(rig: Rig, place: Place, path: Path, settle: str | None) -> None:
    """Lift the body, have the user make the place ready, and record it."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.cli.output import progress

    frames = place.frames if place.plan.in_steps else None
    scan = scans.make_scan(rig, place.plan, settle if place.plan.in_steps else None, frames)
    scan.lift()
    _wait_for_enter(place.prompt)
    recorder = io.StreamRecorder(scan, path)
    with scans.kept(recorder), recorder, progress(place.name, recorder.shape[0]) as show:
        room = np.empty((_TOGETHER, *recorder.shape[1:]), recorder.dtype)
        while recorder.read(room) is not None:
            show(recorder.count)


def _wait_for_enter(prompt: str) -> None:
    """Ask the user to make something ready; without anyone to ask, stop as at Ctrl-C."""
    typer.echo(f"{prompt}, then press Enter", err=True)
    if not sys.stdin.readline():
        raise typer.Abort
