"""``mirrorskin fuse``: one surface from a press and a rotation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.declared import declared
from mirrorskin.cli.defaults import calibration_of, with_pixel_size
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import FORMATS, STACK, stack_options

if TYPE_CHECKING:
    from mirrorskin.cli.stack import StackOptions
    from mirrorskin.io import Motion, Recording


def command(
    vertical: Annotated[Path, Argument(metavar="VERTICAL", help=f"Press: {FORMATS}.")],
    axial: Annotated[
        Path | None,
        Argument(metavar="AXIAL", help="Rotation, of the same formats; that of a touch is in its recording."),
    ] = None,
    output: Annotated[Path | None, options.result_option("VERTICAL-fused.h5")] = None,
    overwrite: options.Overwrite = False,
    calibration: options.Calibration = None,
    register: Annotated[
        bool,
        Option(help="Let the rotation's frames follow the object; without it, they need no press and pivot."),
    ] = True,
    memory: options.Memory = "256MB",
    device: options.Devices = None,
    strict: options.Strict = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, STACK.without("motion", "frames", "tilt"), declared("fuse")],
) -> None:
    """Fuse a press and a rotation to one surface."""
    from mirrorskin import engine, io
    from mirrorskin.cli.output import (
        make_strict,
        progress,
        report_notes,
        report_unverified,
        save_and_report,
    )
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.engine.base.reconstruction import calibrated
    from mirrorskin.engine.fusion.fusion import frames_to_read

    make_strict(strict)
    files = [value for value in chosen.values() if isinstance(value, Path)]
    stack = stack_options(chosen)
    robust = chosen.pop("robust", False)
    limit = bytes_of(memory, "--memory")
    target = output or vertical.with_name(f"{vertical.stem}-fused.h5")
    if axial is None:
        if stack or chosen or robust or not register:
            raise io.InputError(
                f"{vertical} alone is fused as 'touch' did it: remove the options, or name AXIAL"
            )
        _repeat_touch(vertical, target, calibration, limit, device, as_json, overwrite)
        return
    with (
        _open(vertical, "vertical", stack, limit) as pressed,
        _open(axial, "axial", stack, limit) as turned,
    ):
        io.check_result_output(target, vertical, axial, calibration, *files, overwrite=overwrite)
        calibration = calibration_of(pressed, calibration)
        shared = None if calibration is None else io.open_calibration(calibration)
        with progress("fusing", frames_to_read(pressed, turned, register)) as show:
            result = engine.fuse(
                calibrated(pressed, shared),
                calibrated(turned, shared),
                rotation=chosen,
                register=register,
                robust=robust,
                memory_limit=limit,
                device=device,
                progress=show,
            )
    save_and_report(result, target, device, as_json, overwrite=overwrite)
    for path, opened, prefix in ((vertical, pressed, "vertical_"), (axial, turned, "axial_")):
        report_unverified(opened)
        process = {name.removeprefix(prefix): value for name, value in result.process.items()}
        report_notes(str(path), process)


def _repeat_touch(
    recording: Path,
    target: Path,
    calibration: Path | None,
    limit: int,
    device: str | None,
    as_json: bool,
    overwrite: bool,
) -> None:
    """Compute the surface of a touch again, from its recording."""
    from mirrorskin import engine, io
    from mirrorskin.cli.output import report_notes, report_unverified, save_and_report
    from mirrorskin.engine.base.reconstruction import calibrated
    from mirrorskin.io.files.touch_file import open_touch

    with open_touch(recording, limit) as (press, turn):
        io.check_result_output(target, recording, calibration, overwrite=overwrite)
        calibration = calibration_of(press, calibration)
        shared = None if calibration is None else io.open_calibration(calibration)
        result = engine.live.fuse_touch(calibrated(press, shared), calibrated(turn, shared), device)
    save_and_report(result, target, device, as_json, overwrite=overwrite)
    report_unverified(press)
    report_notes(str(recording), result.process)


def _open(path: Path, place: Motion, stack: StackOptions, limit: int) -> Recording:
    """Open a recording; the command line determines the motion of a file in another layout."""
    from mirrorskin import io
    from mirrorskin.io.formats.registry import format_of_surface, is_of_others
    from mirrorskin.io.storage.layout import MARK
    from mirrorskin.io.storage.zarr import open_file

    ours = False
    if not is_of_others(path) and format_of_surface(path) is None:
        with open_file(path) as file:
            ours = file.marked(MARK)
    mine: Any = {**stack, "dataset": None, "channel": None} if ours else {**stack, "motion": place}
    return with_pixel_size(io.open_recording(path, memory_limit=limit, **mine))
