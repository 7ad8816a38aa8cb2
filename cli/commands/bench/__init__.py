"""``mirrorskin bench``: the speed of a device, compared with its limits and with a committed table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import CommandGroup, Option, make_command

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mirrorskin.cli.commands.bench.records import Case, Row, Run

TABLE = Path(__file__).with_name("table.json")
_HEAD = ["work", "ms", "quartiles", "kernels", "rate", "of limit", "table, ms", "times as fast"]
_LEGEND = """\
ms: median by the host's clock, NumPy arrays in and maps out; kernels: as reported by the device. rate: of
bytes in and out, each once, or of multiply-adds. of limit: rate divided by that of reading (integration:
triad) as many bytes. first call: without memory kept from earlier calls. times as fast: as the table."""


def command(
    context: click.Context,
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="RUN.json", help="Write the measurements there.")
    ] = None,
    against: Annotated[
        Path | None,
        Option(metavar="RUN.json", help="Compare with this run instead of the table of the package."),
    ] = None,
    quick: Annotated[
        bool, Option("--quick", help="Small pictures, once: a check. The times mean nothing.")
    ] = False,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Time the core operations and the limits of a device.

    Measures find_onset, correlate and integrate on simulated frames, and the device's bandwidth, arithmetic
    and launches; compares both with a table. Takes about half a minute.
    """
    if context.invoked_subcommand is not None:
        _refuse_options(context, context.invoked_subcommand)
        return
    from mirrorskin.cli.commands.bench.operations import CASES
    from mirrorskin.cli.commands.bench.records import check_run_output, describe_run, open_run, write_run
    from mirrorskin.cli.output import progress
    from mirrorskin.kernels.device import open_device

    check_run_output(output, against)
    table = open_run(against or TABLE)
    opened = open_device(device)
    cases = []
    with progress("measuring", len(CASES)) as show:
        for measure in CASES.values():
            cases.append(measure(opened, quick))
            show(len(cases))
    run = describe_run(opened, cases, quick)
    if as_json:
        click.echo(run.as_json().decode(), nl=False)
    else:
        _print(run, table)
    write_run(run, output)


app = make_command(
    "bench",
    command,
    CommandGroup,
    package="mirrorskin.cli.commands.bench",
    purposes={"live": "Measure rates, latencies, processor times and lost frames of live runs."},
)


def _refuse_options(context: click.Context, command: str) -> None:
    """Raise InputError if an option was given before the name of another command."""
    from mirrorskin.io import InputError

    for parameter in context.command.get_params(context):
        source = context.get_parameter_source(parameter.name or "")
        if source is not None and source.name == "COMMANDLINE":
            raise InputError(
                f"{parameter.opts[0]} is not of 'bench {command}': write options after {command!r}"
            )


def _print(run: Run, table: Run) -> None:
    from mirrorskin.cli.output import print_table, printable

    click.echo(printable(run.title))
    click.echo(printable(f"table: {table.title}"))
    earlier = {(case.name, case.title, row.name): row for case in table.cases for row in case.rows}
    for case in run.cases:
        click.echo(f"\n{case.name}: {case.title}")
        print_table(
            _HEAD,
            [list(_cells(case, row, earlier.get((case.name, case.title, row.name)))) for row in case.rows],
        )
    click.echo(f"\n{_LEGEND}")


def _cells(case: Case, row: Row, before: Row | None) -> Iterator[str]:
    """Return the cells of a row, with those of the same row of the table."""
    from mirrorskin.cli.commands.bench.records import as_ms, as_percent

    wall = row.wall
    yield row.name
    yield as_ms(wall.median)
    yield f"{as_ms(wall.lower)}-{as_ms(wall.upper)}"
    yield as_ms(row.kernel) if "kernel" in row.device else ""
    rate = row.bandwidth or row.operations / wall.median
    yield f"{rate / 1e9:.1f} {'GB' if row.bytes else 'G'}/s" if rate else ""
    yield as_percent(case.share(row)) if row.bytes else ""
    yield as_ms(before.wall.median) if before else ""
    yield f"{before.wall.median / wall.median:.2f}" if before else ""
