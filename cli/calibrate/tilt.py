"""``mirrorskin calibrate tilt``: how the body's axis goes round, and about which point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorskin.cli import options
from mirrorskin.cli.calibrate import inputs
from mirrorskin.cli.calibrate.inputs import camera_of, check_call, one_camera, with_scale

if TYPE_CHECKING:
    from mirrorskin.cli.stack import StackOptions
    from mirrorskin.engine.calibration.brightness import Shown
    from mirrorskin.engine.calibration.tilt import Study
    from mirrorskin.engine.calibration.tilt_tracks import BallTurn, PlateTurn
    from mirrorskin.io import Calibration, CameraId, Precession, ProcessValue, Source

_TRIFLE = math.radians(0.1)  # of azimuth, or of the mean lean, that is not worth a line
_SURE = 3.0  # standard errors from which on it is
_ANGLES = ("tilt", "phase_offset", "major_axis", "centre_x", "centre_y")


def command(
    output: options.LearnedCalibration,
    ball: options.Ball,
    balls: Annotated[
        list[Path] | None,
        typer.Argument(metavar="REC.h5...", help="Axial recordings of the ball, at one place or more."),
    ] = None,
    flat: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.h5", help="Axial recording of a level plate; may be given again."),
    ] = None,
    wedge: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.h5", help="Axial recording of an inclined plate; may be given again."),
    ] = None,
    phase_step: options.PhaseStep = None,
    phases: options.Phases = None,
    pixel_size: options.PixelSize = None,
    zenith_gain: options.ZenithGain = None,
    zenith_offset: options.ZenithOffset = None,
    rig: inputs.OptionalRig = None,
    places: Annotated[int, typer.Option(min=1, help="With --rig: of the ball.")] = 5,
    press: Annotated[
        str | None, typer.Option(metavar="LENGTH", help="With --rig: how far the body is lowered: 0.5mm.")
    ] = None,
    tilt: Annotated[
        str | None, typer.Option(metavar="ANGLE", help=f"With --rig: nominal half-angle, else {inputs.TILT}.")
    ] = None,
    settle: inputs.Settle = None,
    as_json: options.Json = False,
) -> None:
    """Find half-angle, phase offset, direction, ellipticity and pivot of the rotation, with their errors."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import length
    from mirrorskin.cli.stack import stack_options
    from mirrorskin.io.calibration.source import size_facts

    paths, flats, wedges = list(balls or []), list(flat or []), list(wedge or [])
    radius = length(ball, "--ball") / 2
    check_call(paths if rig else [*paths, *flats, *wedges], rig, press=press, tilt=tilt, settle=settle)
    io.check_output(output, *paths, *flats, *wedges, rig)
    known = io.open_calibration(output) if output.exists() else None
    told = stack_options(phase_step=phase_step, phases=phases, pixel_size=pixel_size)
    if rig is not None:
        plan = inputs.turn_plan(press, tilt, phase_step, "0.5mm")
        paths, told = inputs.take(rig, output, inputs.at_each("tilt", inputs.BALL, places, plan), settle), {}
    told = with_scale(told, known)
    every = [*flats, *wedges, *paths]
    camera = _camera(every, known, output, told)
    with io.open_recording((paths or every)[0], **told) as source:
        shown, size = _shown(source, known, _scale(zenith_gain, zenith_offset)), source.header.pixel_size
    study = _study(_turns(flats, wedges, paths, radius, told), len(every), shown)
    process = _process(study, ball, paths, flats, wedges)
    if size is not None:
        process |= size_facts(size)
    io.update_calibration(output, study.precession, camera, process)
    _tell(output, study, as_json)


def _scale(gain: str | None, offset: float | None) -> Mapping[str, Any]:
    """Return what the user says of zenith gain and offset, counts a radian and counts."""
    import numpy as np

    from mirrorskin.cli.quantity import per_angle

    given = {
        "zenith_gain": None if gain is None else per_angle(gain, "--zenith-gain"),
        "zenith_offset": offset,
    }
    return {name: np.asarray(value, np.float64) for name, value in given.items() if value is not None}


def _camera(paths: Sequence[Path], known: Calibration | None, output: Path, told: StackOptions) -> CameraId:
    """Return the camera that all recordings are of, if it is that of the calibration."""
    from mirrorskin import io

    cameras = []
    for path in paths:
        with io.open_recording(path, **told) as source:
            cameras.append(camera_of(source))
    return one_camera([str(path) for path in paths], cameras, known, output)


