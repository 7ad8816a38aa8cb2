"""``mirrorskin calibrate show``: numbers and pictures of a calibration."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option

if TYPE_CHECKING:
    from mirrorskin.io.model.parameters import Row

_HEAD = "part", "what", "value", "standard error", "unit"
_NUMBERS = "value", "standard error"


def command(
    calibration: Annotated[
        Path, Argument(metavar="CAL.h5", help="Calibration, or a recording or result that has one.")
    ],
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar="DIR", help="Folder for pictures of all maps."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Print a calibration's numbers with their standard errors, and draw its maps."""
    from mirrorskin import io
    from mirrorskin.cli.output import print_json
    from mirrorskin.view import check_drawing
    from mirrorskin.view.calibration import calibration_figures

    if output is not None:
        check_drawing()
    parts = io.open_calibration(calibration)
    rows = list(parts.rows())
    pictures = [] if output is None else calibration_figures(parts, output)
    if as_json:
        print_json(
            {
                "calibration": str(calibration),
                "numbers": [row._asdict() | {"unit": row.unit.replace("µ", "u")} for row in rows],  # ASCII
                "process": dict(parts.process),
                "pictures": list(map(str, pictures)),
            }
        )
        return
    _print(str(calibration), rows)
    notes = (str(text).split("; ") for name, text in parts.process.items() if name.endswith(".notes"))
    for note in dict.fromkeys(itertools.chain.from_iterable(notes)):
        if note:
            click.echo(f"note: {note}")
    if output is not None:
        click.echo(f"{output}: {', '.join(path.name for path in pictures) or 'nothing to draw'}")


def _print(name: str, rows: Sequence[Row]) -> None:
    from mirrorskin.cli.output import print_table, printable

    cells = [row.cells() for row in rows]
    if not sys.stdout.isatty():
        print_table(_HEAD, cells)
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(printable(name)), box=None, pad_edge=False, title_justify="left", title_style="bold"
    )
    for head in _HEAD:
        table.add_column(head, justify="right" if head in _NUMBERS else "left")
    before = ""
    for part, *others in [[printable(cell) for cell in row] for row in cells]:
        table.add_row(Text("" if part == before else part, style="bold cyan"), *map(Text, others))
        before = part
    Console().print(table)
