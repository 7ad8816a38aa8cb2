"""``mirrorskin reconstruct``: a recording becomes maps."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json


class EventName(StrEnum):
    """What to look for."""

    onset = "onset"
    release = "release"


class MethodName(StrEnum):
    """What tells a height."""

    threshold = "threshold"
    change_point = "change-point"


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC.h5", help="Frames in HDF5.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="RES.h5", help="Result to write.", show_default="REC-result.h5"
        ),
    ] = None,
    dataset: Annotated[str | None, typer.Option(metavar="PATH", help="The stack in another's file.")] = None,
    motion: options.Motion = None,
    travel_step: options.TravelStep = None,
    travel_start: options.TravelStart = None,
    phase_step: options.PhaseStep = None,
    tilt: options.Tilt = None,
    pixel_size: options.PixelSize = None,
    dark: Annotated[
        float | None, typer.Option(metavar="COUNTS", help="Without light; else the file's.")
    ] = None,
    bright: Annotated[float | None, typer.Option(metavar="COUNTS", help="With full light.")] = None,
    event: Annotated[
        EventName, typer.Option(help="Dark to light on the way down, or light to dark on the way up.")
    ] = EventName.onset,
    method: Annotated[
        MethodName, typer.Option(help="First crossing of the threshold, or most likely change.")
    ] = MethodName.threshold,
    threshold: Annotated[
        float, typer.Option(help="Share of the way from dark to bright that is light.")
    ] = 0.5,
    hold: Annotated[int, typer.Option(help="Frames in a row that make the event.")] = 2,
    subframe: Annotated[bool, typer.Option(help="Look between frames; without it, eq. 4 as printed.")] = True,
    noise: Annotated[
        float | None, typer.Option(metavar="COUNTS", help="Standard deviation; else told from two frames.")
    ] = None,
    memory: Annotated[str, typer.Option(metavar="SIZE", help="Memory for frames on the move.")] = "256MB",
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Reconstruct heights from a recording."""
    from mirrorskin import engine, io
    from mirrorskin.cli.positions import given
    from mirrorskin.cli.progress import progress
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.kernels.device import open_device

    known = given(motion, travel_step, travel_start, phase_step, tilt, pixel_size)
    limit = bytes_of(memory, "--memory")
    with io.open_recording(recording, dataset=dataset, memory_limit=limit, **known) as source:
        target = output or recording.with_name(f"{recording.stem}-result.h5")
        io.check_output(target, keep=recording)
        with progress("reconstructing", source.shape[0]) as show:
            result = engine.reconstruct(
                source,
                event=event.value,
                method=method.value,
                threshold=threshold,
                hold=hold,
                subframe=subframe,
                dark=dark,
                bright=bright,
                noise=noise,
                memory_limit=limit,
                device=device,
                progress=show,
            )
    io.save_result(result, target)
    summary = engine.summarise(result)
    if as_json:
        profile = open_device(device).profile.records()
        print_json({"output": str(target), "summary": summary, "process": result.process, "profile": profile})
    else:
        typer.echo(f"{target}: {summary}")
