"""``mirrorskin report``: a result becomes one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import printable


def command(
    result: options.ResultFile,
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar="PAGE.html", help="Page to write.", show_default="RES-report.html"),
    ] = None,
    section: options.Section = None,
    turn: options.Turn = None,
) -> None:
    """Write a page with pictures, numbers and the surface, which any browser shows without a network."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import segment
    from mirrorskin.view.report import check_report, write_report

    check_report()
    ends = None if section is None else segment(section, "--section")
    page = output or result.with_name(f"{result.stem}-report.html")
    io.check_output(page, result)
    write_report(io.open_result(result), page, name=result.name, section=ends, turn=turn)
    click.echo(printable(f"{page}: {page.stat().st_size / 1e6:.1f} MB, open it in any browser"))