def _shown(source: Source, known: Calibration | None, scale: Mapping[str, Any]) -> Shown:
    """Return the response: of the calibration, else the one that is linear in the zenith."""
    from dataclasses import replace

    from mirrorskin.engine.calibration.brightness import LinearShown, WallShown
    from mirrorskin.io import InputError
    from mirrorskin.io.calibration.source import check_sizes

    header, shape = source.header, source.shape[1:]
    dark, bright = header.dark, header.bright
    if known is not None and known.references is not None:
        dark, bright = known.references.dark, known.references.bright
    if known is not None and known.zenith is not None and not scale:
        check_sizes(known, header.pixel_size, source.name, ["zenith"])
        if header.pixel_size is None:
            raise InputError(f"{source.name}: its pixel size is not told: give it, as in --pixel-size 0.03mm")
        return WallShown.of_pixels(known.zenith, dark, bright, shape, header.pixel_size)
    try:
        return LinearShown.of_header(replace(header, dark=dark, bright=bright, **scale), shape)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None


def _turns(
    flats: Sequence[Path], wedges: Sequence[Path], balls: Sequence[Path], radius: float, told: StackOptions
) -> Iterator[BallTurn | PlateTurn]:
    """Read one recording after the other."""
    from mirrorskin import io
    from mirrorskin.engine.calibration.tilt_tracks import read_ball, read_plate

    for path in [*flats, *wedges]:
        with io.open_recording(path, **told) as source:
            yield read_plate(source, level=path in flats)
    for path in balls:
        with io.open_recording(path, **told) as source:
            yield read_ball(source, radius)


def _study(turns: Iterator[BallTurn | PlateTurn], count: int, shown: Shown) -> Study:
    from mirrorskin.cli.output import progress
    from mirrorskin.engine.calibration.tilt import study_precession

    with progress("looking", count) as show:

        def counted() -> Iterator[BallTurn | PlateTurn]:
            for number, turn in enumerate(turns):
                show(number)
                yield turn
            show(count)

        return study_precession(counted(), shown)


def _process(
    study: Study, ball: str, balls: Sequence[Path], flats: Sequence[Path], wedges: Sequence[Path]
) -> dict[str, ProcessValue]:
    from mirrorskin.engine.provenance import signature

    told: dict[str, ProcessValue] = {
        **signature(),
        "ball": ball,
        "taken_for_granted": "; ".join(study.notes),
    }
    told |= {
        name: ", ".join(map(str, paths))
        for name, paths in (("sources", balls), ("flats", flats), ("wedges", wedges))
        if paths
    }
    return told | {f"left_{name}": value for name, value in study.left.items()}


def _tell(output: Path, study: Study, as_json: bool) -> None:
    """Say what was found, with its errors."""
    from mirrorskin.cli.output import print_json

    found = study.precession
    numbers = {
        **{name: getattr(found, name) for name in ("tilt", "phase_offset", "ellipticity", "major_axis")},
        **{f"centre_{axis}": value for axis, value in zip("xy", found.centre, strict=True)},
        **{f"pivot_{axis}": value for axis, value in zip("xyz", found.pivot, strict=True)},
    }
    unit = {name: math.degrees(1) if name in _ANGLES else 1.0 for name in numbers}
    values = {name: value * unit[name] for name, value in numbers.items()}
    errors = {name: found.sigma[name] * unit[name] for name in numbers if name in found.sigma}
    if as_json:
        told = {name: {"value": value, "sigma": errors.get(name)} for name, value in values.items()}
        notes = [*study.notes, *_spoils(found)]
        print_json(
            {"output": str(output), "direction": found.direction, **told, "left": study.left, "notes": notes}
        )
        return

    def words(name: str, digits: int, unit: str = "") -> str:
        if not math.isfinite(values[name]):
            return "not known"
        return f"{values[name]:.{digits}f} +- {errors[name]:.2g}{unit}"

    way = "counter-clockwise" if found.direction > 0 else "clockwise"
    typer.echo(
        f"{output}: half-angle {words('tilt', 4, ' deg')}, {way} from {words('phase_offset', 3, ' deg')},"
        f" ellipticity {words('ellipticity', 4)}, pivot at "
        + ", ".join(f"{axis} {words(f'pivot_{axis}', 3, ' mm')}" for axis in "xyz")
    )
    for note in (*study.notes, *_spoils(found)):
        typer.echo(f"note: {note}", err=True)


def _spoils(found: Precession) -> Iterator[str]:
    """Say what an oval and a mean lean do to normals, where that is more than a chance or a trifle."""
    oval, sure = abs(found.ellipticity) / 2, found.sigma.get("ellipticity", math.inf) / 2
    if oval > min(_TRIFLE, _SURE * sure):
        yield (
            "the body goes round an ellipse, and reconstruct takes one half-angle: azimuths are off by up to"
            f" {math.degrees(oval):.2g} deg; set the stage's two angles alike"
        )
    lean = math.hypot(*found.centre)
    sure = max(found.sigma.get(f"centre_{axis}", math.inf) for axis in "xy")
    if lean > min(_TRIFLE, _SURE * sure):
        yield f"normals are told from the mean pose, which leans by {math.degrees(lean):.2g} deg"
