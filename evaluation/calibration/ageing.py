"""How calibration from touches follows a lamp that ages, and when results report it.

``python evaluation/calibration/ageing.py [--only gain,trends] [--freeze]`` prints two tables, and writes them
into docs/method/touches.md and docs/method/sensor-health.md.

gain
    The gain of the sensor falls by 5 % over 100 recordings, one of a textured object every hour. Each is
    added to the calibration from all earlier ones, and the result is compared with the gain in this
    recording, for some time constants of forgetting.
trends
    Series of 20 recordings, whose gain falls as fast or not at all: how many of them have a trend of the
    brightness, as ``mirrorskin measure`` of the results reports it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine, io
from mirrorskin.engine.calibration import from_touches
from mirrorskin.engine.metrology.tables import find_trend
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.evaluation.calibration import scorer, touches
from mirrorskin.evaluation.calibration.scenes import Lab, in_other_light, press_for
from mirrorskin.twin import Axial, Camera, Twin, Vertical

Map = NDArray[np.float64]

PAGES = Path(__file__).resolve().parents[2] / "docs" / "method"
SHAPE, PIXEL, PRESS = (56, 56), 0.03, 1.6
TILT, PHASE = math.radians(2.5), np.arange(12) * np.pi / 6
NOISE = 1.5  # counts
OBJECTS = 8  # that are touched in turn
FALL = 0.05  # of the gain, over all recordings
HOURS = 1.0, 2.0, 3.0, 10.0, math.inf  # time constants; recordings are an hour apart
START = datetime(2026, 1, 1, tzinfo=UTC)
RECORDINGS = 100
SERIES, RESULTS, THINGS = 20, 20, 4  # series of results, and objects of each, for trends


@dataclass(frozen=True, slots=True)
class Textured:
    """Random waves, of 0.35 mm and longer, on a blunt cone."""

    seed: int
    name: str = "textured cone"
    radius: float = 5.0

    def _waves(self) -> Iterator[tuple[float, float, float, float]]:
        random = np.random.default_rng(self.seed)
        number = 2 * np.pi / random.uniform(0.35, 1.05, 14)
        azimuth, phase = random.uniform(0, 2 * np.pi, (2, 14))
        size = 0.12 * np.sqrt(2 / 14) / number
        return zip(number * np.cos(azimuth), number * np.sin(azimuth), phase, size, strict=True)

    def height(self, x: Map, y: Map, /) -> Map:
        """Return its heights, mm."""
        height = -0.35 - 0.5 * np.hypot(np.hypot(x, y), 0.3)
        for across, along, phase, size in self._waves():
            height = height + size * np.sin(across * x + along * y + phase)
        return np.where(np.hypot(x, y) < self.radius, height, np.nan)

    def slope(self, x: Map, y: Map, /) -> tuple[Map, Map]:
        """Return its slopes."""
        fall = -0.5 / np.sqrt(x**2 + y**2 + 0.09)
        slope_x, slope_y = fall * x, fall * y
        for across, along, phase, size in self._waves():
            wave = size * np.cos(across * x + along * y + phase)
            slope_x, slope_y = slope_x + across * wave, slope_y + along * wave
        inside = np.hypot(x, y) < self.radius
        return np.where(inside, slope_x, np.nan), np.where(inside, slope_y, np.nan)


@dataclass(frozen=True, slots=True)
class Light:
    """A touch without noise: frames and headers of press and turn."""

    frames: tuple[Map, Map]
    headers: tuple[io.Header, io.Header]
    travel: Map

    @classmethod
    def of(cls, seed: int) -> Light:
        """Render a touch."""
        travel = np.arange(0.03, PRESS, 0.03)
        field: dict[str, Any] = {"object": Textured(seed), "shape": SHAPE, "pixel_size": PIXEL}
        field |= {
            "object_shift": (0.6, 0.3),
            "camera": Camera(dtype=np.dtype(np.float32), noise=0.0, bits=None),
        }
        movement = Axial(PHASE, tilt=TILT, press=PRESS, pivot=(0.0, 0.0, 1.0))
        twins = Twin(movement=Vertical(travel), **field), Twin(movement=movement, pattern="linear", **field)
        press, turn = (all_frames(twin).astype(np.float64) for twin in twins)
        return cls((press, turn), (twins[0].header, twins[1].header), travel)

    def taken(self, number: int, gain: float) -> tuple[Frames, Frames]:
        """Return a recording of it in the light of a lamp that has aged, with noise."""
        noise = np.random.default_rng(1000 + number)
        dark = np.median(np.asarray(self.headers[1].dark))
        press, turn = (
            np.clip(
                np.rint(dark + share * (light - dark) + NOISE * noise.standard_normal(light.shape)), 0, 255
            )
            for light, share in zip(self.frames, (1.0, gain), strict=True)
        )
        time = (START + timedelta(hours=number)).isoformat()
        headers = [replace(header, start_time=time) for header in self.headers]
        return (
            Frames(press.astype(np.uint8), headers[0], f"press {number}", travel=self.travel),
            Frames(turn.astype(np.uint8), headers[1], f"turn {number}", phase=PHASE),
        )


def all_frames(twin: Twin) -> NDArray[Any]:
    """Return all frames of a twin in memory."""
    block = twin.read(np.empty(twin.shape, twin.dtype))
    assert block is not None
    return block.frames


def errors_of(lights: Sequence[Light], recordings: int, hours: float) -> Map:
    """Return the error of the gain after each recording, %, if touches are forgotten with a time constant."""
    before = io.Calibration(io.CameraId("", SHAPE, np.dtype(np.uint8)))
    errors = []
    for number in range(recordings):
        gain = 1 - FALL * number / max(recordings - 1, 1)
        light = lights[number % len(lights)]
        fit = from_touches(
            [light.taken(number, gain)],
            calibration=before,
            forget=3600 * hours if math.isfinite(hours) else None,
        )
        assert isinstance(fit.response, io.LinearResponse)
        before = replace(before, response=fit.response, precession=fit.precession)
        true = gain * float(np.median(np.asarray(light.headers[1].zenith_gain)))
        errors.append(100 * (float(np.median(fit.response.gain)) / true - 1))
    return np.array(errors)


def table(recordings: int) -> Table:
    """Return the errors by time constant."""
    lights = [Light.of(seed) for seed in range(OBJECTS)]
    rows = []
    for hours in HOURS:
        errors = errors_of(lights, recordings, hours)
        settled = errors[recordings // 5 :]
        numbers = (np.sqrt(np.mean(settled**2)), np.mean(settled), np.max(np.abs(settled)))
        rows.append(
            ("never" if math.isinf(hours) else f"{hours:g}", *(f"{number:.2f}" for number in numbers))
        )
    head = ("time constant, recordings", "RMS error of the gain, %", "mean, %", "largest, %")
    return Table(f"A gain that falls by {100 * FALL:g} % over {recordings} recordings", head, rows)


@dataclass(frozen=True, slots=True)
class Registered:
    """Turns of textured cones by a sensor without a wall, registered with the heights of a press."""

    name: str = "press and turn, textured cones"

    def changes(self, seed: int, gains: Sequence[float]) -> Map:
        """Return the change of the brightness that each result states, %."""
        lights = [Light.of(THINGS * (seed + 1000) + number) for number in range(THINGS)]
        stated = []
        for number, gain in enumerate(gains):
            press, turn = lights[number % THINGS].taken(2 * len(gains) * seed + number, gain)
            stated.append(_change_of(engine.reconstruct(turn, heights=engine.reconstruct(press))))
        return np.array(stated)


@dataclass(frozen=True, slots=True)
class UnderWall:
    """Turns of waves by the sensor with a wall of `touches`, calibrated with five presses of a ball."""

    lab: Lab
    calibration: io.Calibration
    name: str = "turn under a lit wall, waves"

    def changes(self, seed: int, gains: Sequence[float]) -> Map:
        """Return the change of the brightness that each result states, %."""
        shapes = np.random.default_rng([seed, 77]).uniform((0.16, 2.2, 0.0), (0.24, 3.2, 1.5), (THINGS, 3))
        things = [
            scorer.waves(depth, pitch, turned, touches.REACH) for depth, pitch, turned in shapes.tolist()
        ]
        assert self.calibration.references is not None
        dark = np.nan_to_num(self.calibration.references.dark)
        stated = []
        for number, gain in enumerate(gains):
            take = 2 * len(gains) * seed + number
            turn = self.lab.turned(thing := things[number % THINGS], press_for(thing), 2000 + take)
            changed = in_other_light(turn, gain, dark, self.lab.noise, take)
            stated.append(_change_of(engine.reconstruct(changed, calibration=self.calibration)))
        return np.array(stated)


def _change_of(result: io.Result) -> float:
    """Return the mean change that a result states, %; NaN if it states none."""
    return math.nan if result.fitted.light_change is None else 100 * result.fitted.light_change[0]


def first_reported(changes: Map) -> int | None:
    """Return the number of results from which on a trend is reported; None if none is."""
    numbers = range(1, len(changes) + 1)
    return next((number for number in numbers if find_trend(changes[:number], "%") is not None), None)


def trends(folder: Path) -> Table:
    """Return how many series have a trend; rendered light is kept in a folder."""
    lab = replace(touches.LAB, cache=folder)
    calibration = touches.by_balls(lab, touches.references_of(lab))
    rows = []
    for sensor in (Registered(), UnderWall(lab, calibration)):
        loss = FALL / RECORDINGS
        fallen = [1 - loss * number for number in range(RESULTS)]
        falling = [sensor.changes(seed, fallen) for seed in range(SERIES)]
        steady = [sensor.changes(SERIES + seed, [1.0] * RESULTS) for seed in range(SERIES)]
        in_blocks = [np.concatenate([each[number::THINGS] for number in range(THINGS)]) for each in steady]
        for what, series in (
            (f"falls by {100 * loss:g} % each, objects in turn", falling),
            ("constant, objects in turn", steady),
            ("constant, one object after the other", in_blocks),
        ):
            numbers = sorted(number for changes in series if (number := first_reported(changes)) is not None)
            from_to = "" if not numbers else f"{numbers[0]} to {numbers[-1]}"
            expected = loss * np.arange(RESULTS) if series is falling else 0.0
            scatter = np.mean([np.nanstd(changes + 100 * expected) for changes in series])
            rows.append((sensor.name, what, f"{len(numbers)} of {len(series)}", from_to, f"{scatter:.2f}"))
    head = ("recordings", "gain", "series with a trend", "from the result", "scatter of the change, %")
    return Table(f"Trends of the brightness in {RESULTS} results", head, rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="How a lamp that ages is followed, and reported.")
    parser.add_argument("--only", default="gain,trends", help="tables to compute")
    parser.add_argument("--freeze", action="store_true", help="write the tables into the pages")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        tables: dict[str, Callable[[], tuple[str, str, Table]]] = {
            "gain": lambda: ("touches.md", "ageing", table(RECORDINGS)),
            "trends": lambda: ("sensor-health.md", "trends", trends(Path(folder))),
        }
        for name in options.only.split(","):
            page, part, found = tables[name]()
            print(found)
            if options.freeze:
                found.write_into(PAGES / page, part)


if __name__ == "__main__":
    main()
