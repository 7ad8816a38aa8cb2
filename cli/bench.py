"""``mirrorskin bench``: how fast, and how near the limit; what changed since; and that as a page."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Group, Option, make_command
from mirrorskin.cli.output import printable

if TYPE_CHECKING:
    from rich.console import Console

    from mirrorskin.bench.harness import Case

_RUN = "RUN.json"
_WIDTH = 100  # a pipe has 80, which would cut the names


def measure(
    context: click.Context,
    case: Annotated[
        list[str] | None,
        Option(metavar="NAME", help="Only this case, or those like 'full-*'; may be given again."),
    ] = None,
    quick: Annotated[
        bool, Option("--quick", help="Small stacks, to see that all agree; the times mean nothing.")
    ] = False,
    output: Annotated[
        Path | None,
        Option("--output", "-o", metavar=_RUN, help="Write JSON there, and a table beside it."),
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
    folder: Annotated[
        Path | None,
        Option(metavar="DIR", help="For files of 2 GB; else among temporary files."),
    ] = None,
    list_: Annotated[bool, Option("--list", help="Name the cases, and run none.")] = False,
) -> None:
    """Time the kernels and whole paths against the limits and against others; check their accuracy."""
    if context.invoked_subcommand is not None:
        _refuse_options(context)
        return
    from mirrorskin.bench import run, suite
    from mirrorskin.cli.output import progress
    from mirrorskin.kernels.device import open_device

    names = suite.choose(case or suite.NAMES)
    if list_:
        click.echo(json.dumps(names, indent=2) if as_json else "\n".join(names))
        return
    page = _check(output)
    opened = open_device(device)
    cases: list[Case] = []
    try:
        with _temporary_files(folder), progress("measuring", len(names)) as show:

            def done(one: Case) -> None:
                cases.append(one)
                show(len(cases))

            suite.run_suite(opened, names, quick, done)
    finally:
        # Also before an error or Ctrl-C: what is done took minutes.
        if cases:
            _tell(run.as_data(opened, cases, quick), output, page, as_json)
    suite.check_accuracy(cases)


app: Group = make_command(None, measure, Group, invoke_without_command=True)


def compare_runs(
    before: Annotated[Path, Argument(metavar="A.json", help="A run that 'mirrorskin bench -o' wrote.")],
    after: Annotated[Path, Argument(metavar="B.json", help="Another, later one.")],
    as_json: options.Json = False,
) -> None:
    """Compare two runs, work by work: what changed by more than its turns vary."""
    from mirrorskin.bench import compare as comparing
    from mirrorskin.bench import report, run

    runs = run.open_run(before), run.open_run(after)
    found = comparing.compare(*runs)
    if as_json:
        click.echo(json.dumps(comparing.as_data(found, *runs), indent=2))
        return
    console = _console()
    titles = (f"{word}: {report.as_title(one)}" for word, one in zip("AB", runs, strict=True))
    _print_lines(console, *titles, *(f"warning: {line}" for line in found.warnings))
    for name, rows in found.cases.items():
        _print_lines(console, "", name)
        _print_table(console, comparing.HEAD, comparing.as_rows(rows))
    _print_lines(console, "", *found.targets, *found.apart, *found.summary)


app.add(compare_runs, "compare")


def make_report(
    runs: Annotated[list[Path], Argument(metavar=_RUN, help="Runs that 'mirrorskin bench -o' wrote.")],
    output: Annotated[
        Path,
        Option("--output", "-o", metavar="PAGE.md", help="Page to write; its picture goes to images."),
    ],
) -> None:
    """Make a page of runs: aims, a summary, a roofline, and every case. Needs no device."""
    from mirrorskin import io, view
    from mirrorskin.bench.report import write_page
    from mirrorskin.bench.run import open_run

    if output.suffix != ".md":
        raise io.InputError(f"{output}: name a page that ends in .md")
    view.check_drawing()
    io.check_output(output, *runs)
    write_page({path: open_run(path) for path in runs}, output)
    click.echo(f"written to {output}", err=True)


app.add(make_report, "report")


def _refuse_options(context: click.Context) -> None:
    """Refuse options of a run before the name of another command, where they would do nothing."""
    from mirrorskin import io

    given = [
        parameter.opts[0]
        for parameter in context.command.params
        if getattr(context.get_parameter_source(parameter.name or ""), "name", "") == "COMMANDLINE"
    ]
    if given:
        command = context.invoked_subcommand
        raise io.InputError(f"{given[0]} is of a run: 'bench {command}' takes its options behind its name")


@contextmanager
def _temporary_files(folder: Path | None) -> Iterator[None]:
    """Let temporary files, also of programs that are started, go to a folder."""
    from mirrorskin import io

    if folder is None:
        yield
        return
    if not os.access(folder, os.W_OK | os.X_OK) or not folder.is_dir():
        raise io.InputError(f"{folder} is no folder that can be written to: choose another with --folder")
    before, tempfile.tempdir = (tempfile.tempdir, os.environ.get("TMPDIR")), str(folder.resolve())
    os.environ["TMPDIR"] = tempfile.tempdir
    try:
        yield
    finally:
        tempfile.tempdir = before[0]
        os.environ.pop("TMPDIR")
        os.environ.update({"TMPDIR": before[1]} if before[1] is not None else {})


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


def _tell(data: Mapping[str, Any], output: Path | None, page: Path | None, as_json: bool) -> None:
    from mirrorskin.bench.report import as_markdown
    from mirrorskin.io.atomic import write_new

    text = json.dumps(data, indent=2)
    if as_json:
        click.echo(text)
    else:
        _print(data)
    for path, content in ((output, text + "\n"), (page, as_markdown(data))):
        if path is not None:
            write_new(path, [content.encode()])
            click.echo(f"written to {path}", err=True)


def _print(data: Mapping[str, Any]) -> None:
    from mirrorskin.bench import report

    console = _console()
    _print_lines(console, report.as_title(data), report.LEGEND)
    for case in data["cases"]:
        _print_lines(console, "", f"{case['name']}: {case['title']}")
        _print_table(console, report.HEAD, report.as_rows(case))
        _print_table(console, report.TARGET_HEAD, report.as_targets(case), numbers=False)
        for note in report.as_notes(case):
            _print_lines(console, note)


def _print_lines(console: Console, *lines: str) -> None:
    console.print(*map(printable, lines), sep="\n", markup=False)


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, _WIDTH)
    return console


def _print_table(
    console: Console, head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True
) -> None:
    """Print a table that has rows; numbers go to the right and are never broken."""
    from rich.table import Table
    from rich.text import Text

    if not rows:
        return
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for number, name in enumerate(head):
        is_number = numbers and number > 0
        table.add_column(name, justify="right" if is_number else "left", no_wrap=is_number)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console.print(table)
