"""``mirrorskin calibrate tilt``: the precession of the body's axis, and its pivot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.declared import declared
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.brightness import Brightness
    from mirrorskin.engine.calibration.tilt import PrecessionFit
    from mirrorskin.io import Calibration, Precession, Source

_NEGLIGIBLE = math.radians(0.1)  # error of the azimuth, or mean lean, above which a warning is printed
_SIGNIFICANT = 3.0  # standard errors above which it is printed in any case
_RESPONSE = declared("fuse").only("zenith_gain", "zenith_offset")


def command(
    output: options.LearnedCalibration,
    ball: options.Ball,
    balls: Annotated[
        list[Path] | None,
        Argument(metavar="REC.h5...", help="Axial recordings of the ball, at one place or more."),
    ] = None,
    flat: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="Axial recording of a level plate; may be repeated."),
    ] = None,
    wedge: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="Axial recording of an inclined plate; may be repeated."),
    ] = None,
    rig: inputs.OptionalRig = None,
    places: inputs.Places = 5,
    press: Annotated[str | None, inputs.press_option("0.5mm")] = None,
    tilt: Annotated[
        str | None, Option(metavar="ANGLE", help=f"With --rig: nominal half-angle, by default {inputs.TILT}.")
    ] = None,
    settle: inputs.Settle = None,
    overwrite: inputs.Overwrite = False,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("phase_step", "phases", "pixel_size", "verify"), _RESPONSE],
) -> None:
    """Determine half-angle, phase offset, direction, ellipticity and pivot, with their standard errors."""
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.engine.calibration.sources import check_ball_radius, pixel_size_of
    from mirrorskin.engine.calibration.tilt import fit_precession
    from mirrorskin.engine.calibration.tilt_tracks import track_ball, track_plate

    flats, wedges, radius = flat or [], wedge or [], length(ball, "--ball") / 2
    response = stack.pop("zenith_gain", None), stack.pop("zenith_offset", None)

    def turns() -> list[inputs.Place]:
        half_angle = None if tilt is None else angle(tilt, "--tilt")
        plan = inputs.turn_plan(press, half_angle, stack.get("phase_step"), "0.5mm")
        for name in ("phase_step", "phases"):
            stack.pop(name, None)
        return inputs.at_each("tilt", inputs.BALL, places, plan)

    def check(planned: Source, calibration: Calibration | None) -> None:
        check_ball_radius(radius)
        pixel_size_of(planned)
        _brightness(planned, calibration, *response)

    def fit(sources: list[Source], calibration: Calibration | None, paths: list[Path]) -> inputs.Learned:
        light = _brightness(sources[0], calibration, *response)
        tracks, plates = [], []
        with progress("following", len(sources)) as show:
            for number, source in enumerate(sources, 1):
                if number <= len(paths):
                    tracks.append(track_ball(source, radius, light))
                else:
                    plates.append(track_plate(source, number <= len(paths) + len(flats), light))
                show(number)
        precession = fit_precession(tracks, plates, depth_sigma=light.depth_sigma)
        named = {"sources": paths, "flats": flats, "wedges": wedges}
        return _learned(precession, {"ball": ball, **{name: files for name, files in named.items() if files}})

    capture = inputs.Capture(rig, turns, settle, overwrite, check)
    plates = [*flats, *wedges]
    inputs.learn(output, balls or [], fit, stack, as_json, capture, plates, press=press, tilt=tilt)


def _brightness(
    source: Source, calibration: Calibration | None, gain: float | None, offset: float | None
) -> Brightness:
    """Return the response of the calibration, or else a linear one from the recording and the options."""
    from dataclasses import replace

    import numpy as np

    from mirrorskin.engine.base.provenance import naming
    from mirrorskin.engine.calibration.brightness import LinearBrightness, WallBrightness
    from mirrorskin.engine.calibration.sources import pixel_size_of
    from mirrorskin.io.model.calibrated import check_sizes

    header, shape = source.header, source.shape[1:]
    if calibration is not None and calibration.references is not None:
        header = replace(header, dark=calibration.references.dark, bright=calibration.references.bright)
    if gain is not None:
        header = replace(header, zenith_gain=np.asarray(gain, np.float64))
    if offset is not None:
        header = replace(header, zenith_offset=np.asarray(offset, np.float64))
    if calibration is not None and calibration.zenith is not None and gain is None and offset is None:
        check_sizes(calibration, header.pixel_size, source.name, ["zenith"])
        levels = header.dark, header.bright
        return WallBrightness.of_pixels(calibration.zenith, *levels, shape, pixel_size_of(source))
    with naming(source):
        return LinearBrightness.of_header(header, shape)


def _learned(fit: PrecessionFit, facts: dict[str, Any]) -> inputs.Learned:
    precession = fit.precession
    numbers = {row.name: (row.value, row.sigma) for row in precession.rows() if isinstance(row.value, float)}
    each = {name: {"value": value, "sigma": sigma} for name, (value, sigma) in numbers.items()}
    notes = [*fit.notes, *warnings(precession)]

    def text(name: str, digits: int, unit: str = "") -> str:
        value, sigma = numbers[name]
        return f"{value:.{digits}f} ± {sigma:.2g}{unit}" if math.isfinite(value) else "not determined"

    sense = "counter-clockwise" if precession.direction > 0 else "clockwise"
    residuals = {f"residual_{name}": value for name, value in fit.residual.items()}
    return inputs.Learned(
        precession,
        {**facts, "assumptions": "; ".join(fit.notes), **residuals},
        {"direction": precession.direction, **each, "residual": fit.residual, "notes": notes},
        f"half-angle {text('tilt', 4, ' deg')}, {sense} from {text('phase_offset', 3, ' deg')},"
        f" ellipticity {text('ellipticity', 4)}, pivot at "
        + ", ".join(f"{axis} {text(f'pivot_{axis}', 3, ' mm')}" for axis in "xyz"),
        [f"note: {note}" for note in notes],
    )


def warnings(precession: Precession) -> Iterator[str]:
    """Yield the effects of an ellipse and of a mean lean on normals, if they are significant."""
    oval, sigma = abs(precession.ellipticity) / 2, precession.sigma.get("ellipticity", math.inf) / 2
    if oval > min(_NEGLIGIBLE, _SIGNIFICANT * sigma):
        yield (
            "the body's axis moves on an ellipse, but reconstruct assumes a circle: azimuths are off by up to"
            f" {math.degrees(oval):.2g} deg; set the stage's two angles to the same value"
        )
    lean = math.hypot(*precession.centre)
    sigma = max(precession.sigma.get(f"centre_{axis}", math.inf) for axis in "xy")
    if lean > min(_NEGLIGIBLE, _SIGNIFICANT * sigma):
        yield f"normals are relative to the mean pose, which leans by {math.degrees(lean):.2g} deg"
