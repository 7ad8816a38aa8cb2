"""``mirrorskin correlate``: the raw correlation of any stack."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option


def command(
    stack: Annotated[Path, Argument(metavar="STACK", help="Frames in HDF5, of any layout.")],
    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            metavar="RES.h5",
            help="Result to write: HDF5, or NAME.zarr.",
            show_default="STACK-correlation.h5",
        ),
    ] = None,
    dataset: options.Dataset = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
    harmonic: Annotated[int, Option(metavar="N", min=1, help="Multiple of the phase that is fitted.")] = 1,
    frequency: Annotated[
        str | None,
        Option(metavar="HZ", help="Phase by the time of the frames, instead of a turn: 12.5, or 'estimate'."),
    ] = None,
    dither: Annotated[
        bool,
        Option("--dither", help="Phase by the travel of a press that dithers: the contact's growth, too."),
    ] = False,
    frame_rate: Annotated[
        float | None, Option(metavar="HZ", help="Of the frames, where the file has no times.")
    ] = None,
    pixel_size: options.PixelSize = None,
    region: options.Region = None,
    frames: options.Frames = None,
    memory: options.Memory = "256MB",
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Fit mean, cosine and sine of the phase to each pixel's brightness."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress, save_and_report
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.cli.stack import stack_options
    from mirrorskin.engine.rotation.rotation import correlate_source

    rate = _frequency(frequency, phase_step, phases, dither)
    known = stack_options(
        motion=None if dither else options.MotionName.axial,
        phase_step=phase_step if rate is None else "0deg",
        phases=phases,
        pixel_size=pixel_size,
        region=region,
        frames=frames,
    )
    limit = bytes_of(memory, "--memory")
    with io.open_recording(
        stack, dataset=dataset, memory_limit=limit, override_motion=not dither, **known
    ) as source:
        target = output or stack.with_name(f"{stack.stem}-correlation.h5")
        io.check_output(target, stack, phases, or_zarr=True)
        with progress("correlating", source.shape[0]) as show:
            result = correlate_source(
                source,
                harmonic=harmonic,
                frequency=rate,
                frame_rate=frame_rate,
                dither=dither,
                memory_limit=limit,
                device=device,
                progress=show,
            )
    save_and_report(result, target, device, as_json)


def _frequency(
    text: str | None, phase_step: str | None, phases: Path | None, dither: bool
) -> float | Literal["estimate"] | None:
    """Read a frequency, hertz."""
    from mirrorskin.io import InputError

    if dither and (text or phase_step or phases):
        raise InputError("--dither takes the phases from the travel: leave out those given")
    if text is None:
        return None
    if phase_step is not None or phases is not None:
        raise InputError("--frequency gives the phases: leave --phase-step and --phases out")
    if text == "estimate":
        return "estimate"
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(f"--frequency {text}: hertz above 0 are needed, such as 12.5, or 'estimate'")
    return value
