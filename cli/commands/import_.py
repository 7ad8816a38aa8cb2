"""``mirrorskin import``: a recording from frames of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.defaults import with_pixel_size
from mirrorskin.cli.groups import Argument, Option, refuse_foreign
from mirrorskin.cli.stack import FORMATS, IMPORTED, stack_options


def command(
    context: click.Context,
    frames: Annotated[Path, Argument(metavar="FRAMES", help=f"Frames: {FORMATS}.")],
    output: options.NewRecording,
    motion: Annotated[options.MotionName, Option(help="How the body moved.")],
    compression: options.Compression = options.CompressionName.raw,
    overwrite: options.Overwrite = False,
    strict: options.Strict = False,
    **chosen: Annotated[Any, IMPORTED],
) -> None:
    """Convert frames of another program to a recording."""
    from mirrorskin import io
    from mirrorskin.cli.output import make_strict, printable, progress, report_notes
    from mirrorskin.io.base.findings import in_process, warn

    make_strict(strict)

    refuse_foreign(context, motion.value, str(frames))
    files = [value for value in chosen.values() if isinstance(value, Path)]
    io.check_output(output, frames, *files, replaces="anything" if overwrite else "nothing")
    stack = stack_options(chosen)
    stack["motion"] = motion.value
    source = with_pixel_size(io.open_recording(frames, **stack))
    with (
        io.Recorder(source, output, compression.value, overwrite=overwrite) as recorder,
        progress("importing", source.shape[0]) as show,
    ):
        report = recorder.drain(show)
        process = in_process(report.findings, {})
        warn(str(frames), process)
    report_notes(str(frames), process)
    if source.header.pixel_size is None:
        message = (
            f"{output}: no pixel size: holes are not filled, and normals, slip and measures need it;"
            " give --pixel-size here or to 'reconstruct'"
        )
        click.echo(printable(message), err=True)
    for name in source.left_out:
        click.echo(printable(f"left out: {name}"), err=True)
    count, rows, columns = source.shape
    size = f"{count} frames of {columns} x {rows}"
    click.echo(printable(f"{output}: {size}, {source.dtype}, {motion.value} motion"))
