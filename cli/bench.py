"""``mirrorskin bench``: how fast, and how near the limit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorskin.cli import options

if TYPE_CHECKING:
    from collections.abc import Mapping


def command(
    case: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this case; may be given again.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small stacks, to see that all agree; the times mean nothing.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.json", help="Write JSON there, and a table beside it."),
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Time the kernels against the limit of memory and against others."""
    from mirrorskin import bench
    from mirrorskin.cli.progress import progress
    from mirrorskin.kernels.device import open_device

    page = _check(output)
    names = case or bench.NAMES
    opened = open_device(device)
    with progress("measuring", len(set(names))) as show:
        data = bench.as_data(opened, bench.run_suite(opened, names, quick, show), quick)
    text = json.dumps(data, indent=2)
    if as_json:
        typer.echo(text)
    else:
        _print(data)
    for path, content in ((output, text + "\n"), (page, bench.as_markdown(data))):
        if path is not None:
            _write(path, content)
            typer.echo(f"written to {path}", err=True)


def _check(output: Path | None) -> Path | None:
    """Return where the table goes, or refuse before minutes are spent."""
    from mirrorskin import io

    if output is None:
        return None
    if output.suffix != ".json":
        raise io.InputError(f"{output}: name a file that ends in .json")
    page = output.with_suffix(".md")
    for path in (output, page):
        io.check_output(path)
    return page


def _write(path: Path, content: str) -> None:
    from mirrorskin import io

    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise io.InputError(f"{path} could not be written: {error.strerror}; make room") from error


def _print(data: Mapping[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from mirrorskin import bench

    console = Console(highlight=False)
    console.width = max(console.width, 100)  # a pipe has 80, which would cut the names
    console.print(bench.as_title(data), bench.LEGEND, sep="\n", markup=False)
    for case in data["cases"]:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for number, head in enumerate(bench.HEAD):
            table.add_column(head, justify="right" if number else "left", no_wrap=True)
        for row in bench.as_rows(case):
            table.add_row(*row)
        console.print(f"\n{case['name']}: {case['title']}", markup=False)
        console.print(table)
        for note in bench.as_notes(case):
            console.print(note, markup=False)
