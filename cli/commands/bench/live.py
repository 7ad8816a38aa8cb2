"""``mirrorskin bench live``: rates, latencies and processor times of live runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Option

if TYPE_CHECKING:
    from mirrorskin.cli.commands.bench.records import Run

_LEGEND = """\
used, updates: frames, and maps or results of a tracker, a second. Frames that come too early wait, at most
64 of them and for 0.1 s; lost: the others. 50 %, 95 %, 99 %: latency from when a frame was due to its maps.
processor: ms of all threads a frame, on simulated time. as offline: on simulated time nothing is lost, and
the result is that of the same frames offline."""


def command(
    of: Annotated[
        str,
        Option(metavar="NAME[,NAME]", help="What runs; pose+slip: both, for each frame."),
    ] = "press,turn,pose,slip,force",
    size: Annotated[str, Option(metavar="WxH[,WxH]", help="Columns and rows of a frame.")] = (
        "160x120,320x240,640x480"
    ),
    rate: Annotated[float, Option(metavar="HZ", min=1, help="Frames a second.")] = 1000.0,
    seconds: Annotated[
        float, Option(metavar="SECONDS", min=0.01, help="How long frames come, for each run.")
    ] = 10.0,
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="RUN.json", help="Write the measurements there.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Measure rates, latencies, processor times and lost frames of live runs.

    Frames are made beforehand, and come from memory at a set pace: first on simulated time, where the result
    must be that of the same frames offline, then in real time. Ends with exit code 1 if a result differs.
    """
    from mirrorskin import io
    from mirrorskin.cli.commands.bench.live_runs import check_name, measure_live
    from mirrorskin.cli.commands.bench.records import Case, check_run_output, describe_run, write_run
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import frame_size
    from mirrorskin.kernels.device import open_device

    check_run_output(output)
    try:
        names = [check_name(name.strip()) for name in of.split(",")]
    except io.InputError as error:
        raise io.InputError(f"--of {error}") from None
    sizes = [frame_size(part, "--size") for part in size.split(",")]
    opened = open_device(device)
    cases: list[Case] = []
    with progress("measuring", len(names) * len(sizes)) as show:
        for name in names:
            rows = []
            for columns, height in sizes:
                rows.append(measure_live(name, (height, columns), rate, seconds, opened)[0])
                show(len(cases) * len(sizes) + len(rows))
            title = f"{name} of {rate:g} frames a second for {seconds:g} s"
            cases.append(Case(f"live-{name}", title, live=tuple(rows)))
    run = describe_run(opened, cases, False)
    if as_json:
        click.echo(run.as_json().decode(), nl=False)
    else:
        _print(run)
    write_run(run, output)
    differ = [f"{row.name} {row.size}" for case in cases for row in case.live if not row.as_offline]
    if differ:
        raise click.ClickException(f"the live result is not that of the same frames offline: {differ[0]}")


def _print(run: Run) -> None:
    from mirrorskin.cli.commands.bench.records import LIVE_HEAD
    from mirrorskin.cli.output import print_table, printable

    click.echo(f"{printable(run.title)}\n")
    print_table(LIVE_HEAD, [row.cells for case in run.cases for row in case.live])
    click.echo(f"\n{_LEGEND}")
