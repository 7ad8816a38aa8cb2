"""``mirrorskin calibrate check``: what errors are left on a ball that the calibration has not seen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option


def command(
    recording: Annotated[
        Path, Argument(metavar="REC.h5", help="A ball pressed, or rotated about, that was not used.")
    ],
    calibration: Annotated[Path, Option(metavar="CAL.h5", help="Calibration to check.")],
    ball: Annotated[str, Option(metavar="LENGTH", help="Diameter of the ball: 6mm.")],
    cells: Annotated[int, Option(metavar="N", help="Cells a side into which the field is cut.")] = 8,
    picture: Annotated[
        Path | None, Option("--output", "-o", metavar="PNG", help="Picture of the errors to write.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Show the remaining errors over the field, in mm and degrees, before and after the calibration."""
    from mirrorskin import io
    from mirrorskin.cli.output import print_json, print_table
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.check import check_ball
    from mirrorskin.view import check_drawing
    from mirrorskin.view.calibration import check_figure

    if picture is not None:
        check_drawing()
        io.check_output(picture, recording, calibration)
    known = io.open_calibration(calibration)
    with io.open_recording(recording) as source:
        found = check_ball(source, known, length(ball, "--ball"), cells=cells, device=device)
    if picture is not None:
        check_figure(found, f"{recording.name}: a ball of {ball}", picture)
    if as_json:
        print_json(found.numbers())
        return
    head = ("what", "when", "rms", "bias", "worst cell's rms", "expected", "pixels")
    print_table(head, found.table())
    for note in found.notes():
        click.echo(note)
    click.echo(f"ball of {found.ball:g} mm found at {found.place[0]:.3f}, {found.place[1]:.3f} mm")
