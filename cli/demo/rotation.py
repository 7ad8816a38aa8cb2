"""The paper's axial rotation, section 4.2: normals by its own equations, and by the most likely normal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mirrorskin.cli.demo.presses import lab_camera, record
from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import io
    from mirrorskin.engine import Score
    from mirrorskin.engine.rotation.normals_kernel import NormalMethod


@dataclass(frozen=True)
class Experiment:
    """A rotation about a point, with the body pressed on an object."""

    name: str
    thing: str
    title: str
    size: int
    pixel_size: float
    press: float
    tilt: float
    steps: int


EXPERIMENTS = (
    Experiment("fig10a", "sphere", "Fig. 10 (a): sphere, 10 mm, 8 x 45 deg", 240, 0.05, 1.5, 2.5, 8),
)
# Methods, and whether the frames are registered for the pivot's shift, with the true heights.
_WAYS: dict[str, tuple[NormalMethod, bool]] = {
    "paper": ("paper", False),
    "exact": ("exact", False),
    "paper, registered": ("paper", True),
    "exact, registered": ("exact", True),
}
_DRAWN = "paper", "exact", "exact, registered"
_HEAD = [
    "experiment",
    "method",
    "answered",
    "median",
    "RMS",
    "99 %",
    "chi2",
    "lost and flagged",
    "wrongly flagged",
]
_LEGEND = """\
Angles between normals and truth in degrees. answered: share of the pixels in contact in every frame that
have an answer and are marked as in contact. chi2: mean of (error / predicted error)^2. The linear pattern's
dark end hides zeniths below 13 degrees, its bright end those above 43. registered: frames follow the
object, by its true heights."""

Outcomes = Mapping[str, "Score"]


def run(experiment: Experiment, folder: Path, device: str | None, overwrite: bool = False) -> Outcomes:
    """Turn about the sheet's centre, and draw the normals; return scores by method."""
    from mirrorskin import engine, io, view

    base = folder / experiment.name
    truth = _record(experiment, base.with_suffix(".h5"), device, overwrite)
    results = {}
    with io.open_recording(base.with_suffix(".h5")) as recording:
        for name, (method, registered) in _WAYS.items():
            heights = truth.height if registered else None
            results[name] = engine.reconstruct(recording, method=method, heights=heights, device=device)
    for name, result in results.items():
        io.save_result(result, folder / f"{experiment.name}-{name.replace(', ', '-')}-result.h5")
    drawn = {name: results[name] for name in _DRAWN}
    view.normal_figure(drawn, truth, experiment.title, base.with_suffix(".png"))
    return {name: engine.score(result, truth) for name, result in results.items()}


def _record(experiment: Experiment, path: Path, device: str | None, overwrite: bool) -> io.Truth:
    """Turn with a camera as labs have it, and a wall whose light is linear in the zenith."""
    import math

    from mirrorskin import hw, io
    from mirrorskin.hw.twin import Axial

    phase = io.Steps(2 * math.pi / experiment.steps).positions(experiment.steps)
    twin = hw.Twin(
        object=experiment.thing,
        shape=(experiment.size, experiment.size),
        pixel_size=experiment.pixel_size,
        movement=Axial(phase, math.radians(experiment.tilt), experiment.press),
        pattern="linear",
        camera=lab_camera(),
        device=device,
    )
    return record(twin, path, f"turning on the {experiment.thing}", overwrite)


def print_outcomes(outcomes: Mapping[str, Outcomes]) -> None:
    """Print the errors of all rotations, and what the columns are."""
    rows = [
        [name, method, *_cells(score)]
        for name, by_method in outcomes.items()
        for method, score in by_method.items()
    ]
    print_table(_HEAD, rows)
    click.echo(_LEGEND)


def _cells(score: Score) -> list[str]:
    normal, contact = score.normal, score.contact
    assert normal is not None
    flags = ["-", "-"]
    if contact is not None:
        flags = [f"{100 * contact.lost_flagged:.1f} %", f"{100 * contact.wrongly_flagged:.1f} %"]
    return [
        f"{100 * normal.coverage:.1f} %",
        f"{normal.median:.2f}",
        f"{normal.rms:.2f}",
        f"{normal.p99:.2f}",
        f"{normal.chi_square:.2f}",
        *flags,
    ]
