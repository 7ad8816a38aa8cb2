"""``mirrorskin measure``: measures of height maps, with their uncertainties, as text or as a table."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, ExistingPath, Option, matches
from mirrorskin.cli.output import print_json, print_table, printable
from mirrorskin.cli.stack import STACK
from mirrorskin.io.formats.registry import surfaces

if TYPE_CHECKING:
    from mirrorskin.engine.metrology import Limit, Measures, Table

_EXPANDED = ("± is the standard uncertainty (k = 1)", "± is the expanded uncertainty (k = 2)")
_SMOOTH = "cannot be distinguished from a smooth one"


class FormName(StrEnum):
    """Form that is fitted to the surface."""

    plane = "plane"
    sphere = "sphere"
    polynomial2 = "polynomial2"
    polynomial3 = "polynomial3"
    polynomial4 = "polynomial4"
    none = "none"


def command(
    results: Annotated[
        list[str],
        Argument(
            metavar="RES.h5...",
            help=f"Results to take, or surfaces: {surfaces()}. '*' and '**' are expanded, also if quoted.",
        ),
    ],
    turn: options.Turn = None,
    form: Annotated[
        FormName | None,
        Option(
            help="What to fit, and to remove before texture is measured.",
            show_default="sphere where it fits much better, else plane",
        ),
    ] = None,
    robust: Annotated[
        bool | None,
        Option(
            "--robust/--no-robust",
            help="Leave outliers out of the fit of the form.",
            show_default="of a sphere only",
        ),
    ] = None,
    mask: Annotated[
        list[str] | None,
        Option(
            metavar="MASK",
            help="Leave out: FILE.png or FILE.npy, where it is 0; polygon:X1,Y1:X2,Y2:X3,Y3, its inside;"
            " only:X1,Y1:..., its outside; above:LENGTH; below:LENGTH; defects, outliers of the form."
            " May be given again.",
        ),
    ] = None,
    reference: Annotated[
        Path | None, Option(metavar="RES.h5", help="Subtract the heights of this result first.")
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
            help="Measure lengths, slope, step or groove, and profile between two points, from the picture's"
            " centre: -2mm,0mm:2mm,0mm.",
        ),
    ] = None,
    section_width: Annotated[
        str | None,
        Option(metavar="LENGTH", help="Average the section over this width.", show_default="one line"),
    ] = None,
    noise_length: Annotated[
        str | None,
        Option(
            metavar="LENGTH",
            help="Length over which errors of heights are correlated; 0mm: independent.",
            show_default="that of the result",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar="TABLE.csv", help="Write a table with one row for each result."),
    ] = None,
    limits: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=LOW:HIGH",
            help="Limits of a quantity, 'Sq=:2um' or 'sphere radius=4.9mm:5.1mm', or a FILE.toml with such"
            " lines; exit code 1 if a result is outside. May be given again.",
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        Option(
            "--chart", metavar="CHART.png", help="Draw a control chart of the results: .png, .pdf or .svg."
        ),
    ] = None,
    every: Annotated[
        bool, Option("--all", help="Print all quantities, not only the ten that matter most.")
    ] = False,
    expanded: Annotated[
        bool, Option("--expanded", help="Print expanded uncertainties, k = 2, instead of standard ones.")
    ] = False,
    budget: Annotated[
        bool, Option("--budget", help="Print the contributions to each standard uncertainty.")
    ] = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, STACK.only("region")],
) -> None:
    """Measure height maps: heights, areas, volumes, forms, texture, profiles, steps, grooves."""
    paths = _paths(results)
    from mirrorskin import engine, io
    from mirrorskin.cli import quantity

    def length(text: str | None, option: str) -> float | None:
        return None if text is None else quantity.length(text, option)

    _check_written(output, chart, [*paths, reference, *map(Path, mask or [])])
    allowed = _limits(limits or [])
    how: dict[str, Any] = {
        "region": chosen.get("region"),
        "form": None if form is None else form.value,
        "robust": robust,
        "mask": [_mask(text) for text in mask] if mask else None,
        "reference": None if reference is None else io.open_result(reference),
        "s_filter": length(s_filter, "--s-filter"),
        "l_filter": length(l_filter, "--l-filter"),
        "section": None if section is None else quantity.segment(section, "--section"),
        "section_width": length(section_width, "--section-width") or 0.0,
        "noise_length": length(noise_length, "--noise-length"),
    }
    if len(paths) > 1 or output or allowed or chart:
        if budget and not as_json:
            raise io.InputError(
                "--budget is printed of one result, without limits: add --json, or leave it out"
            )
        table = engine.metrology.table(_Opened(paths, turn), limits=allowed, **how)
        if as_json:
            _print_files(table, budget)
        else:
            names = table.names if every else table.main()
            _report_table(table, names, expanded)
            _report_trends(table, names)
        _write_table(table, output, chart)
        _end(table)
        return
    measures = engine.measure(io.select_turn(io.open_result(paths[0]), turn), **how)
    if as_json:
        shown = {"quantities": measures.quantities, "notes": measures.notes}
        print_json(shown | ({"budget": measures.budget} if budget else {}))
        return
    names = list(measures.quantities) if every else list(measures.main())
    _print_measures(measures, names, expanded)
    if budget:
        _print_budget(measures, names)


def _check_written(output: Path | None, chart: Path | None, inputs: list[Path | None]) -> None:
    """Raise InputError for a file that cannot be written, or is an input, before anything is measured."""
    from mirrorskin import io
    from mirrorskin.view.drawing.canvas import FIGURE_SUFFIXES, check_drawing

    if chart is not None:
        check_drawing()
        if chart.suffix.lower() not in FIGURE_SUFFIXES:
            raise io.InputError(
                f"--chart {chart}: name a picture that ends in {' or '.join(FIGURE_SUFFIXES)}"
            )
    if output is not None and output.suffix.lower() != ".csv":
        raise io.InputError(f"-o {output}: name a table that ends in .csv")
    for path in (output, chart):
        if path is not None:
            io.check_output(path, *(file for file in inputs if isinstance(file, Path)))


def _write_table(table: Table, output: Path | None, chart: Path | None) -> None:
    """Write the table and the control chart that are requested."""
    if output is not None:
        table.save(output)
        click.echo(printable(f"{output}: {len(table.rows)} rows"), err=True)
    if chart is not None:
        from mirrorskin.view.drawing.canvas import save_figure
        from mirrorskin.view.result.control_chart import control_chart

        save_figure(control_chart(table), "Control chart", chart)


def _paths(words: list[str]) -> list[Path]:
    """Return the files and addresses that words or patterns name."""
    paths: list[Path] = []
    for word in words:
        found = matches(word, "results")
        paths += [ExistingPath().convert(word, None, None)] if found is None else found
    return paths


class _Opened(Mapping[str, Any]):
    """Results by path, which are opened when they are measured."""

    def __init__(self, paths: list[Path], turn: int | None) -> None:
        self._paths, self._turn = {str(path): path for path in paths}, turn

    def __getitem__(self, name: str) -> Any:
        from mirrorskin import io

        return io.select_turn(io.open_result(self._paths[name]), self._turn)

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)


def _mask(text: str) -> Any:
    """Return the mask that a text describes."""
    from mirrorskin.cli import quantity
    from mirrorskin.engine.metrology import Defects, Levels, Picture, Polygon
    from mirrorskin.io import InputError

    kind, colon, rest = text.partition(":")
    if text == "defects":
        return Defects()
    if colon and kind in ("above", "below"):
        return Levels(**{kind: quantity.length(rest, f"--mask {kind}:")})
    if colon and kind in ("polygon", "only"):
        corners = [quantity.vector(corner, 2, f"--mask {kind}:") for corner in rest.split(":")]
        return Polygon([(corner[0], corner[1]) for corner in corners], only=kind == "only")
    if not os.path.lexists(text):
        raise InputError(
            f"--mask {text}: neither a file nor polygon:X1,Y1:X2,Y2:X3,Y3, only:..., above:LENGTH,"
            " below:LENGTH or defects"
        )
    return Picture(text)


def _limits(words: list[str]) -> dict[str, Limit]:
    """Return limits by the name of the quantity, from the command line and from files."""
    import tomllib

    from mirrorskin.engine.metrology import Limit
    from mirrorskin.io import InputError
    from mirrorskin.io.base.system import read_text

    limits: dict[str, Limit] = {}
    for word in words:
        if word.lower().endswith(".toml"):
            try:
                lines = tomllib.loads(read_text(Path(word)))
            except (OSError, ValueError, RecursionError) as error:
                raise InputError(f"--limits {word}: {error}") from None
        else:
            name, equals, bounds = word.partition("=")
            if not equals:
                raise InputError(f"--limits {word}: NAME=LOW:HIGH is needed; write e.g. 'Sq=:2um'")
            lines = {name.strip(): bounds}
        limits |= {name: Limit.read(str(bounds), name) for name, bounds in lines.items()}
    return limits


def _print_files(table: Table, budget: bool) -> None:
    """Print all quantities of each result as JSON."""
    files = []
    for row in table.rows:
        measures = row.measures
        entry: dict[str, Any] = {"file": row.name}
        if measures is None:
            entry["problem"] = row.problem
        else:
            entry |= {"quantities": measures.quantities, "notes": measures.notes}
            entry |= {"budget": measures.budget} if budget else {}
        if table.limits:
            entry["limits"] = str(table.verdict(row))
        files.append(entry)
    trends = {name: trend for name in table.names if (trend := table.trend(name))}
    steps = {name: {"step": trend.step, "results": trend.results} for name, trend in trends.items()}
    print_json({"files": files} | ({"trends": steps} if steps else {}))


def _report_table(table: Table, names: list[str], expanded: bool) -> None:
    """Print some quantities of each result."""
    rows = []
    for row in table.rows:
        cells = []
        for name in names:
            quantity = row.quantity(name)
            cells.append("" if quantity is None else str(quantity.expanded(2 if expanded else 1)))
        verdict = [str(table.verdict(row))] if table.limits else []
        rows.append([row.name, *cells, *verdict, row.problem])
    print_table(["result", *names, *(["limits"] if table.limits else []), ""], rows)


def _report_trends(table: Table, names: list[str]) -> None:
    """Print how quantities change from result to result: those shown, and those of the sensor."""
    from mirrorskin.engine.metrology.measures import HEALTH

    for name in dict.fromkeys([*names, *HEALTH]):
        trend = table.trend(name)
        if trend is not None:
            click.echo(printable(f"{name} {trend}"))


def _end(table: Table) -> None:
    """Raise an error, exit code 1, if a result is outside of its limits or could not be measured."""
    counts = [
        (sum(row.measures is None for row in table.rows), "could not be measured"),
        (sum(table.verdict(row) == "outside" for row in table.rows if row.measures), "outside of the limits"),
        (sum(table.verdict(row) == "missing" for row in table.rows if row.measures), "without a quantity"),
    ]
    words = [f"{count} of {len(table.rows)} {what}" for count, what in counts if count]
    if words:
        raise click.ClickException(", ".join(words))


def _print_measures(measures: Measures, names: list[str], expanded: bool) -> None:
    """Print remarks, and quantities under the headings of their groups, with what the parameters mean."""
    from mirrorskin.engine.metrology import PARAMETERS, group_of

    for note in measures.notes:
        click.echo(printable(note.replace(*_EXPANDED) if expanded else note))
    width = max(map(len, names))
    texts = {name: str(measures.quantities[name].expanded(2 if expanded else 1)) for name in names}
    wide = max(len(text) for text in texts.values())
    heading = ""
    for name, text in texts.items():
        group = group_of(name)
        if group != heading:
            click.echo(f"\n{group}")
            heading = group
        meaning = PARAMETERS[name].meaning if name in PARAMETERS else ""
        click.echo(printable(f"  {name:<{width}}  {text:<{wide}}  {meaning}".rstrip()))
    if measures.smooth and not any(group_of(name).startswith("texture") for name in names):
        click.echo(f"\ntexture\n  {_SMOOTH}")
    left = len(measures.quantities) - len(names)
    if left:
        click.echo(f"\n{left} more quantities: --all")


def _print_budget(measures: Measures, names: list[str]) -> None:
    """Print the contributions to the standard uncertainty of quantities in a table."""
    budget = {name: measures.budget[name] for name in names if name in measures.budget}
    causes = list(dict.fromkeys(cause for parts in budget.values() for cause in parts))
    click.echo("\ncontributions to the standard uncertainty")
    rows = []
    for name, parts in budget.items():
        quantity = measures.quantities[name]
        if quantity.sigma > 0:
            cells = [f"{parts[cause]:.2g}" if cause in parts else "" for cause in causes]
            rows.append([name, *cells, f"{quantity.sigma:.2g}", quantity.unit])
    print_table(["", *causes, "combined", "unit"], rows)
