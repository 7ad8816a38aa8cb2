"""``mirrorskin touch``: press and turn until the surface is good enough."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options, scans
from mirrorskin.cli.groups import Option

if TYPE_CHECKING:
    from mirrorskin.engine.live import Taken
    from mirrorskin.hw.rig.touch import RigTouch
    from mirrorskin.io import Calibration, Result


def command(
    rig_file: scans.RigFile,
    sigma: Annotated[str, Option(metavar="LENGTH", help="Requested standard deviation of heights: 2um.")],
    output: Annotated[Path, Option("--output", "-o", metavar="RES.h5", help="Surface to write.")],
    share: Annotated[
        str, Option(metavar="PERCENT", help="Share of the pixels with normals that must have it.")
    ] = "95%",
    within: Annotated[
        str | None, Option(metavar="TIME", help="End after this time: 20s.", show_default="no limit")
    ] = None,
    region: Annotated[
        str | None,
        Option(
            metavar="X,Y,WxH",
            help="Only W x H pixels, from column X and row Y on, must have it; the press is as deep as their"
            " contact needs.",
            show_default="all of it",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        Option(
            "--record",
            metavar="REC.h5",
            help="Recording of all frames; 'fuse REC.h5' repeats the surface.",
            show_default="RES-frames.h5",
        ),
    ] = None,
    press: Annotated[
        str | None,
        Option(metavar="LENGTH", help="Greatest travel.", show_default="the limit of the rig file"),
    ] = None,
    start: Annotated[
        str | None,
        Option(
            "--from",
            metavar="LENGTH",
            help="Travel without contact at which the search starts.",
            show_default="the least of its limits",
        ),
    ] = None,
    tilt: Annotated[str, Option(metavar="ANGLE", help="Half-angle of the turn.")] = "2.5deg",
    overwrite: options.Overwrite = False,
    calibration: options.Calibration = None,
    device: options.Devices = None,
    as_json: options.Json = False,
) -> None:
    """Press and turn until the surface has the requested standard deviation; keep all frames."""
    from mirrorskin import engine, io
    from mirrorskin.cli import quantity
    from mirrorskin.cli.output import printable, report_notes, report_saved
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.rig import open_rig
    from mirrorskin.hw.rig.touch import RigTouch, touch_plan

    settings = load_rig(rig_file)
    frames_file = record or output.with_name(f"{output.stem}-frames.h5")
    requested, part = quantity.length(sigma, "--sigma"), _share(share)
    limit = math.inf if within is None else quantity.duration(within, "--within")
    deepest = None if press is None else quantity.length(press, "--press")
    first = None if start is None else quantity.length(start, "--from")
    lean = quantity.angle(tilt, "--tilt")
    part_of = None if region is None else quantity.region(region, "--region")
    if part_of is not None:
        part_of.check(settings.camera.shape, "--region")
    touch_plan(settings, deepest, first, lean)
    io.check_result_output(output, rig_file, calibration, frames_file, overwrite=overwrite)
    kept = (rig_file, calibration, output)
    io.check_output(frames_file, *kept, replaces="anything" if overwrite else "nothing")
    if frames_file.resolve() == output.resolve():
        raise io.InputError(f"--record and -o are both {output}: name two files")
    calibrated = scans.open_calibration(calibration, settings)
    taken: list[Taken] = []

    def show(text: str, result: Result | None) -> None:
        click.echo(printable(f"{settings.name}: {text}"), err=True)

    with open_rig(settings, steps=True) as rig:
        sensor = RigTouch(rig, deepest, first, lean)
        try:
            with sensor:
                outcome = engine.live.touch(
                    sensor,
                    requested,
                    share=part,
                    within=limit,
                    region=part_of,
                    calibration=calibrated,
                    device=device,
                    taken=taken,
                    on_update=show,
                )
        finally:
            _keep(sensor, taken, frames_file, calibrated, overwrite)
    io.save_result(outcome.result, output, overwrite=overwrite)
    report_notes(settings.name, outcome.result.process)
    report_saved(outcome.result, output, device, as_json)
    click.echo(printable(f"{settings.name}: {outcome}"), err=as_json)


def _keep(
    sensor: RigTouch, taken: list[Taken], path: Path, calibration: Calibration | None, overwrite: bool
) -> None:
    """Write all frames, also of a touch that failed."""
    from mirrorskin import engine, io

    press, turn = engine.live.recordings_of(sensor, taken)
    if press is None:
        click.echo(f"of {path} nothing was written", err=True)
        return
    io.save_touch(path, press, turn, calibration=calibration, overwrite=overwrite)
    frames = press.shape[0] + (0 if turn is None else turn.shape[0])
    click.echo(f"{path}: {frames} frames", err=True)


def _share(text: str) -> float:
    """Return a share, such as ``95%`` or ``0.95``."""
    from mirrorskin.cli.quantity import number

    percent = text.strip().endswith("%")
    return number(text.strip().removesuffix("%").strip(), "--share") / (100 if percent else 1)
