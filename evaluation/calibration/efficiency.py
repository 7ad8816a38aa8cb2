"""How near a calibration from one touch comes to the least possible standard errors.

``python evaluation/calibration/efficiency.py [--seeds 50] [--freeze]`` prints, for each textured object of
``fisher.py``, the bound of a real sensor, the usual standard error of a calibration over it, and the mean
square of deviations in standard errors (chi-square), and writes the table into docs/method/touches.md.

The scene is that of ``fisher.py``, rendered by it: points do not move in the picture, so the depth of the
press is not stated. The object is turned and moved at random, as pixels that are aligned with it are at the
same heights and count once. The press has steps of 21 µm, so that a height has a standard deviation of 6 µm.
The recording states gain, offset and half-angle with errors of 3 %, 3 counts and 4 %.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration import from_touches
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration import fisher
from mirrorskin.io import Header

Map = NDArray[np.float64]

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method" / "touches.md"
OBJECTS = "rough", "woven", "dimpled", "knurled"
STEP = fisher.PRESS_SIGMA * math.sqrt(12)
DARK, BRIGHT = 20.0, 200.0  # counts of a press
NOISE = 1.0  # counts, before rounding
AWAY = 0.5  # mm by which objects are moved, at most
_STEP = 1e-4  # mm, for slopes
PARAMETERS = {
    "zenith_gain": ("gain", "gain, %", 100 / fisher.Sensor.gain),
    "zenith_offset": ("offset", "offset, counts", 1.0),
    "gamma": ("gamma", "curvature, %", 100.0),
    "tilt": ("half-angle", "half-angle, %", 100 / fisher.Sensor.half_angle),
    "phase_offset": ("phase", "phase, deg", math.degrees(1)),
    "oval_x": ("ellipticity x", "ellipticity, %", 100.0),
    "uneven_x": ("uneven x", "uneven light, %", 100.0),
}
"""Names in a fit: name in the bound, heading, and factor of the unit."""


def surface(name: str, seed: int) -> tuple[Map, Map, Map]:
    """Return heights of an object, mm, below 0, and slopes along x and y, at a random place."""
    random = np.random.default_rng(1000 + seed)
    turned, (aside, up) = random.uniform(0, 2 * np.pi), random.uniform(-AWAY, AWAY, 2)
    cosine, sine = math.cos(turned), math.sin(turned)

    def height(x: Map, y: Map) -> Map:
        return fisher.OBJECTS[name](cosine * x - sine * y + aside, sine * x + cosine * y + up)

    x, y = fisher.axes()
    z = height(x, y)
    p = (height(x + _STEP, y) - height(x - _STEP, y)) / (2 * _STEP)
    q = (height(x, y + _STEP) - height(x, y - _STEP)) / (2 * _STEP)
    return z - np.max(z) - STEP, p, q


def touch(name: str, seed: int) -> tuple[Frames, Frames, Map]:
    """Return a press and a turn of an object, and its heights, mm."""
    random, sensor = np.random.default_rng(seed), fisher.Sensor()
    z, p, q = surface(name, seed)
    phase = np.arange(fisher.FRAMES) * 2 * np.pi / fisher.FRAMES
    rows, columns = z.shape
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(1, -1, rows))
    travel = np.arange(random.uniform(-STEP, 0), STEP - np.min(z), STEP)
    frames = [
        np.where(travel[:, np.newaxis, np.newaxis] > -z, BRIGHT, DARK),
        fisher.render(sensor.vector(), p, q, x, y, phase),
    ]
    press, turn = (
        np.clip(np.rint(light + NOISE * random.standard_normal(light.shape)), 0, 255).astype(np.uint8)
        for light in frames
    )
    size = (fisher.PIXEL, fisher.PIXEL)
    pressed = Header(
        motion="vertical",
        pixel_size=size,
        dark=np.full(z.shape, DARK, np.float32),
        bright=np.full(z.shape, BRIGHT, np.float32),
    )
    turned = Header(
        motion="axial",
        pixel_size=size,
        zenith_gain=np.asarray(sensor.gain * (1 + 0.03 * random.normal())),
        zenith_offset=np.asarray(sensor.offset + 3 * random.normal()),
        tilt=sensor.half_angle * (1 + 0.04 * random.normal()),
        dark=np.zeros(z.shape, np.float32),
        bright=np.full(z.shape, fisher.FULL - 1, np.float32),
    )
    title = f"{name} {seed}"
    return Frames(press, pressed, title, travel=travel), Frames(turn, turned, title, phase=phase), z


def rows(seeds: int) -> Iterator[tuple[str, ...]]:
    """Yield rows for each object."""
    true = {"zenith_gain": fisher.Sensor.gain, "zenith_offset": fisher.Sensor.offset, "gamma": 1.0}
    true["tilt"] = fisher.Sensor.half_angle
    for name in OBJECTS:
        bounds, sigmas, away = ({each: list[float]() for each in PARAMETERS} for _ in range(3))
        for seed in range(seeds):
            press, turn, height = touch(name, seed)
            least = fisher.bound(height, real=True).sigmas()
            for found in from_touches([(press, turn)]).estimates:
                if found.name in PARAMETERS:
                    bounds[found.name].append(least[PARAMETERS[found.name][0]])
                    sigmas[found.name].append(found.sigma)
                    away[found.name].append((found.value - true.get(found.name, 0.0)) / found.sigma)
        cells = []
        for each, (_, _, factor) in PARAMETERS.items():
            least_usual, usual = (
                factor * float(np.median(np.array(part[each]))) for part in (bounds, sigmas)
            )
            chi2 = np.mean(np.square(away[each]))
            cells.append(f"{least_usual:.2g}; {usual / least_usual:.2f}; {chi2:.2f}")
        yield name, *cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Standard errors of a calibration over the least possible.")
    parser.add_argument("--seeds", type=int, default=50, help="touches of each object")
    parser.add_argument("--freeze", action="store_true", help="write the table into the page")
    given = parser.parse_args()
    heads = "object", *(head for _, head, _ in PARAMETERS.values())
    table = Table("Standard errors over the bound", heads, list(rows(given.seeds)))
    print(table)
    if given.freeze:
        table.write_into(PAGE, "efficiency")


if __name__ == "__main__":
    main()
