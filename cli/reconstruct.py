"""``mirrorskin reconstruct``: a recording becomes maps."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from mirrorskin.io import Recording, Source


class EventName(StrEnum):
    """What to look for."""

    onset = "onset"
    release = "release"


class MethodName(StrEnum):
    """How heights, or normals, are estimated."""

    threshold = "threshold"
    change_point = "change-point"
    exact = "exact"
    paper = "paper"


# The options that only one motion has.
_OWN = {
    MotionName.vertical: {
        *(
            "method",
            "travel_step",
            "travel_start",
            "travel",
            "dark",
            "bright",
            "event",
            "threshold",
            "inclination",
            "hold",
            "subframe",
            "fill",
            "modulus",
        )
    },
    MotionName.axial: {
        *(
            "method",
            "phase_step",
            "phases",
            "tilt",
            "zenith_gain",
            "zenith_offset",
            "robust",
            "per_turn",
            "heights",
        )
    },
    MotionName.horizontal: {"contact", "per_frame", "window", "step", "modulus"},
    MotionName.twist: {"contact", "per_frame", "window", "step", "modulus"},
}
_ESTIMATE = "estimate"
# What would bring a map that is missing: options.
_REMEDIES = {"zenith": "--zenith-gain", "height": "--pixel-size"}


def command(
    context: click.Context,
    recording: Annotated[Path, Argument(metavar="REC.h5", help="Frames in HDF5, Zarr, NPY or NPZ.")],
    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            metavar="RES.h5",
            help="Result to write: HDF5, or NAME.zarr.",
            show_default="REC-result.h5",
        ),
    ] = None,
    dataset: options.Dataset = None,
    motion: options.Motion = None,
    travel_step: options.TravelStep = None,
    travel_start: options.TravelStart = None,
    travel: options.Travel = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
    tilt: Annotated[
        str | None,
        Option(metavar="ANGLE", help="Half-angle of the precession: 2.5deg, or 'estimate'."),
    ] = None,
    pixel_size: options.PixelSize = None,
    region: options.Region = None,
    frames: options.Frames = None,
    live: Annotated[
        bool,
        Option("--live", help="Only the frames that a live run used, with the positions it had."),
    ] = False,
    method: Annotated[
        MethodName | None,
        Option(
            help="Press: first crossing of the threshold, or most likely change."
            " Rotation: most likely normal, or the paper's equations 16 to 22.",
            show_default="threshold; of a rotation exact",
        ),
    ] = None,
    noise: Annotated[
        float | None,
        Option(
            metavar="COUNTS", help="Standard deviation of a sample; by default estimated from the frames."
        ),
    ] = None,
    dark: Annotated[
        float | None, Option(metavar="COUNTS", help="Press: without light; else the file's.")
    ] = None,
    bright: Annotated[float | None, Option(metavar="COUNTS", help="Press: with full light.")] = None,
    event: Annotated[
        EventName, Option(help="Press: dark to light on the way down, or light to dark on the way up.")
    ] = EventName.onset,
    threshold: Annotated[
        list[str] | None,
        Option(
            metavar="SHARE",
            help="Press: fraction of the range from dark to bright at which a pixel is bright; several, from"
            " the lowest on, of a wall with levels.",
            show_default="0.5",
        ),
    ] = None,
    inclination: Annotated[
        list[str] | None,
        Option(metavar="ANGLE", help="Press: of the sheet where a threshold is passed, one for each: 12deg."),
    ] = None,
    hold: Annotated[int, Option(help="Press: consecutive frames that confirm the event.")] = 2,
    subframe: Annotated[
        bool, Option(help="Press: interpolate between frames; without it, eq. 4 as printed.")
    ] = True,
    fill: Annotated[bool, Option(help="Press: fill holes, such as flat tops, smoothly.")] = True,
    modulus: Annotated[
        str | None,
        Option(
            metavar="PRESSURE",
            help="All but rotation: Young's, for force, pressure and traction: 0.1MPa.",
            show_default="the calibration's",
        ),
    ] = None,
    zenith_gain: options.ZenithGain = None,
    zenith_offset: options.ZenithOffset = None,
    robust: options.Robust = False,
    per_turn: Annotated[
        bool, Option("--per-turn", help="Rotation: maps of each turn, not of all together.")
    ] = False,
    heights: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Rotation: heights (a result or a simulation) for registering the frames.",
        ),
    ] = None,
    contact: options.Contact = None,
    per_frame: Annotated[
        bool, Option("--per-frame", help="Slide, twist: the displacement in each frame, not in the last.")
    ] = False,
    window: Annotated[
        int | None, Option(metavar="PIXELS", help="Slide, twist: side of a window.", show_default="8")
    ] = None,
    step: Annotated[
        int | None, Option(metavar="PIXELS", help="Slide, twist: from window to window.", show_default="4")
    ] = None,
    calibration: options.Calibration = None,
    memory: options.Memory = "256MB",
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Reconstruct heights from a press, normals and heights from a rotation, or slip."""
    from mirrorskin import engine, io
    from mirrorskin.cli.output import (
        progress,
        report_contact,
        report_levels,
        report_missing_maps,
        save_and_report,
    )
    from mirrorskin.cli.quantity import memory as bytes_of
    from mirrorskin.cli.quantity import per_angle, pressure
    from mirrorskin.cli.stack import stack_options

    known = stack_options(
        motion=motion,
        travel_step=travel_step,
        travel_start=travel_start,
        travel=travel,
        phase_step=phase_step,
        phases=phases,
        tilt=None if tilt == _ESTIMATE else tilt,
        pixel_size=pixel_size,
        region=region,
        frames=frames,
    )
    gain = None if zenith_gain is None else per_angle(zenith_gain, "--zenith-gain")
    limit = bytes_of(memory, "--memory")
    with io.open_recording(recording, dataset=dataset, memory_limit=limit, live=live, **known) as source:
        _refuse_foreign(context, recording, source.motion)
        target = output or recording.with_name(f"{recording.stem}-result.h5")
        io.check_output(target, recording, phases, travel, heights, calibration, contact, or_zarr=True)
        calibrated = _calibrated(source, calibration, pixel_size)
        arguments: dict[str, Any] = {"method": method and method.value, "noise": noise}
        if modulus is not None:
            arguments["modulus"] = pressure(modulus, "--modulus")
        if source.motion == MotionName.axial:
            arguments |= {"gain": gain, "offset": zenith_offset, "per_turn": per_turn, "robust": robust}
            # A tilt that is given is believed, whatever the calibration says.
            given_tilt = None if calibrated is source else known.get("tilt")
            arguments["tilt"] = _ESTIMATE if tilt == _ESTIMATE else given_tilt
            arguments["heights"] = None if heights is None else io.open_heights(heights, source)
        elif source.motion in (MotionName.horizontal, MotionName.twist):
            arguments |= {"per_frame": per_frame, "window": window, "step": step}
            arguments["contact"] = contact
        else:
            arguments |= {"event": event.value, "hold": hold, "subframe": subframe}
            arguments |= _levels(threshold, inclination)
            arguments |= {"dark": dark, "bright": bright, "fill": fill}
        with progress("reconstructing", source.shape[0]) as show:
            result = engine.reconstruct(
                calibrated,
                **{name: value for name, value in arguments.items() if value is not None},
                memory_limit=limit,
                device=device,
                progress=show,
            )
    report_missing_maps(str(recording), result.process, _REMEDIES)
    report_contact(str(recording), result.process)
    save_and_report(result, target, device, as_json)
    report_levels(str(recording), result.process)


