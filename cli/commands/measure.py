"""``mirrorskin measure``: measures of a height map, with their uncertainties."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import print_json, print_table, printable
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.metrology import Measures

_EXPANDED = ("± is the standard uncertainty (k = 1)", "± is the expanded uncertainty (k = 2)")


class FormName(StrEnum):
    """Form that is fitted to the surface."""

    plane = "plane"
    sphere = "sphere"
    none = "none"


def command(
    result: options.ResultFile,
    turn: options.Turn = None,
    form: Annotated[
        FormName | None,
        Option(
            help="What to fit, and to remove before texture is measured.",
            show_default="sphere where it fits much better, else plane",
        ),
    ] = None,
    s_filter: Annotated[
        str | None, Option(metavar="LENGTH", help="Leave waves shorter than that out of the texture: 0.1mm.")
    ] = None,
    l_filter: Annotated[
        str | None, Option(metavar="LENGTH", help="Leave waves longer than that out of the texture: 0.8mm.")
    ] = None,
    section: Annotated[
        str | None,
        Option(
            metavar="X1,Y1:X2,Y2",
            help="Measure lengths, slope, step and profile between two points, from the picture's centre:"
            " -2mm,0mm:2mm,0mm.",
        ),
    ] = None,
    noise_length: Annotated[
        str | None,
        Option(
            metavar="LENGTH",
            help="Length over which errors of heights are correlated; 0mm: independent.",
            show_default="that of the result",
        ),
    ] = None,
    expanded: Annotated[
        bool, Option("--expanded", help="Print expanded uncertainties, k = 2, instead of standard ones.")
    ] = False,
    budget: Annotated[
        bool, Option("--budget", help="Print the contributions to each standard uncertainty.")
    ] = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, STACK.only("region")],
) -> None:
    """Measure a height map: heights, areas, volumes, plane or sphere, texture, profiles, steps."""
    from mirrorskin import engine, io
    from mirrorskin.cli import quantity

    measures = engine.measure(
        io.select_turn(io.open_result(result), turn),
        region=chosen.get("region"),
        form=None if form is None else form.value,
        s_filter=None if s_filter is None else quantity.length(s_filter, "--s-filter"),
        l_filter=None if l_filter is None else quantity.length(l_filter, "--l-filter"),
        section=None if section is None else quantity.segment(section, "--section"),
        noise_length=None if noise_length is None else quantity.length(noise_length, "--noise-length"),
    )
    if as_json:
        shown = {"quantities": measures.quantities, "notes": measures.notes}
        print_json(shown | ({"budget": measures.budget} if budget else {}))
        return
    _print_groups(measures, expanded)
    if budget:
        _print_budget(measures)
    click.echo()
    for note in measures.notes:
        click.echo(printable(note.replace(*_EXPANDED) if expanded else note))


def _print_groups(measures: Measures, expanded: bool) -> None:
    """Print the quantities under the headings of their groups, with what the parameters mean."""
    from dataclasses import replace

    from mirrorskin.engine.metrology import PARAMETERS, group_of

    width = max(map(len, measures.quantities))
    texts = {
        name: str(replace(quantity, sigma=(2 if expanded else 1) * quantity.sigma))
        for name, quantity in measures.quantities.items()
    }
    wide = max(len(texts[name]) for name in texts)
    heading = ""
    for name, text in texts.items():
        group = group_of(name)
        if group != heading:
            click.echo(f"{group}" if not heading else f"\n{group}")
            heading = group
        meaning = PARAMETERS[name].meaning if name in PARAMETERS else ""
        click.echo(printable(f"  {name:<{width}}  {text:<{wide}}  {meaning}".rstrip()))


def _print_budget(measures: Measures) -> None:
    """Print the contributions to the standard uncertainty of each quantity in a table."""
    causes = list(dict.fromkeys(cause for parts in measures.budget.values() for cause in parts))
    click.echo("\ncontributions to the standard uncertainty")
    rows = []
    for name, parts in measures.budget.items():
        quantity = measures.quantities[name]
        if quantity.sigma > 0:
            cells = [f"{parts[cause]:.2g}" if cause in parts else "" for cause in causes]
            rows.append([name, *cells, f"{quantity.sigma:.2g}", quantity.unit])
    print_table(["", *causes, "combined", "unit"], rows)
