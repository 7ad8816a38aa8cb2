"""``mirrorskin import``: other people's frames become a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option


def command(
    frames: Annotated[
        Path,
        Argument(
            metavar="FRAMES", help="AVI, MP4, NPY, NPZ, MCAP, or a folder of numbered PNG/TIFF pictures."
        ),
    ],
    output: options.NewRecording,
    motion: Annotated[options.MotionName, Option(help="How the body moved.")],
    travel_step: options.TravelStep = None,
    travel_start: options.TravelStart = None,
    travel: options.Travel = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
    tilt: options.Tilt = None,
    pixel_size: options.PixelSize = None,
    topic: Annotated[str | None, Option(metavar="TOPIC", help="Of an MCAP file: that of the images.")] = None,
    compression: options.Compression = options.CompressionName.raw,
    overwrite: options.Overwrite = False,
) -> None:
    """Make a recording of a video or pictures."""
    from mirrorskin import io
    from mirrorskin.cli.output import printable, progress
    from mirrorskin.cli.stack import stack_options

    io.check_output(output, frames, phases, travel, replaces="anything" if overwrite else "nothing")
    known = stack_options(
        travel_step=travel_step,
        travel_start=travel_start,
        travel=travel,
        phase_step=phase_step,
        phases=phases,
        tilt=tilt,
        pixel_size=pixel_size,
    )
    header = io.Header(
        motion.value, title=frames.stem, tilt=known.get("tilt"), pixel_size=known.get("pixel_size")
    )
    with progress("counting frames", None) as show:
        source = io.open_frames(frames, header, known.get("travel"), known.get("phase"), topic, show)
    with (
        io.Recorder(source, output, compression.value, overwrite=overwrite) as recorder,
        progress("importing", source.shape[0]) as show,
    ):
        recorder.drain(show)
    if header.pixel_size is None:
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