def _levels(thresholds: list[str] | None, inclinations: list[str] | None) -> dict[str, Any]:
    """Convert thresholds and inclinations, each given several times or with commas between."""
    from mirrorskin.cli.quantity import angle, share

    shares, angles = (
        [part for text in texts or () for part in text.split(",")] for texts in (thresholds, inclinations)
    )
    read = [share(part, "--threshold") for part in shares]
    known: dict[str, Any] = {"threshold": read[0] if len(read) == 1 else read} if read else {}
    return known | ({"inclinations": [angle(part, "--inclination") for part in angles]} if angles else {})


def _calibrated(source: Recording, path: Path | None, pixel_size: str | None) -> Source:
    """Return a recording as it is with the calibration that is given, or that it carries."""
    from mirrorskin import io
    from mirrorskin.engine.reconstruction import calibrated

    found = calibrated(source, path)
    if isinstance(found, io.Calibrated) and found.whole.lens is not None and pixel_size is not None:
        raise io.InputError(f"{found.whole.name} gives the pixel size: leave --pixel-size out")
    return found


def _refuse_foreign(context: click.Context, recording: Path, motion: str) -> None:
    """Refuse options that say nothing of the recording's motion, rather than ignore them."""
    from mirrorskin import io

    foreign = set[str]().union(*_OWN.values()) - _OWN[MotionName(motion)]
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        if option.name in foreign and source is not None and source.name == "COMMANDLINE":
            raise io.InputError(
                f"{recording} is of {motion} motion, of which {option.opts[0]} says nothing: leave it out"
            )
