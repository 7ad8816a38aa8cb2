"""``mirrorskin run``: one operation, built-in or a user's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.declared import ClassCommand
from mirrorskin.cli.defaults import calibration_of, with_pixel_size
from mirrorskin.cli.groups import Argument, make_command
from mirrorskin.cli.stack import FORMATS, RECORDING, stack_options


def command(
    class_name: Annotated[
        str, Argument(metavar="MODULE:CLASS", help="Class: mine:Sum, mine.py:Sum, or an installed name.")
    ],
    recording: Annotated[Path, Argument(metavar="REC.h5", help=f"Frames: {FORMATS}.")],
    output: Annotated[Path | None, options.result_option("REC-CLASS.h5")] = None,
    overwrite: options.Overwrite = False,
    live: options.LiveFrames = False,
    calibration: options.Calibration = None,
    memory: options.Memory = "256MB",
    device: options.Devices = None,
    strict: options.Strict = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, RECORDING],
) -> None:
    """Run an operation over a recording: built-in, or your own.

    The class is built-in, such as mirrorskin.engine:Onset, or your own: one derived from
    mirrorskin.engine.Operation. 'mirrorskin run MODULE:CLASS --help' shows its options.
    """
    from mirrorskin import io
    from mirrorskin.cli.output import make_strict, progress, report_notes, report_unverified, save_and_report
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.engine.base.reconstruction import load_operation, run_class
    from mirrorskin.kernels.device import open_devices

    make_strict(strict)
    kind = load_operation(class_name)
    if device is not None:
        open_devices(device)  # raises if there is none, even if the operation does not use it
    files = [value for value in chosen.values() if isinstance(value, Path)]
    stack = stack_options(chosen)
    limit = bytes_of(memory, "--memory")
    with io.open_recording(recording, memory_limit=limit, live=live, **stack) as source:
        target = output or recording.with_name(f"{recording.stem}-{kind.__name__}.h5")
        io.check_result_output(target, recording, calibration, *files, overwrite=overwrite)
        calibration = calibration_of(source, calibration)
        frames = with_pixel_size(source)
        with progress("running", frames.shape[0]) as show:
            result = run_class(kind, frames, show, calibration, memory_limit=limit, device=device, **chosen)
    save_and_report(result, target, device, as_json, overwrite=overwrite)
    report_unverified(source)
    report_notes(str(recording), result.process)


app = make_command("run", command, ClassCommand)
