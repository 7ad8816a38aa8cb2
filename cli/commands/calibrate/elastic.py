"""``mirrorskin calibrate elastic``: the gel's compliance, from a ball of calibration size."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.gel import BallOnset, GelFit
    from mirrorskin.io import Calibration, Source

_STEP, _PRESS = 0.03, "1.2mm"  # defaults with --rig: step, mm, and travel


def command(
    output: options.LearnedCalibration,
    ball: options.Ball,
    presses: Annotated[
        list[Path] | None,
        Argument(metavar="REC.h5...", help="Vertical recordings of the ball, at one place or more."),
    ] = None,
    sheet: Annotated[
        str, Option(metavar="LENGTH", help="Thickness of the material between mirror and ball.")
    ] = "0.05mm",
    rig: inputs.OptionalRig = None,
    places: inputs.Places = 1,
    press: Annotated[str | None, inputs.press_option(_PRESS)] = None,
    settle: inputs.Settle = None,
    overwrite: inputs.Overwrite = False,
    device: options.Device = None,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("travel_step", "travel_start", "pixel_size", "verify")],
) -> None:
    """Learn the slope at which the sheet turns bright, and the stage's compliance, from presses of a ball."""
    from mirrorskin import io
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.gel import fit_gel
    from mirrorskin.engine.calibration.sources import check_ball_radius, pixel_size_of
    from mirrorskin.kernels.device import open_devices

    radius, thickness = length(ball, "--ball") / 2, length(sheet, "--sheet")
    if thickness < 0:
        raise io.InputError(f"--sheet {sheet}: a thickness must not be negative")

    def balls() -> list[inputs.Place]:
        from mirrorskin.hw.rig.plans import VerticalPlan

        start, step = stack.pop("travel_start", 0.0), stack.pop("travel_step", _STEP)
        plan = VerticalPlan(start, length(press or _PRESS, "--press"), step=step)
        prompt = "put the ball at place {} of {}, near the middle of the field"
        return inputs.at_each("elastic", prompt, places, plan)

    def check(planned: Source, calibration: Calibration | None) -> None:
        check_ball_radius(radius)
        pixel_size_of(planned)
        open_devices(device)

    def fit(sources: list[Source], calibration: Calibration | None, paths: list[Path]) -> inputs.Learned:
        onsets = [_onset(source, calibration, radius, device) for source in sources]
        return _learned(fit_gel(onsets, sheet=thickness), {"sources": paths, "ball": ball, "sheet": sheet})

    capture = inputs.Capture(rig, balls, settle, overwrite, check)
    inputs.learn(output, presses or [], fit, stack, as_json, capture, press=press)


def _onset(source: Source, calibration: Calibration | None, radius: float, device: str | None) -> BallOnset:
    """Return the onsets of light in a ball's press, with the references of the calibration."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.engine.calibration.gel import ball_onset
    from mirrorskin.engine.press.elastic import LEARNED_AT
    from mirrorskin.engine.press.press import Press

    if source.motion != "vertical":
        raise io.InputError(f"{source.name} is of {source.motion} motion: give presses of a ball")
    plain = source if calibration is None else io.Calibrated(source, replace(calibration, gel=None))
    with progress("pressing", source.shape[0]) as show:
        press = Press(threshold=LEARNED_AT, fill=False, device=device)
        result = press.run(plain, show, undistort=False)
    return ball_onset(result, plain, radius)


def _learned(fit: GelFit, facts: dict[str, Any]) -> inputs.Learned:
    gel, sigma = fit.gel, fit.gel.sigma
    parts = [
        f"bright from {math.degrees(gel.threshold):.2f} ± {math.degrees(sigma['threshold']):.2f} deg",
        *(
            f"{name} {getattr(gel, name):.3f} ± {sigma[name]:.3f} /mm"
            for name in ("compliance", "curvature")
            if name not in fit.undetermined
        ),
        f"contact at a travel of {gel.travel_zero:.3f} ± {sigma['travel_zero']:.3f} mm",
        f"residual {gel.error:.3f} mm",
    ]
    remedy = "not determined by the presses, left at 0; press deeper, at more places or larger balls"
    return inputs.Learned(
        gel,
        facts | {"undetermined": ", ".join(fit.undetermined) or "nothing"},
        {"gel": gel, "balls": fit.places, "undetermined": fit.undetermined},
        ", ".join(parts),
        [f"{name}: {remedy}" for name in fit.undetermined],
    )
