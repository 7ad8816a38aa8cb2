"""``mirrorskin score``: the deviation of a result from the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.output import print_fields, print_json


def command(
    result: Annotated[Path, Argument(metavar="RES.h5", help="Result to score.")],
    truth: Annotated[Path, Option(metavar="REC.h5", help="Simulated recording, with the truth.")],
    as_json: options.Json = False,
) -> None:
    """Compare a result with the ground truth of a simulation."""
    import click

    from mirrorskin import engine, io
    from mirrorskin.cli.output import printable

    saved = io.open_result(result)
    part = saved.fitted.region
    with io.open_recording(truth) as whole:
        if part is not None and not io.Region.whole(whole.shape[1:]).holds(part):
            part = None  # of another stack
    with io.open_recording(truth, region=part) as recording:
        if recording.truth is None:
            raise io.InputError(f"{truth} holds no truth: only 'mirrorskin simulate' writes one")
        score = engine.score(saved, recording.truth)
    for note in score.notes:
        click.echo(printable(f"{result}: {note.removeprefix('result: ')}"), err=True)
    if score.slip_left_out is not None:
        click.echo(printable(f"{result}: slip is left out: {score.slip_left_out}"), err=True)
    if as_json:
        print_json(score.parts())
    else:
        print_fields(score.table())
