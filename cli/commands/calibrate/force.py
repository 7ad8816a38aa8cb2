"""``mirrorskin calibrate force``: the gel's modulus, from presses of measured force."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.force import StiffnessFit
    from mirrorskin.io import Calibration, Source

_REMEDY = "write REC.h5,newtons, one line per press"


def command(
    output: options.LearnedCalibration,
    presses: Annotated[
        list[Path], Argument(metavar="REC.h5...", help="Vertical recordings with measured forces.")
    ],
    force: Annotated[
        list[str] | None,
        Option(metavar="FORCE", help="Greatest force of each press in turn, 1.5N or 150g; repeat it."),
    ] = None,
    readings: Annotated[
        Path | None, Option(metavar="CSV", help="The same as a file: a line REC.h5,newtons for each press.")
    ] = None,
    force_sigma: Annotated[
        str | None, Option(metavar="FORCE", help="Standard deviation of the scale's readings: 5mN.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("travel_step", "travel_start", "pixel_size", "verify")],
) -> None:
    """Learn the modulus, for forces in newtons, from a scale or known weights; after elastic."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import force as newtons_of
    from mirrorskin.engine.calibration.force import fit_stiffness, known_press

    newtons = _forces(presses, force or [], readings)
    sigma = 0.0 if force_sigma is None else newtons_of(force_sigma, "--force-sigma")

    def fit(sources: list[Source], calibration: Calibration | None, paths: list[Path]) -> inputs.Learned:
        if calibration is None or calibration.gel is None:
            raise io.InputError(
                f"{output} has no gel, which is needed to compute loads: run calibrate elastic first"
            )
        measured = []
        for source, value in zip(sources, newtons, strict=True):
            with progress("pressing", source.shape[0]) as show:
                measured.append(known_press(source, calibration, value, sigma, device=device, progress=show))
        return _learned(fit_stiffness(measured, calibration.gel), paths, newtons)

    inputs.learn(output, presses, fit, stack, as_json)


def _forces(presses: list[Path], texts: list[str], readings: Path | None) -> list[float]:
    """Return the force of each press, N."""
    from mirrorskin.cli.quantity import force
    from mirrorskin.io import InputError

    if (readings is None) != bool(texts):
        raise InputError("give the forces either as --force, one per recording, or as --readings CSV")
    if readings is None:
        if len(texts) != len(presses):
            raise InputError(f"{len(presses)} recordings and {len(texts)} times --force: give one for each")
        return [force(text, "--force") for text in texts]
    table = _table(readings)
    missing = [str(path) for path in presses if path.name not in table]
    if missing:
        raise InputError(f"{readings} has no line for {missing[0]}: {_REMEDY}")
    return [table[path.name] for path in presses]


def _table(path: Path) -> dict[str, float]:
    """Read forces by the names of recordings, newtons where no unit is stated."""
    from mirrorskin.cli import table
    from mirrorskin.cli.quantity import force
    from mirrorskin.io import InputError
    from mirrorskin.io.base.text import shortened

    read = table.read_table(path, _REMEDY)
    has_units = read.columns == len(read.heading) == 3 and "unit" in read.heading[2].lower()
    column = 1 if read.columns > 1 else 0
    units = table.row_units(path, read, column, "force", {"force", "load", "weight", "reading"}, "N")
    forces = {}
    for row, unit in zip(read.rows, units, strict=True):
        line = shortened(",".join(row.cells))
        if len(row.cells) != 2 + has_units:
            raise InputError(f"{row.where} {line!r} is not a recording and a force: {_REMEDY}")
        name, text = row.cells[:2]
        forces[Path(name).name] = force(text if text[-1:].isalpha() else f"{text}{unit}", row.where)
    return forces


def _learned(fit: StiffnessFit, presses: list[Path], newtons: list[float]) -> inputs.Learned:
    stiffness, several = fit.stiffness, fit.stiffness.presses > 1
    columns = map(str, presses), fit.residual.tolist(), fit.held_out.tolist(), fit.sigma.tolist()
    keys = "recording", "residual", "held_out", "sigma"
    each = [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)]
    names = "modulus", "modulus_sigma", "gel_shift", "scatter", "error"
    modulus, sigma = 1000 * stiffness.modulus, 1000 * stiffness.modulus_sigma
    held_out = f", held-out forces wrong by {100 * stiffness.error:.2g} % RMS" if several else ""
    return inputs.Learned(
        stiffness,
        {"sources": presses, "forces": str(newtons)},
        {"stiffness": {name: getattr(stiffness, name) for name in names}, "presses": each},
        f"modulus {modulus:.4g} ± {sigma:.2g} kPa from {stiffness.presses} press{'es' if several else ''},"
        f" scatter {100 * stiffness.scatter:.2g} %{held_out}",
        [] if several else ["one press leaves no force to check by: give several, of different depths"],
    )
