"""``mirrorskin calibrate check``: errors that remain on a ball that was not used for the calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK


def command(
    recording: Annotated[
        Path, Argument(metavar="REC.h5", help="A press or rotation of a ball that was not used.")
    ],
    calibration: Annotated[Path, Option(metavar="CAL.h5", help="Calibration to check.")],
    ball: Annotated[str, Option(metavar="LENGTH", help="Diameter of the ball: 6mm.")],
    cells: Annotated[int, Option(metavar="N", help="Number of cells along each side of the field.")] = 8,
    picture: Annotated[
        Path | None, Option("--output", "-o", metavar="PNG", help="Picture of the errors.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("verify")],
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
    with io.open_recording(recording, **stack) as source:
        parts = io.open_calibration(calibration), length(ball, "--ball")
        errors = check_ball(source, *parts, cells=cells, device=device)
    if picture is not None:
        check_figure(errors, f"{recording.name}: a ball of {ball}", picture)
    if as_json:
        print_json(errors.numbers())
        return
    print_table(("what", "when", "rms", "bias", "worst cell's rms", "expected", "pixels"), errors.table())
    for note in errors.notes():
        click.echo(note)
    click.echo(f"ball of {errors.ball:g} mm found at {errors.place[0]:.3f}, {errors.place[1]:.3f} mm")
