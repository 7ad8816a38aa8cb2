"""``mirrorskin correlate``: the raw correlation of any stack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.declared import declared
from mirrorskin.cli.groups import Argument
from mirrorskin.cli.stack import FORMATS, STACK, stack_options

_TRAVEL = ("travel", "travel_step", "travel_start")


def command(
    stack: Annotated[Path, Argument(metavar="STACK", help=f"Frames: {FORMATS}.")],
    output: Annotated[Path | None, options.result_option("STACK-correlation.h5")] = None,
    overwrite: options.Overwrite = False,
    memory: options.Memory = "256MB",
    device: options.Devices = None,
    as_json: options.Json = False,
    **chosen: Annotated[Any, STACK.without("motion", "tilt", *_TRAVEL), declared("correlate")],
) -> None:
    """Fit mean, cosine and sine of the phase to each pixel's brightness."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress, report_unverified, save_and_report
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.engine.vibration.lock_in import LockIn

    phases = chosen.get("phases")
    opening = stack_options(chosen)
    if chosen.get("dither"):
        if "frequency" in chosen or "phase" in opening:
            raise io.InputError("--dither takes the phases from the travel. Remove those given")
    else:
        opening["motion"] = "axial"
    if "frequency" in chosen:
        if "phase" in opening:
            raise io.InputError("--frequency gives the phases. Remove --phase-step and --phases")
        opening["phase"] = io.Steps(0.0)
    limit = bytes_of(memory, "--memory")
    override = not chosen.get("dither", False)
    with io.open_recording(stack, memory_limit=limit, override_motion=override, **opening) as source:
        target = output or stack.with_name(f"{stack.stem}-correlation.h5")
        io.check_result_output(target, stack, phases, overwrite=overwrite)
        method = LockIn(**{**chosen, "memory_limit": limit, "device": device})
        with progress("correlating", source.shape[0]) as show:
            result = method.run(source, show)
    save_and_report(result, target, device, as_json, overwrite=overwrite)
    report_unverified(source)
