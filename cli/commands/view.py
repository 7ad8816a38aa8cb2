"""``mirrorskin view``: pictures of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import printable

if TYPE_CHECKING:
    from mirrorskin.io import Result
    from mirrorskin.view.result.figures import Ends

_PICTURE = ".png"  # in a folder


def command(
    result: options.ResultFile,
    map_: Annotated[
        list[str] | None,
        Option(
            "--map",
            metavar="NAME",
            help="Only this map of those that 'mirrorskin info RES' lists, 'section' or 'histogram'; may be"
            " given again.",
            show_default="those of the overview",
        ),
    ] = None,
    section: options.Section = None,
    turn: options.Turn = None,
    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            metavar="PICTURE|DIR",
            help="Write one picture of all, .png, .pdf or .svg, or a picture of each into a folder, without a"
            " window.",
            show_default="a window; where there is no screen, RES-view.png",
        ),
    ] = None,
) -> None:
    """Show the maps of a result, a section and a histogram of heights."""
    from mirrorskin import io, view
    from mirrorskin.cli.quantity import segment

    ends = None if section is None else segment(section, "--section")
    name = result.name if turn is None else f"{result.name}, turn {turn}"
    view.check_drawing()
    if output is not None:
        _check(output, result)
    _show(io.select_turn(io.open_result(result), turn), result, name, ends, map_, output)


def _check(output: Path, result: Path) -> None:
    """Raise InputError for a place that cannot be written to, before anything is drawn."""
    from mirrorskin import io
    from mirrorskin.view.drawing.canvas import FIGURE_SUFFIXES

    if output.suffix.lower() in FIGURE_SUFFIXES:
        io.check_output(output, result)
    elif output.suffix and not output.is_dir():
        suffixes = " or ".join(FIGURE_SUFFIXES)
        raise io.InputError(f"-o {output}: name a picture that ends in {suffixes}, or a folder")
    else:
        nearest = next(folder for folder in (output, *output.absolute().parents) if folder.exists())
        if not nearest.is_dir():
            raise io.InputError(f"{output} cannot be created: {nearest} is not a folder. Use another -o")


def _show(
    shown: Result, path: Path, name: str, ends: Ends | None, maps: list[str] | None, output: Path | None
) -> None:
    """Draw maps into a window, a picture or a folder."""
    from mirrorskin import io
    from mirrorskin.view.drawing.canvas import FIGURE_SUFFIXES, has_screen, show_figure, write_figure
    from mirrorskin.view.result import figures_of, overview

    if output is None and has_screen():
        show_figure(overview(shown, name=name, section=ends, maps=maps), name)
        return
    no_screen = output is None
    if output is None:
        output = path.with_name(f"{path.stem}-view{_PICTURE}")
        io.check_output(output)
    if output.suffix.lower() in FIGURE_SUFFIXES:
        figures = {output: overview(shown, name=name, section=ends, maps=maps)}
    else:
        each = figures_of(shown, name=name, section=ends, maps=maps)
        figures = {output / f"{which}{_PICTURE}": figure for which, figure in each.items()}
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            problem = f"{output} cannot be created: {error.strerror}"
            raise io.InputError(f"{problem}. Choose another with -o") from error
    if no_screen:
        click.echo("there is no screen for a window", err=True)
    for target, figure in figures.items():
        write_figure(figure, target)
        click.echo(printable(f"written to {target}"))
