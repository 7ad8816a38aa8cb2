"""``mirrorskin calibrate zenith``: brightness by position and normal, from a ball of known size."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.io import Calibration, Precession, Source, WallResponse

_PRINTED = "radius", "rim", "axis_x", "axis_y", "sight_0", "lamp_x", "lamp_y", "scatter"
_DOUBTFUL = 0.1  # degrees: median standard deviation of the zenith above which a warning is printed


class PatternName(StrEnum):
    """Print on the wall."""

    graded = "graded"
    uniform = "uniform"


def command(
    output: Annotated[
        Path,
        Option("--output", "-o", metavar="CAL.h5", help="Calibration to add to; it has references."),
    ],
    ball: options.Ball,
    presses: Annotated[
        list[Path] | None,
        Argument(metavar="REC.h5...", help="Axial recordings of one ball at five places or more."),
    ] = None,
    pattern: Annotated[
        PatternName, Option(help="Whether the wall's brightness changes with its height.")
    ] = PatternName.graded,
    body_radius: Annotated[
        str, Option(metavar="LENGTH", help="Nominal radius of the body, within 10 %.")
    ] = "17.5mm",
    body_height: Annotated[
        str, Option(metavar="LENGTH", help="Nominal height of the wall, within 10 %.")
    ] = "40mm",
    rig: inputs.OptionalRig = None,
    places: Annotated[int, Option(min=5, help="With --rig: number of places of the ball.")] = 9,
    press: Annotated[str | None, inputs.press_option("0.4mm for 4 mm")] = None,
    settle: inputs.Settle = None,
    overwrite: inputs.Overwrite = False,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("tilt", "phase_step", "pixel_size", "verify")],
) -> None:
    """Learn brightness as a function of position and normal, from a ball pressed all over the field."""
    from mirrorskin.cli.output import progress
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.wall import check_zenith, fit_zenith

    radius = length(ball, "--ball") / 2
    body = length(body_radius, "--body-radius"), length(body_height, "--body-height")

    def balls() -> list[inputs.Place]:
        turn = stack.pop("tilt", None), stack.pop("phase_step", None)
        plan = inputs.turn_plan(press, *turn, "0.4mm for 4 mm")
        return inputs.at_each("zenith", inputs.BALL, places, plan)

    def check(planned: Source, calibration: Calibration | None) -> None:
        references = None if calibration is None else calibration.references
        check_zenith([planned] * places, radius, references, pattern.value, body)

    def fit(sources: list[Source], calibration: Calibration | None, paths: list[Path]) -> inputs.Learned:
        with progress("fitting", len(sources)) as show:
            response = fit_zenith(
                sources,
                radius,
                references=None if calibration is None else calibration.references,
                precession=None if calibration is None else _precession(calibration, sources[0]),
                pattern=pattern.value,
                body=body,
                progress=show,
            )
        facts = {"sources": paths, "ball": ball, "body_radius": body[0], "body_height": body[1]}
        return _learned(response, facts)

    capture = inputs.Capture(rig, balls, settle, overwrite, check)
    inputs.learn(output, presses or [], fit, stack, as_json, capture, press=press)


def _precession(calibration: Calibration, source: Source) -> Precession | None:
    """Return the calibration's precession, unless its pivot was measured with another pixel size."""
    from mirrorskin.io.model.calibrated import outdated

    size = source.header.pixel_size
    if (
        calibration.precession is None
        or size is None
        or not list(outdated(calibration, size, ["precession"]))
    ):
        return calibration.precession
    click.echo(
        "the calibrated tilt is ignored: it was made with another pixel size; learn it again", err=True
    )
    return None


def _learned(response: WallResponse, facts: dict[str, Any]) -> inputs.Learned:
    import numpy as np

    errors = dict(zip(response.parameters, np.sqrt(np.diag(response.covariance)).tolist(), strict=True))
    sigma = np.degrees(response.zenith_sigma[np.isfinite(response.zenith_sigma)])
    middle, worst = (float(np.median(sigma)), float(sigma.max())) if sigma.size else (np.nan, np.nan)
    residual = float(np.degrees(response.error))
    place = *response.axis, response.sight[0], *response.lamps
    values = zip(_PRINTED, (response.radius, response.rim, *place, response.scatter), strict=True)
    fitted = {name: {"value": value, "sigma": errors[name]} for name, value in values}
    degrees = {"zenith_sigma_median": middle, "zenith_sigma_worst": worst, "residual_on_balls": residual}
    doubt = (
        f"depth not determined, standard deviation of zenith {middle:.2g} deg: press less, so that the"
        " contact ends within the part that shows the wall"
    )
    return inputs.Learned(
        response,
        facts,
        {"pattern": response.pattern, "found": fitted, "degrees": degrees},
        f"wall {response.radius:.2f} ± {errors['radius']:.2g} mm from the axis and"
        f" {response.rim:.1f} ± {errors['rim']:.2g} mm high (noise alone), axis at {response.axis[0]:.2f},"
        f" {response.axis[1]:.2f} mm; standard deviation of zenith {middle:.2g} deg ({worst:.2g} at most),"
        f" residual on the balls at most {residual:.2g} deg",
        [doubt] if middle > _DOUBTFUL else [],
    )
