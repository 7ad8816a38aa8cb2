"""Touches on the emulated rig, compared with the best fixed recipe that is found by trying all.

``python evaluation/touch.py recipes`` tries the recipes and stores them in ``evaluation/stored/touch.json``;
``python evaluation/touch.py`` touches each object on simulated time, and compares the two.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.live.recipe import PRESS_STEPS
from mirrorskin.engine.live.touch import Touched, fuse_touch, sigma_of_normals, touch
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.touch import TILT, RigTouch
from mirrorskin.twin import Axial, Camera, Twin, Vertical
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock
from mirrorskin.twin.movement import Movement

OBJECTS = "sphere", "coin", "cone", "cylinder", "step", "texture"
REQUESTS = 10.0, 3.0, 1.0
"""Requested standard deviations, µm."""

SHARE = 0.95
ERROR_MAX = 1.1
"""Largest RMS error of the pixels that have a requested standard deviation, relative to it."""

SEEDS = range(3)
"""For each of which a recipe must meet a request, so that none is chosen by luck."""

DEPTH = 0.6
"""Greatest travel, mm."""

START = -1.0
"""Travel at which the search for contact starts, mm."""

RATE = 20.0
"""Frames per second of the emulated camera."""

SCENE: Mapping[str, Any] = {"shape": (96, 128), "pixel_size": 0.03, "pattern": "linear"}
PRESSES = range(PRESS_STEPS[0], PRESS_STEPS[1] + 1)
TURNS = 4, 5, 6, 8, 12, 24

STORED = Path(__file__).parent / "stored" / "touch.json"
"""By object, standard deviations of all `recipes`, and the `fewest` frames that meet each request."""


@dataclass(frozen=True)
class Tried:
    """What a number of frames gave: the standard deviation that the share of the pixels has, and errors, µm.

    ``errors`` are the RMS errors of the pixels that have each requested standard deviation, by request.
    """

    sigma: float
    errors: tuple[float, ...]


@cache
def frames_of(name: str, movement: str, count: int, seed: int) -> tuple[Twin, NDArray[Any]]:
    """Return a twin and its frames: a press of a number of steps, or a turn of a number of frames."""
    turned = Axial(math.tau * np.arange(count) / count, TILT, DEPTH)
    pressed = Vertical(np.linspace(0.0, DEPTH, count + 1))
    moved: Movement = pressed if movement == "press" else turned
    twin = Twin(object=name, movement=moved, camera=Camera(seed=seed), references="ball", **SCENE)
    frames = np.empty(twin.shape, twin.dtype)
    count = 0
    while count < len(frames) and (block := twin.read(frames[count:])) is not None:
        count += len(block.frames)
    twin.rewind()
    return twin, frames


def tried(result: io.Result, truth: io.Truth) -> Tried:
    """Return standard deviation and errors of a surface."""
    error = 1e3 * (np.asarray(result.height) - truth.height)[np.isfinite(result.normals[..., 0])]
    sigma = 1e3 * sigma_of_normals(result)
    known = (error[sigma <= request] for request in REQUESTS)
    errors = tuple(float(np.sqrt(np.mean(part**2))) if part.size else math.nan for part in known)
    return Tried(float(np.quantile(sigma, SHARE, method="higher")), errors)


def try_recipe(name: str, press_steps: int, turn_frames: int, seed: int = 0) -> Tried:
    """Return the outcome of a fixed recipe."""
    pressed, frames = frames_of(name, "press", press_steps, seed)
    turned, _ = frames_of(name, "turn", turn_frames, seed)
    travel = {"travel": np.linspace(0.0, DEPTH, press_steps + 1)}
    press = io.ArrayRecording(frames, travel, {"pixel_size": pressed.header.pixel_size})
    turned.rewind()
    try:
        result = fuse_touch(press, turned)
    except NotConverged:
        return Tried(math.inf, (math.nan,) * len(REQUESTS))
    return tried(result, turned.truth)


def try_all(name: str) -> list[list[float | None]]:
    """Return the standard deviation of all recipes, µm: a list of turn frames for each number of steps.

    None if there is none, as where pixels with a normal have no height.
    """
    sigma = [[try_recipe(name, steps, frames).sigma for frames in TURNS] for steps in PRESSES]
    return [[round(value, 3) if math.isfinite(value) else None for value in row] for row in sigma]


def fewest(name: str, sigma: Sequence[Sequence[float | None]], request: float) -> int | None:
    """Return the fewest frames of a recipe that has the requested standard deviation, µm, and such errors."""
    number = REQUESTS.index(request)
    candidates = [
        (steps + count, steps, count)
        for steps, row in zip(PRESSES, sigma, strict=True)
        for count, value in zip(TURNS, row, strict=True)
        if value is not None and value <= request
    ]
    for frames, steps, count in sorted(candidates):
        outcomes = (try_recipe(name, steps, count, seed) for seed in SEEDS)
        if all(each.sigma <= request and each.errors[number] <= ERROR_MAX * request for each in outcomes):
            return frames
    return None


def touched(name: str, request: float, seed: int, within: float = math.inf) -> tuple[Touched, Tried]:
    """Touch an object on the emulated rig, on simulated time."""
    clock = SimulatedClock()
    emulated = EmulatedRig(name, rate=RATE, seed=seed, clock=clock, **SCENE)
    with (
        emulated,
        Rig(emulated.open_stage(emulated.settings.stage), emulated.camera, emulated.settings, clock) as rig,
    ):
        with RigTouch(rig, DEPTH, START) as sensor:
            outcome = touch(sensor, 1e-3 * request, share=SHARE, within=within)
        phases = np.asarray(outcome.turn.phase)
        truth = emulated.twin(Axial(phases, TILT, float(outcome.turn.header.press or 0.0))).truth
    return outcome, tried(outcome.result, truth)


def measure(seeds: int = 3) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table."""
    best = json.loads(STORED.read_text())["fewest"]
    for name in OBJECTS:
        for number, request in enumerate(REQUESTS):
            for seed in range(1, seeds + 1):
                outcome, errors = touched(name, request, seed)
                frames, needed = outcome.press_steps + outcome.turn_frames, best[name][number]
                yield (
                    name,
                    f"{request:g}",
                    str(seed),
                    "yes" if outcome.reached else "no",
                    f"{1e3 * outcome.planned.sigma:.2g}",
                    f"{1e3 * outcome.sigma:.2f}",
                    f"{errors.errors[number] / request:.2f}",
                    f"{outcome.press_steps} + {outcome.turn_frames}",
                    "-" if needed is None else str(needed),
                    "-" if needed is None or not outcome.reached else f"{frames / needed:.2f}",
                    f"{outcome.seconds:.1f}",
                    "" if outcome.reached else outcome.reason,
                )


