"""``mirrorskin correlate``: the raw correlation of any stack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option


def command(
    stack: Annotated[Path, Argument(metavar="STACK", help="Frames in HDF5, of any layout.")],
    output: Annotated[
        Path | None,
        Option(
            "--output", "-o", metavar="RES.h5", help="Result to write.", show_default="STACK-correlation.h5"
        ),
    ] = None,
    dataset: options.Dataset = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
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

    known = stack_options(
        motion=options.MotionName.axial,
        phase_step=phase_step,
        phases=phases,
        pixel_size=pixel_size,
        region=region,
        frames=frames,
    )
    limit = bytes_of(memory, "--memory")
    with io.open_recording(
        stack, dataset=dataset, memory_limit=limit, override_motion=True, **known
    ) as source:
        target = output or stack.with_name(f"{stack.stem}-correlation.h5")
        io.check_output(target, stack, phases)
        with progress("correlating", source.shape[0]) as show:
            result = correlate_source(source, memory_limit=limit, device=device, progress=show)
    save_and_report(result, target, device, as_json)
