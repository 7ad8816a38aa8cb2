"""Run the benchmark suite, compare two runs, or make a page of runs: ``python bench/run.py --help``."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path

import click

from mirrorskin.bench.suite import (
    batch,
    calls,
    compare,
    correlation,
    integration,
    live,
    normals,
    onset,
    paths,
    peers,
    pose,
    report,
    robust,
    twin,
)
from mirrorskin.bench.suite.harness import Cases, DisagreementError
from mirrorskin.cli.commands.bench import operations
from mirrorskin.cli.commands.bench.records import Case, describe_run, open_run
from mirrorskin.io import InputError, check_output
from mirrorskin.io.storage.atomic import write_new
from mirrorskin.kernels.device import open_device

_MODULES = (
    operations,
    calls,
    onset,
    normals,
    correlation,
    integration,
    robust,
    twin,
    paths,
    batch,
    live,
    pose,
    peers,
)
CASES: Cases = {name: run for module in _MODULES for name, run in module.CASES.items()}
_FILE = click.Path(path_type=Path)


@click.group()
def main() -> None:
    """Benchmarks of the development of mirrorskin. 'mirrorskin bench' rates a device."""


@main.command("run")
@click.argument("patterns", nargs=-1, metavar="[CASE]...")
@click.option("--output", "-o", type=_FILE, metavar="RUN.json", help="Write a run, and its tables to RUN.md.")
@click.option("--folder", type=_FILE, metavar="DIR", help="Folder for temporary files of 2 GB.")
@click.option("--device", metavar="NAME", help="A device listed by 'mirrorskin devices'.")
@click.option("--quick", is_flag=True, help="Small inputs, only to check that results agree.")
@click.option("--list", "list_", is_flag=True, help="Print the names of the cases only.")
def run_cases(
    patterns: tuple[str, ...],
    output: Path | None,
    folder: Path | None,
    device: str | None,
    quick: bool,
    list_: bool,
) -> None:
    """Run all cases, or those whose names match patterns such as 'full-*'."""
    names = choose(patterns or CASES)
    if list_:
        click.echo("\n".join(names))
        return
    if output is not None:
        if output.suffix != ".json":
            raise InputError(f"{output}: the name must end in .json")
        check_output(output)
        check_output(output.with_suffix(".md"))
    opened = open_device(device)
    cases: list[Case] = []
    try:
        with _temporary_files(folder):
            for name in names:
                click.echo(f"{len(cases) + 1} of {len(names)}: {name}", err=True)
                cases.append(CASES[name](opened, quick))
    finally:
        if cases:  # also after an error or Ctrl-C: finished cases took minutes
            run = describe_run(opened, cases, quick)
            click.echo(report.as_markdown(run))
            if output is not None:
                write_new(output, [run.as_json()])
                write_new(output.with_suffix(".md"), [report.as_markdown(run).encode()])


@main.command("compare")
@click.argument("before", type=_FILE, metavar="A.json")
@click.argument("after", type=_FILE, metavar="B.json")
def compare_runs(before: Path, after: Path) -> None:
    """Compare the times of two runs with the variation between rounds."""
    click.echo(compare.as_text(open_run(before), open_run(after)))


@main.command("check")
@click.argument("before", type=_FILE, metavar="RUN.json")
@click.option("--factor", default=2.0, show_default=True, help="Allowed growth of a ratio.")
@click.option("--device", metavar="NAME", help="A device listed by 'mirrorskin devices'.")
def check_ratios(before: Path, factor: float, device: str | None) -> None:
    """Fail if a ratio of processor times, ours to a peer's, has grown since a run of the 'peers-*' cases."""
    opened, earlier = open_device(device), {case.name: case for case in open_run(before).cases}
    cases = {name: CASES[name](opened, False) for name in choose(["peers-*"])}
    for name, case in cases.items():
        compared = ", ".join(f"{ratio:.2f} times {peer}" for peer, ratio in peers.ratios(case).items())
        click.echo(f"{name}: {compared}")
    if lines := peers.regressions(earlier, cases, factor):
        raise DisagreementError("\n".join(lines))


@main.command("report")
@click.argument("runs", type=_FILE, nargs=-1, required=True, metavar="RUN.json...")
@click.option("--output", "-o", type=_FILE, required=True, metavar="PAGE.md", help="Page to write.")
@click.option("--chart", type=_FILE, metavar="FILE.svg", help="Chart to write.", show_default="PAGE.svg")
def make_report(runs: tuple[Path, ...], output: Path, chart: Path | None) -> None:
    """Make a page of runs, such as docs/benchmarks.md, and its chart. Needs no device."""
    if output.suffix != ".md":
        raise InputError(f"{output}: the name must end in .md")
    chart = chart or output.with_suffix(".svg")
    check_output(output, *runs)
    check_output(chart, *runs)
    opened = {path: open_run(path) for path in runs}
    drawn = report.as_chart(opened)
    if drawn is not None:
        write_new(chart, [drawn])
    write_new(output, [report.as_page(opened, os.path.relpath(chart, output.parent)).encode()])


def choose(patterns: Iterable[str]) -> list[str]:
    """Return the names of the cases that match any pattern, in the order of `CASES`.

    Raises InputError if a pattern matches none.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in CASES):
            near = ", ".join(get_close_matches(pattern, CASES, cutoff=0))
            raise InputError(
                f"case {pattern!r}: there is no such case. The nearest are {near}; --list prints all"
            )
    return [name for name in CASES if any(fnmatchcase(name, pattern) for pattern in patterns)]


@contextmanager
def _temporary_files(folder: Path | None) -> Iterator[None]:
    """Place temporary files, also of child processes, in a folder."""
    if folder is None:
        yield
        return
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder} is not a writable folder. Choose another with --folder")
    tempfile.tempdir = os.environ["TMPDIR"] = str(folder.resolve())
    yield


if __name__ == "__main__":
    try:
        main()
    except (InputError, DisagreementError) as error:
        sys.exit(f"bench: {error}")
