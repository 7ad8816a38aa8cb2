"""``mirrorskin calibrate tilt``: how the body's axis goes round, and about which point."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.calibrate import inputs
from mirrorskin.cli.declared import declared
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK, stack_options

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.brightness import Brightness
    from mirrorskin.engine.calibration.tilt import PrecessionFit
    from mirrorskin.io import Calibration, Precession, Source

_NEGLIGIBLE = math.radians(0.1)  # of azimuth, or of the mean lean
_SURE = 3.0  # standard errors from which on even less is worth a line
_RESPONSE = declared("fuse").only("zenith_gain", "zenith_offset")
_ANGLES = ("tilt", "phase_offset", "major_axis", "centre_x", "centre_y")


def command(
    output: options.LearnedCalibration,
    ball: options.Ball,
    balls: Annotated[
        list[Path] | None,
        Argument(metavar="REC.h5...", help="Axial recordings of the ball, at one place or more."),
    ] = None,
    flat: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="Axial recording of a level plate; may be given again."),
    ] = None,
    wedge: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="Axial recording of an inclined plate; may be given again."),
    ] = None,
    rig: inputs.OptionalRig = None,
    places: inputs.Places = 5,
    press: Annotated[str | None, inputs.press_option("0.5mm")] = None,
    tilt: Annotated[
        str | None, Option(metavar="ANGLE", help=f"With --rig: nominal half-angle, else {inputs.TILT}.")
    ] = None,
    settle: inputs.Settle = None,
    overwrite: inputs.Overwrite = False,
    as_json: options.Json = False,
    **given: Annotated[Any, STACK.only("phase_step", "phases", "pixel_size"), _RESPONSE],
) -> None:
    """Find half-angle, phase offset, direction, ellipticity and pivot of the rotation, with their errors."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.engine.calibration.tilt import fit_precession
    from mirrorskin.engine.calibration.tilt_tracks import track_ball, track_plate

    paths, flats, wedges = list(balls or []), list(flat or []), list(wedge or [])
    radius = length(ball, "--ball") / 2
    response = given.pop("zenith_gain", None), given.pop("zenith_offset", None)
    known = inputs.check_call(
        output, paths, rig, [*flats, *wedges], press=press, tilt=tilt, settle=settle, overwrite=overwrite
    )
    if rig is not None:
        half_angle = None if tilt is None else angle(tilt, "--tilt")
        plan = inputs.turn_plan(press, half_angle, given.get("phase_step"), "0.5mm")
        turns = inputs.at_each("tilt", inputs.BALL, places, plan)
        paths = inputs.take(rig, output, turns, settle, overwrite)
        given = {}
    stack = stack_options(given)
    with inputs.open_all([*paths, *flats, *wedges], stack, known, output) as (sources, camera):
        light = _brightness(sources[0], known, *response)
        tracks, plates = [], []
        with progress("looking", len(sources)) as show:
            for number, source in enumerate(sources, 1):
                if number <= len(paths):
                    tracks.append(track_ball(source, radius, light))
                else:
                    plates.append(track_plate(source, number <= len(paths) + len(flats), light))
                show(number)
        fit = fit_precession(tracks, plates, depth_sigma=light.depth_sigma)
        named = {"sources": paths, "flats": flats, "wedges": wedges}
        process = inputs.process_of(
            sources[0],
            ball=ball,
            taken_for_granted="; ".join(fit.notes),
            **{name: inputs.names_of(some) for name, some in named.items() if some},
            **{f"left_{name}": value for name, value in fit.residual.items()},
        )
    io.update_calibration(output, fit.precession, camera, process)
    _report(output, fit, as_json)


def _brightness(
    source: Source, known: Calibration | None, gain: float | None, offset: float | None
) -> Brightness:
    """Return the response of the calibration, else the one that is linear in the zenith."""
    from dataclasses import replace

    import numpy as np

    from mirrorskin.engine.calibration.sources import pixel_size_of
    from mirrorskin.engine.calibration.brightness import LinearBrightness, WallBrightness
    from mirrorskin.io import InputError
    from mirrorskin.io.calibration.source import check_sizes

    header, shape = source.header, source.shape[1:]
    if known is not None and known.references is not None:
        header = replace(header, dark=known.references.dark, bright=known.references.bright)
    if gain is not None:
        header = replace(header, zenith_gain=np.asarray(gain, np.float64))
    if offset is not None:
        header = replace(header, zenith_offset=np.asarray(offset, np.float64))
    if known is not None and known.zenith is not None and gain is None and offset is None:
        check_sizes(known, header.pixel_size, source.name, ["zenith"])
        pixel_size = pixel_size_of(source)
        return WallBrightness.of_pixels(known.zenith, header.dark, header.bright, shape, pixel_size)
    try:
        return LinearBrightness.of_header(header, shape)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None


def _report(output: Path, fit: PrecessionFit, as_json: bool) -> None:
    """Print what was found, with its errors."""
    from mirrorskin.cli.output import print_json

    found = fit.precession
    numbers = {
        **{name: getattr(found, name) for name in ("tilt", "phase_offset", "ellipticity", "major_axis")},
        **{f"centre_{axis}": value for axis, value in zip("xy", found.centre, strict=True)},
        **{f"pivot_{axis}": value for axis, value in zip("xyz", found.pivot, strict=True)},
    }
    unit = {name: math.degrees(1) if name in _ANGLES else 1.0 for name in numbers}
    values = {name: value * unit[name] for name, value in numbers.items()}
    errors = {name: found.sigma[name] * unit[name] for name in numbers if name in found.sigma}
    notes = [*fit.notes, *warnings(found)]
    if as_json:
        each = {name: {"value": value, "sigma": errors.get(name)} for name, value in values.items()}
        head = {"output": str(output), "direction": found.direction}
        print_json({**head, **each, "left": fit.residual, "notes": notes})
        return

    def words(name: str, digits: int, unit: str = "") -> str:
        if not math.isfinite(values[name]):
            return "not known"
        return f"{values[name]:.{digits}f} +- {errors[name]:.2g}{unit}"

    way = "counter-clockwise" if found.direction > 0 else "clockwise"
    click.echo(
        f"{output}: half-angle {words('tilt', 4, ' deg')}, {way} from {words('phase_offset', 3, ' deg')},"
        f" ellipticity {words('ellipticity', 4)}, pivot at "
        + ", ".join(f"{axis} {words(f'pivot_{axis}', 3, ' mm')}" for axis in "xyz")
    )
    for note in notes:
        click.echo(f"note: {note}", err=True)


def warnings(found: Precession) -> Iterator[str]:
    """Yield what an ellipse and a mean lean do to normals, where that is significant."""
    oval, sure = abs(found.ellipticity) / 2, found.sigma.get("ellipticity", math.inf) / 2
    if oval > min(_NEGLIGIBLE, _SURE * sure):
        yield (
            "the body goes round an ellipse, and reconstruct takes one half-angle: azimuths are off by up to"
            f" {math.degrees(oval):.2g} deg; set the stage's two angles alike"
        )
    lean = math.hypot(*found.centre)
    sure = max(found.sigma.get(f"centre_{axis}", math.inf) for axis in "xy")
    if lean > min(_NEGLIGIBLE, _SURE * sure):
        yield f"normals are relative to the mean pose, which leans by {math.degrees(lean):.2g} deg"
