"""Errors of a calibration from a single touch, over objects of the twin.

``python evaluation/calibration/one_touch.py [--seeds 12] [--freeze]`` prints, for each object, with a press
and by the turn alone, the usual standard error of parameters and the RMS deviation in standard errors, and
writes the table into docs/method/touches.md. Each seed has its own number of frames and press steps, place,
and noise. The recording states gain, offset, half-angle and pivot with errors of 3 %, 3 counts, 4 % and
0.15 mm.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.calibration import TouchFit, from_touches
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration.ageing import Textured, all_frames
from mirrorskin.io import InputError
from mirrorskin.twin import Axial, Camera, Twin, Vertical

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method" / "touches.md"
SHAPE, PIXEL = (96, 128), 0.04
TILT, PIVOT = math.radians(2.5), 0.5
STEPS, FRAMES = (17, 25, 40, 66, 100), (8, 12, 16, 24)
OBJECTS = "textured cone", "texture", "sphere", "cone", "coin"
PARAMETERS = {"zenith_gain": "gain, %", "zenith_offset": "offset, counts", "gamma": "curvature",
              "tilt": "half-angle, %", "phase_offset": "phase, deg", "pivot_z": "pivot, mm"}  # fmt: skip


def touch(name: str, seed: int) -> tuple[Frames, Frames, dict[str, float]]:
    """Return a press and a turn of an object, and the true numbers of the sensor."""
    random = np.random.default_rng(seed)
    travel = np.linspace(-0.3, 1.0 + random.uniform(0, 0.1), int(random.choice(STEPS)))
    count = int(random.choice(FRAMES))
    thing: dict[str, Any] = {"object": Textured(seed) if name == "textured cone" else name, "shape": SHAPE}
    thing |= {"pixel_size": PIXEL, "object_shift": tuple(random.uniform(-0.4, 0.4, 2))}
    phase = np.arange(count) * 2 * np.pi / count
    movement = Axial(phase, tilt=TILT, press=float(travel[-1]), pivot=(0.0, 0.0, PIVOT))
    press = Twin(movement=Vertical(travel), camera=Camera(seed=2 * seed), **thing)
    turn = Twin(movement=movement, pattern="linear", camera=Camera(seed=2 * seed + 1), **thing)
    true = {name: float(np.median(getattr(turn.header, name))) for name in ("zenith_gain", "zenith_offset")}
    true |= {"gamma": 1.0, "tilt": TILT, "phase_offset": 0.0, "pivot_z": PIVOT}
    gain, offset = np.asarray(turn.header.zenith_gain), np.asarray(turn.header.zenith_offset)
    header = replace(
        turn.header,
        zenith_gain=gain * (1 + 0.03 * random.normal()),
        zenith_offset=offset + 3 * random.normal(),
        tilt=TILT * (1 + 0.04 * random.normal()),
        pivot=(0.0, 0.0, PIVOT + 0.15 * random.normal()),
    )
    turned = Frames(all_frames(turn), header, f"{name} {seed}", phase=phase)
    return Frames(all_frames(press), press.header, f"{name} {seed}", travel=travel), turned, true


def summary(found: Sequence[tuple[TouchFit, Mapping[str, float]]], names: Iterable[str]) -> list[str]:
    """Return the usual standard error of parameters, and the RMS deviation in standard errors, of some fits.

    Each comes with the true parameters. Gain and half-angle are in percent, and the phase in degrees.
    """
    cells = []
    for name in names:
        sigma, away = [], []
        for fit, true in found:
            scale = {"phase_offset": math.degrees(1)}
            scale |= {each: 100 / true[each] for each in ("zenith_gain", "tilt")}
            for each in fit.estimates:
                if each.name == name:
                    sigma.append(each.sigma * scale.get(name, 1.0))
                    away.append((each.value - true[name]) / each.sigma)
        cells.append(f"{np.median(sigma):.2g}; {np.sqrt(np.mean(np.square(away))):.1f}")
    return cells


def rows(seeds: int) -> Iterator[tuple[str, ...]]:
    """Yield rows for each object."""
    for name, is_alone in itertools.product(OBJECTS, (False, True)):
        found = []
        for seed in range(seeds):
            press, turn, true = touch(name, seed)
            with suppress(InputError):
                found.append((from_touches([(None if is_alone else press, turn)]), true))
        title = f"{name}, turn alone" if is_alone else name
        yield title, *summary(found, PARAMETERS), str(seeds - len(found))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors of a calibration from a single touch.")
    parser.add_argument("--seeds", type=int, default=12, help="touches of each object")
    parser.add_argument("--freeze", action="store_true", help="write the table into the page")
    given = parser.parse_args()
    table = Table("One touch", ("object", *PARAMETERS.values(), "refused"), list(rows(given.seeds)))
    print(table)
    if given.freeze:
        table.write_into(PAGE, "one touch")


if __name__ == "__main__":
    main()
