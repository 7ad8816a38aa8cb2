"""The gel's compliance, and the other parameters of a sensor, from touches with an elastic body.

``python evaluation/calibration/elastic_touches.py [--seeds 12] [--freeze]`` prints, for touches of a ball, of
a cone and of both, the usual standard error of parameters and the RMS deviation in standard errors, and
writes the table into docs/method/touches.md. Each seed has its own place, depth and steps of the press. The
gel is calibrated with an error of its compliance of ± 0.02 / mm; the recording states gain, offset and
half-angle with errors of 3 %, 3 counts and 1 %.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mirrorskin import io
from mirrorskin.engine.calibration import from_touches
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration import one_touch
from mirrorskin.evaluation.calibration.ageing import all_frames
from mirrorskin.twin import Axial, Camera, Twin, Vertical

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method" / "touches.md"
SHAPE, PIXEL = (96, 128), 0.05
TILT, PIVOT = math.radians(2.5), 0.5
COMPLIANCE, ERROR = 0.05, 0.02  # 1/mm: of the gel, and standard error of its calibration
FRAMES = 16
THINGS: tuple[tuple[Literal["sphere", "cone"], ...], ...] = ("sphere",), ("cone",), ("sphere", "cone")
PARAMETERS = {"compliance": "compliance, 1/mm", **one_touch.PARAMETERS}


def touch(name: Literal["sphere", "cone"], seed: int) -> tuple[Frames, Frames]:
    """Return a press and a turn of an object, with an elastic body."""
    random = np.random.default_rng(seed)
    travel = np.arange(-0.1, random.uniform(0.7, 1.1), random.choice([0.02, 0.03]))
    thing: dict[str, Any] = {"object": name, "shape": SHAPE, "pixel_size": PIXEL, "contact": "elastic"}
    thing["object_shift"] = tuple(random.uniform(-0.4, 0.4, 2))
    phase = np.arange(FRAMES) * 2 * np.pi / FRAMES
    movement = Axial(phase, tilt=TILT, press=float(travel[-1]), pivot=(0.0, 0.0, PIVOT))
    press = Twin(movement=Vertical(travel, compliance=COMPLIANCE), camera=Camera(seed=2 * seed), **thing)
    turn = Twin(movement=movement, pattern="linear", camera=Camera(seed=2 * seed + 1), **thing)
    taken = f"{name} {seed}"
    pressed = Frames(all_frames(press), press.header, taken, travel=travel)
    return pressed, Frames(all_frames(turn), turn.header, taken, phase=phase)


def touches(names: Sequence[Literal["sphere", "cone"]], seed: int) -> tuple[Any, dict[str, float]]:
    """Return touches whose recordings state wrong numbers, and the true ones."""
    pairs = [touch(name, 10 * seed + number) for number, name in enumerate(names)]
    header = pairs[0][1].header
    gain, offset = (float(np.median(np.asarray(each))) for each in (header.zenith_gain, header.zenith_offset))
    true = {"compliance": COMPLIANCE, "zenith_gain": gain, "zenith_offset": offset, "gamma": 1.0}
    true |= {"tilt": TILT, "phase_offset": 0.0, "pivot_z": PIVOT}
    random = np.random.default_rng(900 + seed)
    wrong: dict[str, Any] = {
        "zenith_gain": np.asarray(gain * (1 + 0.03 * random.normal())),
        "zenith_offset": np.asarray(offset + 3 * random.normal()),
        "tilt": TILT * (1 + 0.01 * random.normal()),
    }
    for _, turn in pairs:
        turn.header = replace(turn.header, **wrong)
    return pairs, true


def calibration(compliance: float, error: float = ERROR) -> io.Calibration:
    """Return a calibration whose gel has a compliance with a standard error."""
    gel = io.Gel(threshold=0.2, compliance=compliance, sigma={"compliance": error})
    return io.Calibration(io.CameraId("", SHAPE, np.dtype("uint8")), gel=gel)


def rows(seeds: int) -> Iterator[tuple[str, ...]]:
    """Yield rows for each set of objects."""
    for names in THINGS:
        found = []
        for seed in range(seeds):
            pairs, true = touches(names, seed)
            known = COMPLIANCE + ERROR * np.random.default_rng(seed).normal()
            stated = {"tilt": (pairs[0][1].header.tilt, 0.01 * TILT)}
            fit = from_touches(pairs, calibration=calibration(max(0.0, known)), stated=stated)
            found.append((fit, true))
        yield " and ".join(names), *one_touch.summary(found, PARAMETERS)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors of a calibration from touches with an elastic body.")
    parser.add_argument("--seeds", type=int, default=12, help="touches of each object")
    parser.add_argument("--freeze", action="store_true", help="write the table into the page")
    given = parser.parse_args()
    table = Table("Touches of an elastic body", ("object", *PARAMETERS.values()), list(rows(given.seeds)))
    print(table)
    if given.freeze:
        table.write_into(PAGE, "elastic touches")


if __name__ == "__main__":
    main()
