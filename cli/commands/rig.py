"""``mirrorskin rig``: check a stage and a camera, and move the stage by hand."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Group, Option
from mirrorskin.cli.output import print_json, print_table, printable

if TYPE_CHECKING:
    from mirrorskin.hw.base.rig_file import RigSettings
    from mirrorskin.hw.base.stage import Stage
    from mirrorskin.hw.rig.check import CheckResult

app = Group(
    help="Check a stage and a camera before they are used, and move it by hand.", no_args_is_help=True
)

_SLOW = 0.1  # of an axis's speed, for moves by hand
_COLOURS = {"ok": "green", "warning": "yellow", "failed": "red"}


RigFile = Annotated[
    Path, Argument(metavar="RIG.toml", help="Rig file; 'mirrorskin rig new' writes a template.")
]


class AxisName(StrEnum):
    """Motions for which a stage may have an axis."""

    travel = "travel"
    pitch = "pitch"
    roll = "roll"
    x = "x"
    y = "y"
    twist = "twist"


@app.add
def new(
    output: Annotated[Path, Option("--output", "-o", metavar="RIG.toml", help="File to write.")],
) -> None:
    """Write a template of a rig file, in which every key is described."""
    from mirrorskin.hw.base.rig_file import TEMPLATE
    from mirrorskin.io import InputError
    from mirrorskin.io.storage.atomic import write_new

    if output.exists():
        raise InputError(f"{output} exists and is not replaced: choose another name with -o")
    write_new(output, [TEMPLATE.encode()], replaces="nothing")
    click.echo(f"{output}: now set port, letters, zeros and limits, and try 'mirrorskin rig check {output}'")


@app.add
def check(
    rig: RigFile,
    move: Annotated[bool, Option("--move", help="Home it, and move each axis a little.")] = False,
    as_json: options.Json = False,
) -> None:
    """Open a rig and compare it with its file; nothing moves without --move."""
    from mirrorskin.hw.base.errors import HardwareError
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.check import check_rig

    settings = load_rig(rig)
    findings: list[CheckResult] = []
    complete = False
    try:
        with closing(check_rig(settings, move=move)) as report:
            findings.extend(report)  # keeps what was found before an error
        complete = True
    finally:
        if findings:
            _print(settings, findings, complete, as_json)
    failed = [finding for finding in findings if finding.verdict == "failed"]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        first = failed[0]
        raise HardwareError(f"{rig}: {first.part}, {first.what}: {first.found}: {first.remedy}{more}")


@app.add
def home(rig: RigFile) -> None:
    """Move all axes to their switches, which define the position of the stage."""
    with _opened(rig) as stage:
        stage.home()


@app.add
def lift(rig: RigFile) -> None:
    """Set the body upright, lift it to the end of its travel, and bring it to the middle."""
    with _opened(rig) as stage:
        for place in stage.limits.retreat_path(stage.report().position):
            stage.move(place)
            stage.wait()


@app.add
def jog(
    rig: RigFile,
    axis: Annotated[AxisName, Argument(help="Motion whose axis is moved.")],
    by: Annotated[str, Option(metavar="LENGTH|ANGLE", help="Distance or angle of the move: 0.5mm, -1deg.")],
) -> None:
    """Move one axis a little, slowly and within its limits."""
    from dataclasses import replace

    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.io import InputError

    spec = load_rig(rig).stage.axes.get(axis.value)
    if spec is None:
        raise InputError(f"{rig} has no [stage.{axis.value}]: add it, or move another axis")
    delta = (length if spec.unit == "mm" else angle)(by, "--by")
    with _opened(rig) as stage:
        here = stage.report().position
        place = replace(here, **{axis.value: getattr(here, axis.value) + delta})
        stage.move(place, _SLOW * spec.top_speed)
        stage.wait()


@app.add
def probe(
    rig: RigFile,
    start: Annotated[
        str | None,
        Option("--from", metavar="LENGTH", help="First travel.  [default: the least of its limits]"),
    ] = None,
    step: Annotated[str, Option(metavar="LENGTH", help="Distance between the frames.")] = "0.05mm",
) -> None:
    """Lower the body until the picture shows contact, lift it, and print the zero of the travel."""
    from mirrorskin.cli.quantity import length
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.plans import check_plan
    from mirrorskin.hw.rig.probe import contact_plan, find_contact
    from mirrorskin.hw.rig.rig import open_rig

    settings = load_rig(rig)
    travel, each = settings.stage.travel, length(step, "--step")
    first = travel.low if start is None else length(start, "--from")
    check_plan(contact_plan(settings.stage.limits, first, each), settings.stage, settings.name)
    with open_rig(settings) as opened:
        contact = find_contact(opened, first, each)
    zero = travel.coordinate(contact)
    click.echo(
        f"{rig}: first contact at a travel of {contact:.4g} ± {each / 2:.2g} mm;"
        f" for a travel of 0 there set zero = {zero:.6g} in [stage.travel]"
    )


@app.add
def unlock(rig: RigFile) -> None:
    """End an alarm, a hold or an open door after a look at the machine, or stop its movement.

    Without switches the present coordinates stay valid; with switches the stage must be homed next.
    """
    with _opened(rig, unlock=True):
        pass


@contextmanager
def _opened(rig: Path, unlock: bool = False) -> Iterator[Stage]:
    """Open only the stage; print its position at the end."""
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.hw.rig.check import in_words
    from mirrorskin.hw.rig.rig import open_stage

    settings = load_rig(rig)
    with closing(open_stage(settings.stage, unlock=unlock)) as stage:
        yield stage
        report = stage.report()
        where = in_words(report.position, settings.stage)
        locked = "; locked: home it with 'mirrorskin rig home'" if report.state == "alarm" else ""
        click.echo(printable(f"{settings.name}: {where}{locked}"))


def _print(settings: RigSettings, findings: Sequence[CheckResult], complete: bool, as_json: bool) -> None:
    if as_json:
        sound = complete and all(finding.verdict != "failed" for finding in findings)
        print_json({"rig": settings.name, "sound": sound, "findings": findings})
        return
    rows = [
        [finding.verdict, finding.part, finding.what, finding.found, finding.remedy] for finding in findings
    ]
    if not sys.stdout.isatty():
        print_table(["", "part", "what", "found", "remedy"], rows)
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(
        "", "part", "what", "found", "remedy", title=Text(printable(settings.name)), box=None, pad_edge=False
    )
    for verdict, *cells in rows:
        table.add_row(Text(verdict, style=_COLOURS[verdict]), *(Text(printable(cell)) for cell in cells))
    Console().print(table)
