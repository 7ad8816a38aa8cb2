"""``mirrorskin measure``: numbers of a height map, with their uncertainties."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import print_fields, print_json
from mirrorskin.cli.stack import STACK


class FormName(StrEnum):
    """What is fitted to the surface."""

    plane = "plane"
    sphere = "sphere"
    none = "none"


def command(
    result: options.ResultFile,
    turn: options.Turn = None,
    form: Annotated[
        FormName | None,
        Option(
            help="What to fit, and to measure roughness from.",
            show_default="sphere where it fits much better, else plane",
        ),
    ] = None,
    cutoff: Annotated[
        str | None,
        Option(metavar="LENGTH", help="Leave waves longer than that out of the roughness: 0.8mm."),
    ] = None,
    section: Annotated[
        str | None,
        Option(
            metavar="X1,Y1:X2,Y2",
            help="Measure lengths, slope and step between two points, from the picture's centre:"
            " -2mm,0mm:2mm,0mm.",
        ),
    ] = None,
    as_json: options.Json = False,
    **given: Annotated[Any, STACK.only("region")],
) -> None:
    """Measure a height map: heights, areas, volumes, plane or sphere, roughness, steps."""
    from mirrorskin import engine, io
    from mirrorskin.cli import quantity

    measures = engine.measure(
        io.select_turn(io.open_result(result), turn),
        region=given.get("region"),
        form=None if form is None else form.value,
        cutoff=None if cutoff is None else quantity.length(cutoff, "--cutoff"),
        section=None if section is None else quantity.segment(section, "--section"),
    )
    if as_json:
        print_json(measures)
        return
    print_fields(measures.quantities)
    click.echo()
    for note in measures.notes:
        click.echo(note)
