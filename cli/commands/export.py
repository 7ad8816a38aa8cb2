"""``mirrorskin export``: a result as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK
from mirrorskin.io.formats.registry import contents

_APEX = "apex"


def command(
    result: Annotated[Path, Argument(metavar="RES.h5", help="Result, or for .mcap and .zarr a recording.")],
    output: Annotated[
        list[Path],
        Option(
            "--output",
            "-o",
            metavar="FILE",
            help=f"File to write, more than once if you like: {contents()}, also at an address such as"
            " s3://bucket/NAME.zarr.",
        ),
    ],
    turn: options.Turn = None,
    map_name: Annotated[
        str,
        Option(
            "--map",
            metavar="NAME",
            help="Map to write, such as your own, to .csv, .tif (float32) or .npz.",
            show_default="heights; all maps in .npz",
        ),
    ] = "",
    section: Annotated[
        str | None,
        Option(
            metavar=f"X1,Y1:X2,Y2|{_APEX}",
            help="A .csv of a cross-section between two points, from the picture's centre:"
            " -2mm,0mm:2mm,0mm, or across the apex.",
            show_default="a .csv of all heights",
        ),
    ] = None,
    points: Annotated[bool, Option("--points", help="A .ply of points, without triangles.")] = False,
    float32: Annotated[
        bool, Option("--float32", help="A .tif of float32 in mm, NaN for holes, instead of 16 bits.")
    ] = False,
    **stack: Annotated[Any, STACK.only("verify")],
) -> None:
    """Write a result as meshes, points, surface files, pictures, tables or arrays."""
    from mirrorskin import io
    from mirrorskin.cli.output import printable, progress
    from mirrorskin.cli.quantity import segment
    from mirrorskin.engine.metrology import section_columns
    from mirrorskin.io.files.opening import is_recording
    from mirrorskin.io.formats.export import check_export
    from mirrorskin.io.formats.registry import export_format, export_suffixes

    suffixes = {path.suffix.lower() for path in output}
    chosen = {"map_name": map_name, "section": section, "points": points, "float32": float32}
    for option, value in chosen.items():
        if value and not suffixes & {*(taken := export_suffixes(option))}:
            name = option.removesuffix("_name")
            raise io.InputError(f"--{name} is for a {taken[0]} file: name one with -o, or leave --{name} out")
    ends = None if section in (None, _APEX) else segment(section, "--section")
    stores, output = _part(output, result, turn, map_name)
    forms = {path: form for path in output if (form := export_format(path.suffix.lower()))}
    if all(path in forms and forms[path].of_recordings for path in output) and is_recording(result):
        with io.open_recording(result, **stack) as recording:
            for path, form in forms.items():
                click.echo(printable(f"{path}: {form.load(form.encoder)(recording, path)}"))
    elif output:
        saved = io.select_turn(io.open_result(result), turn)
        for path in output:
            check_export(saved, path, map_name)
        columns = None if section is None else section_columns(saved, ends)
        for path in output:
            holds = io.export_result(
                saved, path, map_name=map_name, section=columns, points=points, float32=float32
            )
            click.echo(printable(f"{path}: {holds}"))
    for path in stores:
        with progress("exporting", None) as show:
            click.echo(printable(f"{path}: {io.save_zarr(result, path, show, **stack)}"))


def _part(output: list[Path], result: Path, turn: int | None, map_name: str) -> tuple[list[Path], list[Path]]:
    """Check all outputs, and return those in Zarr and the others."""
    from mirrorskin.io import InputError, check_output
    from mirrorskin.io.base.url import is_zarr
    from mirrorskin.io.files.zarr_export import check_store

    for number, path in enumerate(output):
        if path.resolve() in (other.resolve() for other in output[:number]):
            raise InputError(f"{path} is to be written twice: name another output with -o")
    stores = [path for path in output if is_zarr(path)]
    if stores and turn is not None:
        raise InputError(f"{stores[0]} takes all turns: leave --turn out")
    if stores and map_name:
        raise InputError(f"{stores[0]} takes all maps: leave --map out")
    for path in output:
        if path in stores:
            check_store(path)
        else:
            check_output(path, result)
    return stores, [path for path in output if path not in stores]
