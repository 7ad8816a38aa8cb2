"""``mirrorskin calibrate zenith``: what brightness means at each place, from a ball of known size."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorskin.cli import options
from mirrorskin.cli.calibrate import inputs
from mirrorskin.cli.calibrate.inputs import camera_of, check_call, one_camera, with_scale

if TYPE_CHECKING:
    from mirrorskin.io import Calibration, Precession, ProcessValue, Source, WallResponse

_DOUBTFUL = 0.1
"""Degrees by which zeniths may be off, in the middle of all pixels, before a warning."""


class PatternName(StrEnum):
    """What is printed on the wall."""

    graded = "graded"
    uniform = "uniform"


def command(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="CAL.h5", help="Calibration to add to; it has references."),
    ],
    ball: options.Ball,
    presses: Annotated[
        list[Path] | None,
        typer.Argument(metavar="REC.h5...", help="Axial recordings of one ball at five places or more."),
    ] = None,
    pattern: Annotated[
        PatternName, typer.Option(help="Whether the wall's brightness changes with its height.")
    ] = PatternName.graded,
    body_radius: Annotated[
        str, typer.Option(metavar="LENGTH", help="Nominal radius of the body, right within a tenth.")
    ] = "17.5mm",
    body_height: Annotated[
        str, typer.Option(metavar="LENGTH", help="Nominal height of the wall, right within a tenth.")
    ] = "40mm",
    tilt: options.Tilt = None,
    phase_step: options.PhaseStep = None,
    pixel_size: options.PixelSize = None,
    rig: inputs.OptionalRig = None,
    places: Annotated[int, typer.Option(min=5, help="With --rig: of the ball.")] = 9,
    press: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="With --rig: how far the body is lowered: 0.4mm for 4 mm."),
    ] = None,
    settle: inputs.Settle = None,
    as_json: options.Json = False,
) -> None:
    """Learn what brightness means at each place, from a ball of known size pressed all over the field."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import length
    from mirrorskin.cli.stack import stack_options

    paths = list(presses or [])
    radius = length(ball, "--ball") / 2
    body = length(body_radius, "--body-radius"), length(body_height, "--body-height")
    check_call(paths, rig, press=press, settle=settle)
    io.check_output(output, *paths, rig)
    known = io.open_calibration(output) if output.exists() else None
    if rig is not None:
        plan = inputs.turn_plan(press, tilt, phase_step, "0.4mm for 4 mm")
        balls = inputs.at_each("zenith", inputs.BALL, places, plan)
        paths, tilt, phase_step = inputs.take(rig, output, balls, settle), None, None
    told = with_scale(stack_options(tilt=tilt, phase_step=phase_step, pixel_size=pixel_size), known)
    with ExitStack() as opening:
        sources = [opening.enter_context(io.open_recording(path, **told)) for path in paths]
        cameras = [camera_of(source) for source in sources]
        camera = one_camera([source.name for source in sources], cameras, known, output)
        response = _fit(sources, radius, known, pattern.value, body)
        process = _process(paths, ball, body) | _size(sources[0])
    io.update_calibration(output, response, camera, process)
    _tell(output, response, as_json)


def _fit(
    sources: Sequence[Source],
    radius: float,
    known: Calibration | None,
    pattern: str,
    body: tuple[float, float],
) -> WallResponse:
    from mirrorskin.cli.output import progress
    from mirrorskin.engine.calibration.wall import fit_zenith

    with progress("fitting", len(sources)) as show:
        return fit_zenith(
            sources,
            radius,
            references=None if known is None else known.references,
            precession=None if known is None else _precession(known, sources[0]),
            pattern=pattern,
            body=body,
            progress=show,
        )


def _size(source: Source) -> dict[str, ProcessValue]:
    """Return what is kept of the pixel size that the wall was measured with."""
    from mirrorskin.io.calibration.source import size_facts

    size = source.header.pixel_size
    return {} if size is None else dict(size_facts(size))


def _precession(known: Calibration, source: Source) -> Precession | None:
    """Return the precession that is known, unless its pivot was measured with another pixel size."""
    from mirrorskin.io.calibration.source import outdated

    size = source.header.pixel_size
    if known.precession is None or size is None or not list(outdated(known, size, ["precession"])):
        return known.precession
    typer.echo(
        "the calibrated tilt is left out: it was made with another pixel size; learn it again", err=True
    )
    return None


def _process(paths: Sequence[Path], ball: str, body: tuple[float, float]) -> dict[str, ProcessValue]:
    from mirrorskin.engine.provenance import signature

    return {
        **signature(),
        "sources": ", ".join(map(str, paths)),
        "ball": ball,
        "body_radius": body[0],
        "body_height": body[1],
    }


def _tell(output: Path, response: WallResponse, as_json: bool) -> None:
    """Say what was found, with its errors."""
    import numpy as np

    from mirrorskin.cli.output import print_json

    errors = dict(zip(response.parameters, np.sqrt(np.diag(response.covariance)).tolist(), strict=True))
    sigma = np.degrees(response.zenith_sigma[np.isfinite(response.zenith_sigma)])
    middle, worst = (float(np.median(sigma)), float(sigma.max())) if sigma.size else (np.nan, np.nan)
    most = float(np.degrees(response.error))
    if middle > _DOUBTFUL:
        typer.echo(
            f"depth not determined, zenith known within {middle:.2g} deg only: press less, so that the touch"
            " ends within what the wall shows",
            err=True,
        )
    if as_json:
        found = {
            name: {"value": value, "sigma": errors[name]}
            for name, value in (
                ("radius", response.radius),
                ("rim", response.rim),
                ("axis_x", response.axis[0]),
                ("axis_y", response.axis[1]),
                ("sight_0", response.sight[0]),
                ("lamp_x", response.lamps[0]),
                ("lamp_y", response.lamps[1]),
                ("scatter", response.scatter),
            )
        }
        degrees = {"zenith_sigma_median": middle, "zenith_sigma_worst": worst, "left_on_balls": most}
        print_json({"output": str(output), "pattern": response.pattern, "found": found, "degrees": degrees})
        return
    typer.echo(
        f"{output}: wall {response.radius:.2f} +- {errors['radius']:.2g} mm from the axis and"
        f" {response.rim:.1f} +- {errors['rim']:.2g} mm high (noise alone), axis at {response.axis[0]:.2f},"
        f" {response.axis[1]:.2f} mm; zenith known within"
        f" {middle:.2g} deg ({worst:.2g} at worst), at most {most:.2g} deg left on the balls"
    )
