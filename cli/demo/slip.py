"""Slip on the twin: a ball slides over the skin, and turns on it, beyond what friction holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mirrorskin.cli.demo.presses import lab_camera
from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import hw, view

_RADIUS, _PRESS, _FRICTION = 5.0, 0.5, 0.5  # mm, mm
_FIELD, _FLAKE, _CONTRAST = 3.84, 0.12, 0.9  # mm, mm
_SLIDE, _REST = 0.9, 0.5  # of the way to full sliding; of the contact's radius that a twist leaves stuck
_HEAD = ["slip", "found", "sigma", "truth", "closed form", "chi2"]
_LEGEND = """\
A ball of 10 mm, friction 0.5, on a speckled sheet; the contact of the press is given. displacement: RMS
error and RMS of the predicted standard deviation, um. onset: the same of the way at which the skin breaks
loose, um and degrees. stick radius: at the end, as a share of the contact's; closed forms of Cattaneo and
Mindlin, and of Lubkin. angle: by which the skin that sticks has turned, degrees."""


@dataclass(frozen=True)
class Experiment:
    """Frames of each movement, and pixels of a side."""

    frames: int = 16
    size: int = 128


EXPERIMENT = Experiment()
Outcomes = Mapping[str, Mapping[str, float]]


def run(experiment: Experiment, folder: Path, device: str | None) -> Outcomes:
    """Slide, twist, and draw what comes out."""
    import numpy as np

    from mirrorskin import view
    from mirrorskin.hw.twin import Horizontal, Twist

    shares = np.linspace(0, _SLIDE, experiment.frames)
    slide = Horizontal(np.outer(1.5 * _FRICTION * _PRESS * shares, [1.0, 0.0]), _PRESS)
    rests = np.linspace(1, _REST, experiment.frames)
    twist = Twist(_twist_angle(rests), _PRESS)
    slid = _search(experiment, slide, 1 - shares, device)
    twisted = _search(experiment, twist, rests**2, device)
    title = "Slip on the twin: a ball of 10 mm, friction 0.5 (black: contact; red: what sticks at the end)"
    view.slip_figure(slid, twisted, title, folder / "slip.png")
    assert twisted.found.angle is not None
    angle, truth = math.degrees(twisted.found.angle), -math.degrees(twist.path[-1])
    return {
        **_outcomes("slide", slid, 1e3),
        **_outcomes("twist", twisted, math.degrees(1)),
        "twist, angle": {"found": angle, "truth": truth},
    }


def _twist_angle(rest: Any) -> Any:
    """Return the twist that leaves a share of the contact's radius stuck, radians (Lubkin, 1951)."""
    from scipy import special

    # mu p(0) / (2 G) (K - E), of Hertz's pressure p(0) = 8 G a / (pi R).
    outer = 1 - rest**2
    most = 4 * _FRICTION * math.sqrt(_PRESS / _RADIUS) / math.pi
    return most * (special.ellipk(outer) - special.ellipe(outer))


def _search(
    experiment: Experiment, movement: hw.twin.Movement, closed: Any, device: str | None
) -> view.Slipped:
    """Simulate a movement and find its slip."""
    import numpy as np

    from mirrorskin import engine, hw, io, view
    from mirrorskin.hw.twin import Body, SheetTexture, Sphere

    pixel = _FIELD / experiment.size
    twin = hw.Twin(
        object=Sphere(2 * _RADIUS),
        shape=(experiment.size, experiment.size),
        pixel_size=pixel,
        movement=movement,
        contact="elastic",
        body=Body(friction=_FRICTION),
        camera=lab_camera(),
        texture=SheetTexture("flakes", size=_FLAKE, contrast=_CONTRAST),
        device=device,
    )
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    contact = twin.sheet(0).contact
    motion: Any = twin.motion
    search = engine.SlipSearch(
        twin.shape[1:], twin.dtype, pixel, motion=motion, contact=contact, device=device
    )
    places: Any = {search.position: movement.path}
    search.push(frames, **places)
    x, y = io.pixel_axes((twin.shape[1], twin.shape[2]), (pixel, pixel))
    return view.Slipped(search.result(), twin.truth, contact, closed, x, y)


def _outcomes(name: str, slid: view.Slipped, scale: float) -> dict[str, dict[str, float]]:
    import numpy as np

    found = slid.found
    return {
        f"{name}, displacement": _judge(slid.displacement_error, found.displacement_sigma[..., None], 1e3),
        f"{name}, onset": _judge(slid.onset_error, found.slip_onset_sigma, scale),
        f"{name}, stick radius": {
            "found": math.sqrt(found.stick_ratio[-1]),
            "truth": math.sqrt(slid.true_ratio[-1]),
            "closed form": float(np.sqrt(slid.closed[-1])),
        },
    }


def _judge(error: Any, sigma: Any, scale: float) -> dict[str, float]:
    import numpy as np

    known = np.isfinite(error)
    spread = np.broadcast_to(sigma, error.shape)[known]
    return {
        "found": scale * float(np.sqrt(np.mean(error[known] ** 2))),
        "sigma": scale * float(np.sqrt(np.mean(spread**2))),
        "chi2": float(np.mean((error[known] / spread) ** 2)),
    }


def print_outcomes(outcomes: Outcomes) -> None:
    """Print what was found, and what the rows are."""
    rows = [
        [name, *(f"{found[key]:.4g}" if key in found else "-" for key in _HEAD[1:])]
        for name, found in outcomes.items()
    ]
    print_table(_HEAD, rows)
    click.echo(_LEGEND)
