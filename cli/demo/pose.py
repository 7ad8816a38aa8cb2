"""An object that rolls and turns between touches, each of a press and a rotation, and is followed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mirrorskin.cli.demo.presses import lab_camera
from mirrorskin.cli.output import print_table

if TYPE_CHECKING:
    from mirrorskin import hw, io

_FIELD, _SIDE, _SAMPLES = 5.0, 9.0, 240  # mm; samples along a side of the object
_DEPTH, _STEP, _STEPS = 1.4, 0.05, 30  # mm: below the object's origin; of a press
_TILT, _FRAMES = math.radians(2.5), 12
_ROUNDS = 20  # to a height of the moved object; each gains a factor of 3 or more
_PARTS = ["x", "y", "z", "turn about x", "turn about y", "turn about z"]
_HEAD = ["motion", "found", "sigma", "truth", "error / sigma", "RMS on the way", "sigma there"]
_LEGEND = """\
An object of no symmetry, from the first touch to the last: mm and degrees. error / sigma: of the last. RMS
on the way: of the errors of all touches, and of their predicted standard deviations, um and degrees."""


@dataclass(frozen=True)
class Experiment:
    """Touches, and pixels of a side."""

    touches: int = 10
    size: int = 80


EXPERIMENT = Experiment()
Outcomes = Mapping[str, Mapping[str, float]]


def run(experiment: Experiment, folder: Path, device: str | None) -> Outcomes:
    """Move the object, touch it, follow it, and draw what comes out."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from mirrorskin import engine, io, view

    share = np.linspace(0, 1, experiment.touches)
    shifts = np.stack([share, 0.6 * np.sin(math.pi * share), -0.05 * share], axis=1)
    vectors = np.radians(np.stack([8 * np.sin(math.tau * share), 10 * share, 40 * share], axis=1))
    tracker, results, poses = engine.PoseTracker(device=device), [], []
    for number, (vector, shift) in enumerate(zip(vectors, shifts, strict=True)):
        thing = _moved(Rotation.from_rotvec(vector).as_matrix(), shift)
        results.append(_touch(experiment, thing, _DEPTH + shift[2], number, device))
        poses.append(tracker.push(results[-1]))
    for name, result in (("first", results[0]), ("last", results[-1])):
        io.save_result(result, folder / f"pose-{name}-result.h5")
    found = view.Followed(results[0], results[-1], poses, vectors, shifts)
    view.pose_figure(
        found, "An object that rolls and turns between touches, on the twin", folder / "pose.png"
    )
    pose, error, sigma = poses[-1], found.errors, found.sigmas
    last = np.concatenate([pose.translation, np.degrees(pose.rotation)])
    true = np.concatenate([shifts[-1], np.degrees(vectors[-1])])
    # As the figure: translations first.
    order, large = [3, 4, 5, 0, 1, 2], np.array([1e3] * 3 + [math.degrees(1)] * 3)
    error, sigma = error[:, order], sigma[:, order]
    rms, spread = (large * np.sqrt(np.mean(part[1:] ** 2, axis=0)) for part in (error, sigma))
    unit = np.array([1.0] * 3 + [math.degrees(1)] * 3)
    rows = (last, unit * sigma[-1], true, error[-1] / sigma[-1], rms, spread)
    return {
        name: dict(zip(_HEAD[1:], map(float, cells), strict=True))
        for name, *cells in zip(_PARTS, *rows, strict=True)
    }


def _moved(turn: Any, shift: Any) -> hw.twin.Object:
    """Return the object after a rotation and a translation."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.hw.twin import HeightMap

    pixel = (_SIDE / _SAMPLES, _SIDE / _SAMPLES)
    x, y = io.pixel_axes((_SAMPLES, _SAMPLES), pixel)
    place = np.stack([*np.meshgrid(x, y), np.zeros((_SAMPLES, _SAMPLES))], axis=-1)
    for _ in range(_ROUNDS):
        own = (place - shift) @ turn
        place[..., 2] += _pebble(own[..., 0], own[..., 1]) - own[..., 2]
    return HeightMap(place[..., 2], pixel, "pebble")


def _pebble(x: Any, y: Any) -> Any:
    """Return the height of a dome with waves in it, which no motion leaves as it is."""
    import numpy as np

    dome = x * x / 10 + y * y / 7 + x * y / 30
    return 0.1 * np.sin(1.5 * x + 0.3) * np.cos(1.2 * y) + 0.06 * np.sin(2.1 * y + x) - dome


def _touch(
    experiment: Experiment, thing: hw.twin.Object, press: float, seed: int, device: str | None
) -> io.Result:
    """Press on the object, rotate about the middle of the pressed sheet, and fuse both."""
    from mirrorskin import hw, io
    from mirrorskin.engine.fusion import fuse_sources
    from mirrorskin.hw.twin import Axial, Vertical

    phase = io.Steps(math.tau / _FRAMES).positions(_FRAMES)
    vertical, axial = (
        hw.Twin(
            object=thing,
            shape=(experiment.size, experiment.size),
            pixel_size=_FIELD / experiment.size,
            movement=movement,
            pattern=pattern,
            camera=replace(lab_camera(), seed=2 * seed + number),
            device=device,
        )
        for number, (movement, pattern) in enumerate(
            [
                (Vertical(io.Steps(_STEP, _STEP).positions(_STEPS)), "uniform"),
                (Axial(phase, _TILT, press, (0.0, 0.0, press)), "linear"),
            ]
        )
    )
    return fuse_sources(vertical, axial, device=device)


def print_outcomes(outcomes: Outcomes) -> None:
    """Print where the object was found, and what the columns are."""
    style = {"error / sigma": "+.2f", "RMS on the way": ".3g", "sigma there": ".3g"}
    rows = [
        [name, *(format(found[key], style.get(key, ".4f")) for key in _HEAD[1:])]
        for name, found in outcomes.items()
    ]
    print_table(_HEAD, rows)
    click.echo(_LEGEND)
