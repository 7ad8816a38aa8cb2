"""Every built-in operation, with suitable frames, positions and options."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from bare import Parts
from live_frames import phases, press_frames, turn_frames
from numpy.typing import NDArray
from speckle import Speckle
from stacks import MadeUp

from mirrorskin import engine
from mirrorskin.engine.optical.fringes import Fringes, fit_fringes
from mirrorskin.engine.optical.photometric import PhotometricStereo, photometric_stereo
from mirrorskin.engine.press.levels import Levels
from mirrorskin.engine.rotation.last_turn import LastTurn
from mirrorskin.engine.vibration.growth import Growth
from mirrorskin.evaluation.scenes.inputs import SCALES, TILT
from mirrorskin.io import Header, Result
from mirrorskin.io.base.types import body_axes

COUNT, SHAPE, PIXEL = 48, (23, 31), 0.05
TRAVEL = np.linspace(0, 1.2, COUNT)
STROKES = 0.6 - 0.6 * np.cos(0.3 * np.arange(COUNT))
DITHER = 0.6 + 0.03 * np.cos(0.7 * np.arange(COUNT))
PRESS = press_frames((COUNT, *SHAPE))
PHASE = phases(COUNT)
TURNS = turn_frames((COUNT, *SHAPE))
OFFSET, GAIN, NOISE = SCALES["uint8"]
SENSOR = {"zenith_gain": GAIN, "zenith_offset": OFFSET}
LEAN = 0.05 * np.sin(0.8 * np.arange(COUNT))
ROCKED = np.clip(120 + 400 * LEAN[:, None, None] + np.zeros(SHAPE), 0, 255).astype(np.uint8)
SLIDE = np.arange(12)[:, None] * [0.006, 0.003]
SKIN = np.stack([Speckle(3).frame((64, 72), -x / PIXEL, y / PIXEL, 1.0, k) for k, (x, y) in enumerate(SLIDE)])
LAMPS = np.stack([np.cos(PHASE), np.sin(PHASE), np.ones(len(PHASE))], axis=1)


def engine_classes() -> Iterator[type]:
    """Yield each class that a module of the engine defines; those of batches need Dask."""
    for module in pkgutil.walk_packages(engine.__path__, "mirrorskin.engine."):
        if not module.name.startswith("mirrorskin.engine.batch"):
            for value in vars(importlib.import_module(module.name)).values():
                if inspect.isclass(value) and value.__module__ == module.name:
                    yield value


class Readable(MadeUp):
    """A source that can be read again."""

    rewindable = True

    def rewind(self) -> None:
        """Go back to the first frame."""
        self.frames_read = 0


@dataclass(frozen=True)
class Case:
    """An operation, what it computes on, and the function on arrays that does the same."""

    kind: type[engine.Operation]
    frames: NDArray[Any]
    positions: Mapping[str, NDArray[np.float64]]
    options: Mapping[str, Any] = field(default_factory=dict)
    function: Callable[..., Any] | None = None
    motion: str = "vertical"
    header: Mapping[str, Any] = field(default_factory=dict)
    weights: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    @property
    def given(self) -> Mapping[str, NDArray[np.float64]]:
        """What is pushed with the frames."""
        return {**self.positions, **self.weights}

    def make(self, **options: Any) -> engine.Operation:
        """Return the operation."""
        return self.kind(**{**self.options, **options})

    def source(self) -> Readable:
        """Return the frames as a recording."""
        header = Header(self.motion, pixel_size=(PIXEL, PIXEL), **self.header)
        named = {"tilt": LEAN, "phase": 0 * LEAN} if "pose" in self.positions else self.positions
        return Readable(self.frames, header, time=0.01 * np.arange(len(self.frames)), **named)

    def loop(self, **options: Any) -> engine.Run:
        """Return a run whose frames are pushed."""
        return engine.Run(self.make(**options))

    def push(self, run: engine.Run, part: slice) -> None:
        """Push some of the frames."""
        where = {name: values[part] for name, values in self.given.items()}
        run.push(self.frames[part], **where)

    def whole(self, cuts: Sequence[int] = (), **options: Any) -> Result:
        """Return the result of all frames, which are read in parts that end at cuts."""
        operation = self.make(**options)
        source = Parts(self.frames, operation, self.given, cuts)
        return engine.Run(operation.plan(source), source).complete()


WEIGHTS = {"frame_weights": np.where(np.arange(COUNT) % 7 == 2, 0.0, 1 + 0.5 * np.cos(np.arange(COUNT)))}
ON_TRAVEL, ON_PHASE = {"travel": TRAVEL}, {"phase": PHASE}
LEVELS = {"dark": 20.0, "bright": 230.0}
ROTATION: dict[str, Any] = {"motion": "axial"}
CASES = {
    "Onset": Case(engine.Onset, PRESS, ON_TRAVEL, {"dark": 0, "bright": 255}, engine.find_onset),
    "Onset of a release": Case(
        engine.Onset, PRESS[::-1].copy(), {"travel": TRAVEL[::-1].copy()}, {"event": "release", **LEVELS},
        engine.find_onset,
    ),
    "Onset between estimated levels": Case(
        engine.Onset, PRESS, ON_TRAVEL, {**LEVELS, "dark_sigma": 1.0, "bright_sigma": 2.0}, engine.find_onset
    ),
    "Levels": Case(
        Levels, PRESS, ON_TRAVEL, {"thresholds": [0.3, 0.7], "inclinations": [0.2, 0.4], **LEVELS}
    ),
    "Strokes": Case(engine.press.Strokes, PRESS, {"travel": STROKES}, LEVELS),
    "ChangePoint": Case(engine.ChangePoint, PRESS, ON_TRAVEL, LEVELS, engine.find_change_point),
    "ChangePoint between unknown levels": Case(
        engine.ChangePoint, PRESS, ON_TRAVEL, function=engine.find_change_point
    ),
    "Growth": Case(Growth, PRESS, {"travel": DITHER}, LEVELS, engine.vibration.find_growth),
    "Focus": Case(engine.optical.Focus, PRESS, ON_TRAVEL, {"noise": 2.0}, engine.optical.find_focus),
    "Correlate": Case(engine.Correlate, TURNS, ON_PHASE, {}, engine.correlate, **ROTATION),
    "Correlate of a window": Case(
        engine.Correlate, TURNS, ON_PHASE, {"window_frames": 8}, engine.correlate, **ROTATION
    ),
    "Correlate with weights": Case(
        engine.Correlate, TURNS, ON_PHASE, {}, engine.correlate, weights=WEIGHTS, **ROTATION
    ),
    "Normals": Case(
        engine.Normals, TURNS, ON_PHASE, {"tilt": TILT, "noise": NOISE, **SENSOR}, engine.estimate_normals,
        **ROTATION,
    ),
    "Normals of each turn": Case(
        engine.Normals, TURNS, ON_PHASE, {"tilt": "estimate", "per_turn": True, **SENSOR}, **ROTATION
    ),
    "Normals with weights": Case(
        engine.Normals, TURNS, ON_PHASE, {"tilt": TILT, **SENSOR}, weights=WEIGHTS, **ROTATION
    ),
    "Normals of a window": Case(
        engine.Normals, TURNS, ON_PHASE, {"tilt": "estimate", "window_frames": 8, **SENSOR}, **ROTATION
    ),
    "LastTurn": Case(
        LastTurn, TURNS, ON_PHASE, {"tilt": TILT, "window_frames": 8, **SENSOR}, **ROTATION
    ),
    "MovingNormals": Case(
        engine.rotation.MovingNormals, ROCKED, {"pose": body_axes(0 * LEAN, LEAN)},
        {"zenith_gain": 400.0, "noise": 1.0}, **ROTATION,
    ),
    "Slip": Case(
        engine.slip.SlipOnset, SKIN, {"displacement": SLIDE},
        {"pixel_size": PIXEL, "contact": np.ones(SKIN.shape[1:])}, motion="horizontal",
    ),
    "Slip of each frame": Case(
        engine.slip.SlipOnset, SKIN, {"displacement": SLIDE},
        {"pixel_size": PIXEL, "contact": np.ones(SKIN.shape[1:]), "per_frame": True}, motion="horizontal",
    ),
    "Fringes": Case(Fringes, TURNS, ON_PHASE, {}, fit_fringes, **ROTATION),
    "Fringes with weights": Case(
        Fringes, TURNS, ON_PHASE, {"noise": 1.0}, fit_fringes, weights=WEIGHTS, **ROTATION
    ),
    "PhotometricStereo": Case(
        PhotometricStereo, TURNS, {}, {"light": LAMPS}, photometric_stereo, **ROTATION
    ),
}  # fmt: skip
CUTS = {
    "one by one": lambda count: [slice(k, k + 1) for k in range(count)],
    "unevenly": lambda count: [slice(*ends) for ends in pairwise((0, 1, 4, 5, count - 1, count))],
    "in halves": lambda count: [slice(0, count // 2), slice(count // 2, count)],
}


def assert_same(actual: Result, expected: Result) -> None:
    """Hold maps and numbers equal bit by bit."""
    assert list(actual) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(actual[name], values, err_msg=name, strict=True)
    numbers = {name: value for name, value in expected.process.items() if isinstance(value, float)}
    assert {name: actual.process[name] for name in numbers} == pytest.approx(numbers, nan_ok=True, rel=0)
