"""``mirrorskin calibrate``: from brightness to degrees and from pixels to millimetres."""

from __future__ import annotations

import typer

from mirrorskin.cli.calibrate import board, check, elastic, references, scale, show, tilt, zenith
from mirrorskin.cli.groups import Group

app = typer.Typer(
    cls=Group,
    help="Find out what a sensor's counts and pixels mean; docs/calibration.md tells in which order.",
    no_args_is_help=True,
)

for module in (references, board, scale, zenith, tilt, elastic, check, show):
    app.command(module.__name__.rsplit(".", 1)[-1])(module.command)
