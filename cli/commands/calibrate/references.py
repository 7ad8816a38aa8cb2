"""``mirrorskin calibrate references``: the counts of each pixel without light and in full light."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.groups import Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.references import Measured
    from mirrorskin.io import CameraId

_ROUNDS = 4  # of captures on a rig, at most, until a stated noise is reached

_PROMPTS = {
    "dark": "take everything off the sheet, with the lamps as they are in a press",
    "bright": "put the flat field in place, so that all pixels are in full light",
}
_REMEDIES = {"dark": "raise the camera's black level", "bright": "give it less light"}


def command(
    output: options.LearnedCalibration,
    dark: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="Recording, or folder of pictures, of a sheet that touches nothing."),
    ] = None,
    bright: Annotated[
        list[Path] | None,
        Option(metavar="REC.h5", help="The same in full light. Both may be given several times."),
    ] = None,
    rolled: Annotated[
        bool,
        Option("--rolled", help="Bright frames are of a rolled ball: full light in some frames only."),
    ] = False,
    noise: Annotated[
        float | None, Option(metavar="COUNTS", help="Greatest standard error of a reference: 0.1.")
    ] = None,
    rig: inputs.OptionalRig = None,
    frames: Annotated[
        int, Option(min=2, help="With --rig: frames of each level, or of the ball at each place.")
    ] = 64,
    places: Annotated[int, Option(min=1, help="With --rig and --rolled: places of the ball.")] = 9,
    press: Annotated[
        str | None,
        Option(metavar="LENGTH", help="With --rig and --rolled: travel of the body: 2mm."),
    ] = None,
    overwrite: inputs.Overwrite = False,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("verify")],
) -> None:
    """Measure dark and bright references, and find hot, dead and saturated pixels."""
    from mirrorskin import io

    darks, brights = list(dark or []), list(bright or [])
    _check_call(darks, brights, noise, rig, rolled, press, overwrite)
    io.check_output(output, *darks, *brights, rig, replaces="calibration")
    if rig is not None:
        for path in (*darks, *brights):
            inputs.open_still(path, **stack).close()  # refused before anything moves
        darks = darks or inputs.take(rig, output, [_still("dark", rig, frames)], overwrite=overwrite)
        balls = _balls(rig, places, frames, press) if rolled else [_still("bright", rig, frames)]
        brights = brights or inputs.take(rig, output, balls, overwrite=overwrite)
    measured, camera = _measure(darks, brights, rolled, stack)
    for number in range(2, _ROUNDS + 1):
        missing = _missing(measured, noise, rig is None or rolled)
        if rig is None or not missing:
            break
        for name, count in missing.items():
            place = _still(name, rig, count, number)
            paths = inputs.take(rig, output, [place], overwrite=overwrite)
            (darks if name == "dark" else brights).extend(paths)
        measured, camera = _measure(darks, brights, rolled, stack)
    _missing(measured, noise, True)
    process = inputs.process_of(
        bright_light="of a ball rolled about" if rolled else "of a flat field",
        **{f"dark_{key}": value for key, value in {"sources": darks, **asdict(measured.dark)}.items()},
        **{f"bright_{key}": value for key, value in {"sources": brights, **asdict(measured.bright)}.items()},
    )
    inputs.save(output, camera, _learned(measured), process, as_json)


def _check_call(
    darks: Sequence[Path],
    brights: Sequence[Path],
    noise: float | None,
    rig: Path | None,
    rolled: bool,
    press: str | None,
    overwrite: bool,
) -> None:
    from mirrorskin.io import InputError

    missing = [option for option, paths in (("--dark", darks), ("--bright", brights)) if not paths]
    if missing and rig is None:
        raise InputError(
            f"{' and '.join(missing)} missing: name recordings, or capture them with --rig RIG.toml"
        )
    if noise is not None and not noise > 0:
        raise InputError(f"--noise {noise:g}: no number of frames reaches that: give a number above 0")
    if overwrite and rig is None:
        raise InputError("--overwrite is for recordings taken with --rig: remove it")
    if press is not None and (rig is None or not rolled):
        raise InputError("--press needs --rig and --rolled")
    if rig is not None and rolled and not brights and press is None:
        raise InputError(
            "--press is missing: give the travel at which the body presses on the ball, such as --press 2mm"
        )


def _still(name: str, rig: Path, frames: int, number: int = 1) -> inputs.Place:
    """Return the capture of a level: half of the frames at each of two positions that nearly coincide."""
    file = name if number == 1 else f"{name}-{number}"
    return inputs.Place(file, _PROMPTS[name], inputs.still_plan(rig), max(1, -(-frames // 2)))


def _balls(rig: Path, places: int, frames: int, press: str | None) -> list[inputs.Place]:
    from mirrorskin.cli.quantity import length

    plan = inputs.still_plan(rig, length(press or "", "--press"))
    return inputs.at_each("bright", inputs.BALL, places, plan, max(1, -(-frames // 2)))


def _measure(
    darks: Sequence[Path], brights: Sequence[Path], rolled: bool, stack: dict[str, Any]
) -> tuple[Measured, CameraId]:
    """Return the references and their camera."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress
    from mirrorskin.engine.calibration.references import measure_references

    with ExitStack() as opening:
        low, high = (
            [opening.enter_context(inputs.open_still(path, **stack)) for path in paths]
            for paths in (darks, brights)
        )
        name = inputs.camera_name([source.header.camera for source in (*low, *high)])
        camera = io.CameraId(name, low[0].shape[1:], low[0].dtype)
        with progress("averaging", sum(source.shape[0] for source in (*low, *high))) as show:
            return measure_references(low, high, rolled=rolled, progress=show), camera


def _missing(measured: Measured, noise: float | None, refuse: bool) -> dict[str, int]:
    """Return the number of frames that a stated noise still needs, by level, or raise InputError."""
    from mirrorskin.io import InputError

    missing: dict[str, int] = {}
    for name, level in (("dark", measured.dark), ("bright", measured.bright)):
        count = 0 if noise is None else level.missing(noise)
        error = f"{name}: the standard error is {level.sigma:.3g} counts"
        if count is None:
            raise InputError(
                f"{error}; {level.rounding:.2g} of it is due to rounding with any number of frames: give a"
                " --noise above that"
            )
        if count and refuse:
            raise InputError(
                f"{error}: {count} more frames than {level.frames} are needed for --noise {noise:g}"
            )
        if count:
            missing[name] = count
    return missing


def _learned(measured: Measured) -> inputs.Learned:
    import numpy as np

    from mirrorskin.io.model.calibration import BITS

    references = measured.references
    defects = {name: int(np.count_nonzero(references.defects & bit)) for name, bit in BITS.items()}
    levels = {"dark": measured.dark, "bright": measured.bright}
    parts, notes = [], []
    for name, level in levels.items():
        drift = f", drift {level.drift:+.2g}" if np.isfinite(level.drift) else ""
        parts.append(
            f"{name} {float(np.nanmedian(getattr(references, name))):.2f} ± {level.sigma:.2g} counts"
            f" ({level.frames} frames of noise {level.noise:.3g}{drift})"
        )
        if abs(level.drift) > level.sigma:
            notes.append(f"{name} drifts by {level.drift:+.2g} counts: let camera and lamps warm up")
        if level.clipped:
            notes.append(
                f"{name}: {level.clipped} pixels have samples at the end of the scale; their means were"
                f" corrected; better {_REMEDIES[name]}"
            )
    parts.append(", ".join(f"{count} {name}" for name, count in defects.items()))
    return inputs.Learned(references, {}, {**levels, "defects": defects}, "; ".join(parts), notes)
