"""``mirrorskin demo``: the paper's experiments, on the digital twin."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.demo import force, pose, presses, rotation, shapes, slip, vibration
from mirrorskin.cli.groups import Option
from mirrorskin.cli.output import print_json


def command(
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Folder for all files.")] = Path(
        "demo"
    ),
    overwrite: Annotated[
        bool, Option("--overwrite", help="Replace recordings of an earlier demo in that folder.")
    ] = False,
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Repeat the paper's experiments on the twin, from its idealisations to a real sensor."""
    from mirrorskin import io, view

    view.check_drawing()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise io.InputError(
            f"{output} cannot be made: {error.strerror}; choose another folder with -o"
        ) from error
    done = itertools.count(1)
    total = len(presses.EXPERIMENTS) + len(rotation.EXPERIMENTS) + 5

    def say(step: str) -> None:
        click.echo(f"{next(done)} of {total}: {step}", err=True)

    pressed, turned = {}, {}
    for press in presses.EXPERIMENTS:
        say(press.title)
        pressed[press.name] = presses.run(press, output, device, overwrite)
    for turn in rotation.EXPERIMENTS:
        say(turn.title)
        turned[turn.name] = rotation.run(turn, output, device, overwrite)
    say("a press and a rotation, fused")
    shaped = shapes.run(output, device)
    say("the force of a press")
    forces = force.run(force.EXPERIMENT, output, device)
    say("presses that oscillate, rock and dither")
    vibrated = vibration.run(vibration.EXPERIMENT, output, device)
    say("a ball that slides and twists")
    slipped = slip.run(slip.EXPERIMENT, output, device)
    say("an object that moves between touches")
    followed = pose.run(pose.EXPERIMENT, output, device)
    if as_json:
        others = {"force": forces, "vibration": vibrated, "slip": slipped, "pose": followed}
        print_json({**pressed, **turned, **shaped, **others})
        return
    presses.print_outcomes(pressed)
    click.echo()
    rotation.print_outcomes(turned)
    click.echo()
    shapes.print_outcomes(shaped)
    click.echo()
    force.print_outcomes(forces)
    click.echo()
    vibration.print_outcomes(vibrated)
    click.echo()
    slip.print_outcomes(slipped)
    click.echo()
    pose.print_outcomes(followed)
    first = presses.EXPERIMENTS[0].name
    click.echo(f"recordings, results and figures are in {output}: look at {output / first}.png")
