"""``mirrorskin run``: a user's own estimator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option

Own = Annotated[
    str,
    Argument(metavar="MODULE:CLASS", help="Your class, in a module or file: mine:Sum, or mine.py:Sum."),
]
Settings = Annotated[
    list[str] | None,
    Option("--set", metavar="NAME=VALUE", help="A parameter of the class, more than once if you like."),
]


def command(
    estimator: Own,
    recording: Annotated[Path, Argument(metavar="REC.h5", help="Frames in HDF5, Zarr, NPY or NPZ.")],
    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            metavar="RES.h5",
            help="Result to write: HDF5, or NAME.zarr.",
            show_default="REC-CLASS.h5",
        ),
    ] = None,
    settings: Settings = None,
    dataset: options.Dataset = None,
    motion: options.Motion = None,
    travel_step: options.TravelStep = None,
    travel_start: options.TravelStart = None,
    travel: options.Travel = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
    pixel_size: options.PixelSize = None,
    region: options.Region = None,
    frames: options.Frames = None,
    live: Annotated[
        bool, Option("--live", help="Only the frames that a live run used, with the positions it had.")
    ] = False,
    memory: options.Memory = "256MB",
    as_json: options.Json = False,
) -> None:
    """Run an estimator of your own over a recording.

    ESTIMATOR is a class with the methods of mirrorskin.engine.Estimator: it is called with a frame's (rows,
    columns) and sample type, push(frames) gets the next frames (n, rows, columns), result() returns maps by
    name, and reset() forgets the frames.
    """
    from mirrorskin import engine, io
    from mirrorskin.cli.output import progress, save_and_report
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.cli.stack import stack_options

    make = load_estimator(estimator, settings)
    known = stack_options(
        motion=motion,
        travel_step=travel_step,
        travel_start=travel_start,
        travel=travel,
        phase_step=phase_step,
        phases=phases,
        pixel_size=pixel_size,
        region=region,
        frames=frames,
    )
    limit = bytes_of(memory, "--memory")
    with io.open_recording(recording, dataset=dataset, memory_limit=limit, live=live, **known) as source:
        target = output or recording.with_name(f"{recording.stem}-{estimator.rpartition(':')[2]}.h5")
        io.check_output(target, recording, phases, travel, or_zarr=True)
        with progress("running", source.shape[0]) as show:
            result = engine.run(source, make, memory_limit=limit, progress=show)
    device = result.process.get("device")
    save_and_report(result, target, None if device is None else str(device), as_json)


def load_estimator(name: str, settings: list[str] | None = None) -> Any:
    """Return what makes the estimator that is named MODULE:CLASS or FILE.py:CLASS, with parameters set."""
    import ast
    import functools

    from mirrorskin.io import InputError
    from mirrorskin.io.own_class import load_class

    made = load_class(name)
    values: dict[str, Any] = {}
    for setting in settings or ():
        parameter, equals, text = setting.partition("=")
        if not equals or not parameter.isidentifier():
            raise InputError(f"--set {setting}: NAME=VALUE is needed, such as threshold=0.5")
        try:
            values[parameter] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[parameter] = text
    return functools.partial(made, **values) if values else made
