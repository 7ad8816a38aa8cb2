"""``mirrorskin calibrate force``: the gel's modulus, from presses of known force."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.calibrate import inputs
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK, stack_options

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.force import StiffnessFit


def command(
    output: options.LearnedCalibration,
    presses: Annotated[
        list[Path], Argument(metavar="REC.h5...", help="Vertical recordings whose greatest force is known.")
    ],
    force: Annotated[
        list[str] | None,
        Option(metavar="FORCE", help="Of each press in turn, by a scale 1.5N or a weight 150g; repeat it."),
    ] = None,
    readings: Annotated[
        Path | None, Option(metavar="CSV", help="The same as a text: a line REC.h5,newtons of each press.")
    ] = None,
    force_sigma: Annotated[
        str | None, Option(metavar="FORCE", help="Standard deviation of the scale's readings: 5mN.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
    **given: Annotated[Any, STACK.only("travel_step", "travel_start", "pixel_size")],
) -> None:
    """Learn the modulus that turns a press into newtons, from a scale or known weights; after elastic."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import force as newtons_of
    from mirrorskin.engine.calibration.force import fit_stiffness, known_press

    newtons = _forces(presses, force or [], readings)
    spread = 0.0 if force_sigma is None else newtons_of(force_sigma, "--force-sigma")
    known = inputs.check_call(output, presses, None)
    if known is None or known.gel is None:
        raise io.InputError(
            f"{output} has no gel, which is needed to compute loads: run calibrate elastic first"
        )
    stack = stack_options(given)
    with inputs.open_all(presses, stack, known, output) as (sources, camera):
        found = []
        for source, one in zip(sources, newtons, strict=True):
            with progress("pressing", source.shape[0]) as show:
                found.append(known_press(source, known, one, spread, device=device, progress=show))
        fit = fit_stiffness(found, known.gel)
        process = inputs.process_of(sources[0], sources=inputs.names_of(presses), forces=str(newtons))
    io.update_calibration(output, fit.stiffness, camera, process)
    _report(output, presses, fit, as_json)


def _forces(presses: list[Path], texts: list[str], readings: Path | None) -> list[float]:
    """Return the force of each press, N."""
    from mirrorskin.cli.quantity import force
    from mirrorskin.io import InputError

    if (readings is None) != bool(texts):
        raise InputError("give the forces either as --force, one a recording, or as --readings CSV")
    if readings is None:
        if len(texts) != len(presses):
            raise InputError(f"{len(presses)} recordings and {len(texts)} times --force: give one of each")
        return [force(text, "--force") for text in texts]
    table = _table(readings)
    missing = [str(path) for path in presses if path.name not in table]
    if missing:
        raise InputError(f"{readings} has no line of {missing[0]}: write REC.h5,newtons, one a press")
    return [table[path.name] for path in presses]


def _table(path: Path) -> dict[str, float]:
    """Read newtons by the names of recordings; a first line may be a heading."""
    from mirrorskin.io import InputError
    from mirrorskin.io.os_errors import MAX_TEXT_BYTES, read_regular
    from mirrorskin.io.text import shortened

    remedy = "write REC.h5,newtons, one a press"
    try:
        text = read_regular(path, remedy, MAX_TEXT_BYTES).decode()
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read: {error}; {remedy}") from error
    table = {}
    for number, row in enumerate(rows):
        try:
            table[Path(row[0].strip()).name] = float(row[1])
        except (IndexError, ValueError) as error:
            if number:
                line = shortened(",".join(row))
                raise InputError(f"{path}: {line!r} is no press: write REC.h5,newtons") from error
    return table


def _report(output: Path, presses: list[Path], fit: StiffnessFit, as_json: bool) -> None:
    from mirrorskin.cli.output import print_json

    known = fit.stiffness
    if as_json:
        each = [
            {"recording": str(path), "residual": float(left), "held_out": float(out), "sigma": float(sigma)}
            for path, left, out, sigma in zip(presses, fit.residual, fit.held_out, fit.sigma, strict=True)
        ]
        names = "modulus", "modulus_sigma", "gel_shift", "scatter", "error"
        told = {name: getattr(known, name) for name in names}
        print_json({"output": str(output), "stiffness": told, "presses": each})
        return
    modulus, sigma = 1000 * known.modulus, 1000 * known.modulus_sigma
    parts = [
        f"modulus {modulus:.4g} +- {sigma:.2g} kPa of {known.presses} presses",
        f"scatter {100 * known.scatter:.2g} %",
    ]
    if known.presses > 1:
        parts.append(f"held-out forces wrong by {100 * known.error:.2g} % RMS")
    else:
        click.echo("one press leaves no force to check by: give several, of different depths", err=True)
    click.echo(f"{output}: {', '.join(parts)}")
