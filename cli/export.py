"""``mirrorskin export``: a result as files that other programs open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mirrorskin.io import Result

Point = tuple[float, float]


def command(
    result: Annotated[Path, Argument(metavar="RES.h5", help="Result, or for .mcap and .zarr a recording.")],
    output: Annotated[
        list[Path],
        Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write, more than once if you like: a mesh .ply or .stl, points .xyz, heights in"
            " 16 bits .png or .tif, a cross-section .csv, arrays .npz, ROS 2 messages .mcap, the same as Zarr"
            " .zarr, also at an address such as s3://bucket/NAME.zarr.",
        ),
    ],
    turn: options.Turn = None,
    section: options.Section = None,
    points: Annotated[bool, Option("--points", help="A .ply of points, without triangles.")] = False,
) -> None:
    """Write a result as meshes, points, pictures, tables or arrays."""
    from mirrorskin import io
    from mirrorskin.cli.output import printable, progress
    from mirrorskin.cli.quantity import segment
    from mirrorskin.io.export import check_export
    from mirrorskin.io.foreign import MCAP_SUFFIX
    from mirrorskin.io.recording import is_recording

    suffixes = {path.suffix.lower() for path in output}
    for given, suffix, option in ((section, ".csv", "--section"), (points, ".ply", "--points")):
        if given and suffix not in suffixes:
            raise io.InputError(f"{option} is for a {suffix} file: name one with -o, or leave {option} out")
    ends = None if section is None else segment(section, "--section")
    stores, output = _part(output, result, turn)
    if all(path.suffix.lower() == MCAP_SUFFIX for path in output) and is_recording(result):
        with io.open_recording(result) as recording:
            for path in output:
                click.echo(printable(f"{path}: {io.save_messages(recording, path)}"))
    elif output:
        found = io.select_turn(io.open_result(result), turn)
        for path in output:
            check_export(found, path)
        columns = _section(found, ends) if ".csv" in suffixes else None
        for path in output:
            holds = io.export_result(found, path, section=columns, points=points)
            click.echo(printable(f"{path}: {holds}"))
    for path in stores:
        with progress("exporting", None) as show:
            click.echo(printable(f"{path}: {io.save_zarr(result, path, show)}"))


def _part(output: list[Path], result: Path, turn: int | None) -> tuple[list[Path], list[Path]]:
    """Return the outputs in Zarr and the others, after checking all of them."""
    from mirrorskin.io import InputError, check_output
    from mirrorskin.io.url import is_zarr
    from mirrorskin.io.zarr_export import check_store

    for number, path in enumerate(output):
        if path.resolve() in (other.resolve() for other in output[:number]):
            raise InputError(f"{path} is to be written twice: name another output with -o")
    stores = [path for path in output if is_zarr(path)]
    if stores and turn is not None:
        raise InputError(f"{stores[0]} takes all turns: leave --turn out")
    for path in output:
        if path in stores:
            check_store(path)
        else:
            check_output(path, result)
    return stores, [path for path in output if path not in stores]


def _section(result: Result, ends: tuple[Point, Point] | None) -> dict[str, NDArray[Any]]:
    """Cut a result between two points, or across its apex, into the columns of a table."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.engine.metrology import section

    cut = section(result, *(ends or ()))
    if not np.isfinite(cut.height).any():
        raise io.InputError("no height is known along the section: choose other points, or leave it out")
    known = {"sigma": result.height_sigma, "filled": result.filled}
    names = ("distance", "x", "y", "height", *(name for name, values in known.items() if values is not None))
    return {name: getattr(cut, name) for name in names}
