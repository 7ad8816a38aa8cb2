"""``mirrorskin simulate``: a recording from the digital twin, with the truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mirrorskin.cli import options


class SimulatedMotion(StrEnum):
    """The movements that the twin can make."""

    vertical = "vertical"


class FrameType(StrEnum):
    """Types of a sample."""

    uint8 = "uint8"
    uint16 = "uint16"
    float32 = "float32"


def command(
    motion: Annotated[SimulatedMotion, typer.Argument(help="How the body moves.")],
    output: options.NewRecording,
    thing: Annotated[
        str,
        typer.Option("--object", metavar="NAME", help="sphere, coin, plane, cone, or a height map's file."),
    ] = "sphere",
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels across and down.")] = "480x480",
    pixel_size: Annotated[str, typer.Option(metavar="LENGTH[,LENGTH]", help="Size of a pixel.")] = "0.025mm",
    frames: Annotated[int, typer.Option(min=1, max=10**7, help="Frames to take.")] = 30,
    travel_step: Annotated[
        str, typer.Option(metavar="LENGTH", help="Travel from frame to frame; below zero it is lifted.")
    ] = "0.1mm",
    travel_start: Annotated[str, typer.Option(metavar="LENGTH", help="Travel of the first frame.")] = "0.1mm",
    release: Annotated[
        bool, typer.Option("--release", help="Then lift it by the same steps: frames - 1 more.")
    ] = False,
    dtype: Annotated[FrameType, typer.Option(help="Type of a sample.")] = FrameType.uint8,
    noise: Annotated[float, typer.Option(metavar="COUNTS", help="Standard deviation of a sample.")] = 1.5,
    seed: Annotated[int, typer.Option(help="The same seed, the same recording.")] = 0,
    compression: options.Compression = options.CompressionName.raw,
) -> None:
    """Record what the twin sees, with the truth."""
    import numpy as np

    from mirrorskin import hw, io
    from mirrorskin.cli.progress import progress
    from mirrorskin.cli.quantity import frame_size, length, lengths

    io.check_output(output, keep=Path(thing))
    steps = io.Steps(length(travel_step, "--travel-step"), length(travel_start, "--travel-start"))
    down = steps.positions(frames)
    travel = np.concatenate([down, down[-2::-1]]) if release else down
    columns, rows = frame_size(size, "--size")
    twin = hw.Twin(
        object=thing,
        shape=(rows, columns),
        pixel_size=lengths(pixel_size, "--pixel-size"),
        travel=travel,
        dtype=dtype.value,
        noise=noise,
        seed=seed,
    )
    with (
        io.Recorder(twin, output, compression.value, truth=twin.truth) as recorder,
        progress("simulating", len(travel)) as show,
    ):
        recorder.drain(show)
    typer.echo(f"{output}: {len(travel)} frames of {columns} x {rows}: {twin.header.title}")
