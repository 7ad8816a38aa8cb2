"""``mirrorskin calibrate self``: response and movement of a sensor from touches of unknown objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.declared import declared
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.touches import Estimate, Stated, TouchFit
    from mirrorskin.io import Calibration, Source

_RESPONSE = declared("fuse").only("zenith_gain", "zenith_offset")
_LENGTHS = "pivot_z", "pixel_size", "radius", "rim", "axis_x", "axis_y"
_ANGLES = "tilt", "phase_offset", "scatter"
_SHOWN = "zenith_gain", "zenith_offset", "gamma", "radius", "rim", "tilt", "compliance"


def command(
    output: options.LearnedCalibration,
    recordings: Annotated[
        list[Path],
        Argument(
            metavar="REC.h5...",
            help="Recordings of 'mirrorskin touch'; presses, each before the turn at the same place; or turns"
            " alone, which determine less.",
        ),
    ],
    stated: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=VALUE+-SIGMA",
            help="What a data sheet says: tilt=2.5deg+-0.2deg, phase_offset, gamma, zenith_gain,"
            " zenith_offset, pivot_z, pixel_size or compliance; under a wall radius, rim, axis_x, axis_y,"
            " scatter, ...; may be repeated.",
        ),
    ] = None,
    forget: Annotated[
        str | None,
        Option(
            metavar="TIME",
            help="Time after which a touch counts 1/e for the response, but not for the movement: 30d.",
            show_default="never",
        ),
    ] = None,
    body_radius: Annotated[
        str | None,
        Option(
            metavar="LENGTH",
            help="Nominal radius of the body, within 10 %, if a lit wall surrounds the skin: 17.5mm.",
        ),
    ] = None,
    body_height: Annotated[
        str | None, Option(metavar="LENGTH", help="Nominal height of that wall, within 10 %: 40mm.")
    ] = None,
    device: options.Device = None,
    as_json: options.Json = False,
    **stack: Annotated[
        Any,
        STACK.only("travel_step", "travel_start", "phase_step", "phases", "pixel_size", "verify"),
        _RESPONSE,
    ],
) -> None:
    """Learn the response to zenith and the movement from touches of unknown objects; add them to others."""
    from mirrorskin.cli.quantity import duration
    from mirrorskin.engine.calibration.touches import from_touches
    from mirrorskin.io import InputError

    response = {name: stack.pop(name, None) for name in ("zenith_gain", "zenith_offset")}
    numbers = _stated(stated or [])
    seconds = None if forget is None else duration(forget, "--forget")
    body = _body(body_radius, body_height)

    of_press = "travel_step" in stack

    def fit(sources: list[Source], calibration: Calibration | None, paths: list[Path]) -> inputs.Learned:
        if of_press and all(source.motion != "vertical" for source in sources):
            raise InputError("--travel-step applies to presses, and there are turns only: remove it")
        found = from_touches(
            _touches(sources),
            calibration=calibration,
            stated=numbers,
            forget=seconds,
            **response,
            body=body,
            device=device,
        )
        return _learned(found, paths)

    inputs.learn(output, recordings, fit, stack, as_json, with_turns=True)


def _body(radius: str | None, height: str | None) -> tuple[float, float] | None:
    """Return radius and height of a wall, mm; None without."""
    from mirrorskin.cli.quantity import length
    from mirrorskin.io import InputError

    if radius is None and height is None:
        return None
    if radius is None or height is None:
        raise InputError("--body-radius and --body-height belong together: give both")
    return length(radius, "--body-radius"), length(height, "--body-height")


def _touches(sources: Sequence[Source]) -> list[tuple[Source | None, Source]]:
    """Return turns with the press before each, or None."""
    from mirrorskin.io import InputError

    touches: list[tuple[Source | None, Source]] = []
    press: Source | None = None
    for source in sources:
        if source.motion == "vertical":
            if press is not None:
                raise InputError(f"{press.name} is followed by another press: give the turn of each press")
            press = source
            continue
        touches.append((press, source))
        press = None
    if press is not None:
        raise InputError(f"{press.name} has no turn: give the turn at the same place after it")
    return touches


def _stated(texts: Sequence[str]) -> dict[str, Stated]:
    """Return numbers with standard deviations by name."""
    from mirrorskin.cli.quantity import angle, length
    from mirrorskin.engine.calibration.touches import Stated
    from mirrorskin.io import InputError

    stated = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        name = name.strip().replace("-", "_")
        value, separator, sigma = numbers.replace("±", "+-").partition("+-")
        if not separator:
            raise InputError(f"--stated {text}: write NAME=VALUE+-SIGMA, such as tilt=2.5deg+-0.2deg")
        try:
            if name in _ANGLES:
                pair = angle(value.strip(), "--stated"), angle(sigma.strip(), "--stated")
            elif name in _LENGTHS:
                pair = length(value.strip(), "--stated"), length(sigma.strip(), "--stated")
            else:
                pair = float(value), float(sigma)
        except ValueError:
            raise InputError(f"--stated {text}: {value} and {sigma} must be numbers") from None
        stated[name] = Stated(*pair)
    return stated


def _learned(found: TouchFit, paths: list[Path]) -> inputs.Learned:
    named = {estimate.name: estimate for estimate in found.estimates}
    shown = [named[name] for name in _SHOWN if name in named]
    numbers = {
        name: {"value": each.value, "sigma": each.sigma, "of_touches": each.of_touches, "unit": each.unit}
        | {"determined": each.determined}
        for name, each in named.items()
    }
    return inputs.Learned(
        found.response,
        {"sources": paths, "notes": "; ".join(found.notes)},
        {
            "estimates": numbers,
            "frame_gains": {name: gains.tolist() for name, gains in found.frame_gains.items()},
            "notes": list(found.notes),
        },
        ", ".join(map(_text, shown)),
        [f"note: {note}" for note in found.notes],
        [found.precession] if found.gel is None else [found.precession, found.gel],
    )


def _text(estimate: Estimate) -> str:
    """Return an estimate with its standard error."""
    name, unit, factor = estimate.name.replace("_", " "), estimate.unit, 1.0
    if unit == "rad":
        unit, factor = "deg", math.degrees(1)
    sigma = estimate.sigma * factor
    digits = max(0, 1 - math.floor(math.log10(sigma))) if sigma > 0 else 3
    return f"{name} {estimate.value * factor:.{digits}f} ± {sigma:.{digits}f} {unit}".rstrip()
