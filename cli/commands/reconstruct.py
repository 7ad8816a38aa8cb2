"""``mirrorskin reconstruct``: from a recording to maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.declared import declared
from mirrorskin.cli.defaults import calibration_of, with_pixel_size
from mirrorskin.cli.groups import Argument, refuse_foreign
from mirrorskin.cli.stack import FORMATS, RECORDING, stack_options

_REMEDIES = {"zenith": "--zenith-gain", "height": "--pixel-size"}  # by maps that are missing


def command(
    context: click.Context,
    recording: Annotated[Path, Argument(metavar="REC.h5", help=f"Frames: {FORMATS}.")],
    output: Annotated[Path | None, options.result_option("REC-result.h5")] = None,
    overwrite: options.Overwrite = False,
    live: options.LiveFrames = False,
    calibration: options.Calibration = None,
    memory: options.Memory = "256MB",
    device: options.Devices = None,
    strict: options.Strict = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, RECORDING, declared("reconstruct")],
) -> None:
    """Reconstruct heights from a press, normals and heights from a rotation, or slip."""
    from mirrorskin import engine, io
    from mirrorskin.cli import output as outputs
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.engine.base.reconstruction import calibrated

    outputs.make_strict(strict)
    files = [value for value in chosen.values() if isinstance(value, Path)]
    stack = stack_options(chosen)
    limit = bytes_of(memory, "--memory")
    with io.open_recording(recording, memory_limit=limit, live=live, **stack) as opened:
        refuse_foreign(context, opened.motion, str(recording))
        target = output or recording.with_name(f"{recording.stem}-result.h5")
        io.check_result_output(target, recording, calibration, *files, overwrite=overwrite)
        calibration = calibration_of(opened, calibration)
        source = calibrated(with_pixel_size(opened), calibration)
        if isinstance(source, io.Calibrated):
            if source.whole.lens is not None and "pixel_size" in stack:
                raise io.InputError(f"{source.whole.name} gives the pixel size. Remove --pixel-size")
        elif "tilt" in stack:  # without a calibration, it is the recording's own
            del chosen["tilt"]
        with outputs.progress("reconstructing", source.shape[0]) as show:
            result = engine.reconstruct(source, memory_limit=limit, device=device, progress=show, **chosen)
    io.save_result(result, target, overwrite=overwrite)  # a failure is the only message
    outputs.report_unverified(opened)
    outputs.report_notes(str(recording), result.process)
    outputs.report_missing_maps(str(recording), result.process, _REMEDIES)
    outputs.report_contact(str(recording), result.process)
    outputs.report_saved(result, target, device, as_json)