HEAD = (
    *("object", "request, µm", "seed", "met", "expected, µm", "measured, µm", "RMS error / request"),
    *("press + turn", "fewest", "frames / fewest", "seconds", "reason"),
)


def main(arguments: Sequence[str]) -> None:
    """Try all recipes of some objects, or print the table of touches."""
    warnings.simplefilter("ignore", io.MirrorskinWarning)
    if arguments[:1] == ["recipes"]:
        stored = json.loads(STORED.read_text()) if STORED.exists() else {"recipes": {}, "fewest": {}}
        for name in arguments[1:] or OBJECTS:
            stored["recipes"][name] = sigma = try_all(name)
            stored["fewest"][name] = [fewest(name, sigma, request) for request in REQUESTS]
            STORED.write_text(json.dumps(stored) + "\n")
        return
    rows = list(measure(*map(int, arguments)))
    print(Table("Touches on the emulated rig", HEAD, rows))
    met = [row for row in rows if row[3] == "yes"]
    errors = np.array([float(row[6]) for row in met])
    ratios = np.array([float(row[9]) for row in met if row[9] != "-"])
    possible = [row for row in rows if row[8] != "-"]
    print(f"met: {len(met)} of {len(rows)}; possible with a fixed recipe: {len(possible)}")
    within = np.mean(errors <= ERROR_MAX)
    print(f"RMS error at most {ERROR_MAX} of the request: {within:.1%} of the touches that met it")
    print(f"frames at most 1.3 of the fewest: {np.mean(ratios <= 1.3):.1%}, median {np.median(ratios):.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
