"""``mirrorskin check``: whether frames and their positions are plausible."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import FORMATS, RECORDING, stack_options


def command(
    recording: Annotated[Path, Argument(metavar="FRAMES", help=f"Frames: {FORMATS}.")],
    field: Annotated[
        str, Option(metavar="LEAST,MOST", help="Plausible sides of the field of view.")
    ] = "0.05mm,200mm",
    extent: Annotated[
        str, Option(metavar="LEAST,MOST", help="Plausible travel of a press.")
    ] = "0.005mm,20mm",
    memory: options.Memory = "256MB",
    strict: options.Strict = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, RECORDING],
) -> None:
    """Check whether frames and their positions are plausible.

    The brightness of a grid of pixels in all frames shows their order, the light and the noise, and frames
    that are missing or repeated; lengths, times and the file show the rest. A press or a rotation is compared
    with the calibration of its sensor. With --strict, warnings end the command with exit code 2.
    """
    from mirrorskin import io
    from mirrorskin.cli.defaults import calibration_of, with_pixel_size
    from mirrorskin.cli.output import make_strict, print_json, printable, progress
    from mirrorskin.cli.quantity import lengths
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.engine.calibration import compare_brightness
    from mirrorskin.io.base.findings import in_process, warn

    sides, travels = lengths(field, "--field"), lengths(extent, "--extent")
    stack = stack_options(chosen)
    with (
        io.open_recording(recording, memory_limit=bytes_of(memory, "--memory"), **stack) as source,
        progress("checking", source.shape[0]) as show,
    ):
        opened = with_pixel_size(source)
        report = io.check(opened, field_limits=sides, travel_limits=travels, progress=show)
        change = compare_brightness(opened, calibration_of(opened, None))
    if change is not None:
        report = replace(report, findings=(*report.findings, change))
    if as_json:
        print_json(report)
    else:
        for line in str(report).splitlines():
            click.echo(printable(line))
    if strict:
        make_strict(strict)
        warn(report.name, in_process(report.warnings, {}))
