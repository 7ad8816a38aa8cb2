"""Newtons from presses: gel and modulus learned from balls and a scale, then the force of other presses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mirrorskin.cli.demo.presses import lab_camera
from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import hw

_MODULUS = 0.1  # MPa, of the twin's body
_SCALE = 0.001  # N, standard deviation of the scale's readings
_FIELD, _STEP = 8.64, 0.03  # mm
_HEAD = ["press", "depth", "force", "sigma", "truth", "error", "error / sigma"]
_LEGEND = """\
Forces in N. Gel and modulus were learned from presses of other balls to other depths, with a scale that
is wrong by 1 mN. sigma: standard deviation that is expected. truth: the twin's."""


@dataclass(frozen=True)
class Press:
    """A ball pressed to a depth, mm."""

    diameter: float
    depth: float


@dataclass(frozen=True)
class Experiment:
    """Presses for the gel, for the modulus as well, and those whose forces are found; pixels of a side."""

    gel: Sequence[Press] = (Press(4, 1.2), Press(8, 1.2))
    scale: Sequence[Press] = (Press(6, 0.6), Press(10, 0.9))
    found: Sequence[Press] = (Press(3, 0.81), Press(5, 0.51), Press(5, 1.02), Press(7, 0.75), Press(9, 1.05))
    size: int = 56


EXPERIMENT = Experiment()
Outcomes = Mapping[str, Mapping[str, float]]


def run(experiment: Experiment, folder: Path, device: str | None) -> Outcomes:
    """Calibrate, press, and draw what comes out; return found and true forces by press."""
    import numpy as np

    from mirrorskin import engine, io, view
    from mirrorskin.engine.calibration.force import fit_stiffness, known_press
    from mirrorskin.engine.calibration.gel import ball_onset, fit_gel
    from mirrorskin.engine.press.press import reconstruct_press

    pressed = [_twin(experiment, press, number, device) for number, press in enumerate(experiment.gel)]
    onsets = [
        ball_onset(reconstruct_press(twin, fill=False, device=device), twin, press.diameter / 2)
        for twin, press in zip(pressed, experiment.gel, strict=True)
    ]
    camera = io.CameraId("", pressed[0].shape[1:], np.dtype(pressed[0].dtype))
    known = io.Calibration(camera, gel=fit_gel(onsets).gel)
    pressed += [
        _twin(experiment, press, 20 + number, device) for number, press in enumerate(experiment.scale)
    ]
    scale = np.random.default_rng(1)
    weighed = [
        known_press(twin, known, _true_force(twin) + _SCALE * scale.normal(), _SCALE, device=device)
        for twin in pressed
    ]
    assert known.gel is not None
    cal = folder / "force-cal.h5"
    for part in (known.gel, fit_stiffness(weighed, known.gel).stiffness):
        known = io.update_calibration(cal, part, camera)
    results, truths = {}, {}
    for number, press in enumerate(experiment.found):
        twin = _twin(experiment, press, 40 + number, device)
        name = f"ball {press.diameter:g} mm, {press.depth:g} mm deep"
        results[name] = engine.reconstruct(twin, known, fill=False, device=device)
        io.save_result(results[name], folder / f"force-{number}-result.h5")
        truths[name] = _true_force(twin)
    shown = engine.find_force(twin.truth.height, press.depth, _FIELD / experiment.size, _MODULUS)
    title = f"Force of presses: gel of {1000 * _MODULUS:g} kPa, calibrated with a scale"
    view.force_figure(results, truths, shown.pressure, title, folder / "force.png")
    return {
        name: {"force": result.force or 0.0, "sigma": result.force_sigma or 0.0, "truth": truths[name]}
        for name, result in results.items()
    }


def _twin(experiment: Experiment, press: Press, seed: int, device: str | None) -> hw.Twin:
    from dataclasses import replace

    from mirrorskin import hw, io
    from mirrorskin.hw.twin import Body, Sphere, Vertical

    travel = io.Steps(_STEP, _STEP).positions(round(press.depth / _STEP))
    return hw.Twin(
        object=Sphere(press.diameter),
        shape=(experiment.size, experiment.size),
        pixel_size=_FIELD / experiment.size,
        movement=Vertical(travel),
        contact="elastic",
        optics="cylinder",
        body=Body(modulus=_MODULUS),
        camera=replace(lab_camera(), seed=seed),
        references="ball",
        device=device,
    )


def _true_force(twin: hw.Twin) -> float:
    assert twin.truth.force is not None
    return float(twin.truth.force[-1, 2])


def print_outcomes(outcomes: Outcomes) -> None:
    """Print the forces of all presses, and what the columns are."""
    rows = []
    for name, found in outcomes.items():
        off = found["force"] - found["truth"]
        cells = [f"{found[key]:.4f}" for key in ("force", "sigma", "truth")]
        press, depth = name.removesuffix(" deep").split(", ")
        error, wrong = f"{100 * off / found['truth']:+.2f} %", f"{off / found['sigma']:+.2f}"
        rows.append([press, depth, *cells, error, wrong])
    print_table(_HEAD, rows)
    click.echo(_LEGEND)
