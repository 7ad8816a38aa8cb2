"""A sensor for touches of the wavy surface, by a camera with a fault; it shares nothing with the twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.evaluation.faults.camera import POINTS, Fault, Floats, points, record
from mirrorskin.evaluation.faults.estimators import PIXEL, STEEPEST, TILT, Surface, normals_of, zenith_scale
from mirrorskin.evaluation.faults.judge import Answer, watched
from mirrorskin.io.base.types import Header

Heights = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]
"""Return heights, and how they change along x and y, mm."""

_SIGMA = 0.004  # mm: the request
_DEEPEST = 1.1  # mm
_FRAMES = 24  # over which a drift is complete
_STEP = 0.05  # mm: of which a jitter of the travel is a share
_TURN_STEP = np.pi / 4  # of which a jitter of the phase is a share
_ITERATIONS = 4  # of the point that a pixel shows


class FaultySensor:
    """A surface under a skin whose wall is lit in proportion to the zenith; the body leans about (0, 0, 0).

    Points of the object move in the picture as the body leans. Each frame is taken at rest, so a rolling
    shutter has no effect, and a lost frame is replaced by the next one; a repeated one shows the place
    before.
    """

    name, start, deepest, search = "wavy surface", -0.6, _DEEPEST, 0.2

    def __init__(self, heights: Heights, shape: tuple[int, int], fault: Fault, seed: int) -> None:
        self._heights, self._fault, self._seed = heights, replace(fault, dropped=False), seed
        self.shape, self.dtype = shape, np.dtype(np.uint8 if fault.bits == 8 else np.uint16)
        self.header = Header(
            motion="axial", pixel_size=(PIXEL, PIXEL), tilt=TILT, pivot=(0.0, 0.0, 0.0), **zenith_scale(fault)
        )
        self._taken: list[NDArray[Any]] = []

    def take(self, travel: float, tilt: float = 0.0, phase: float = 0.0, /) -> NDArray[Any]:
        """Return a frame at a travel, mm, and a lean, radians."""
        number, fault = len(self._taken), self._fault
        fault = replace(
            fault, drift=0.0, duplicated=False, offset=fault.offset + fault.drift * min(1.0, number / _FRAMES)
        )
        if tilt:
            light, place, step = lambda at: self._light(travel, tilt, at), phase, _TURN_STEP
        else:
            light, place, step = lambda at: self._light(at, 0.0, 0.0), travel, _STEP
        # Of two frames, because jitter is a share of their distance; compression takes them together.
        frame = record(light, np.array([place, place + step]), fault, self._seed + number)[0]
        repeated = self._fault.duplicated and number == _FRAMES // 2
        self._taken.append(self._taken[-1] if repeated else frame)
        return self._taken[-1].copy()

    def _light(self, travel: Any, tilt: float, phase: Any) -> Floats:
        """Return the light at all points: the zenith in the frame of the body, where the skin is touched."""
        travel, phase = float(np.ravel(travel)[0]), float(np.ravel(phase)[0])
        x, y = np.broadcast_arrays(*points(self.shape, PIXEL))
        along, up = x, y
        for _ in range(_ITERATIONS if tilt else 0):  # the point that moves to (x, y)
            lift = np.sin(tilt) * (self._heights(along, up)[0] + travel)
            aside = (1 - np.cos(tilt)) * (along * np.cos(phase) + up * np.sin(phase))
            along, up = x - (lift - aside) * np.cos(phase), y - (lift - aside) * np.sin(phase)
        surface = np.stack(self._heights(along, up))
        normal = normals_of(surface)
        lean = np.sin(tilt) * (normal[..., 0] * np.cos(phase) + normal[..., 1] * np.sin(phase))
        zenith = np.arccos(np.clip(normal[..., 2] * np.cos(tilt) - lean, -1, 1))
        width = (np.abs(surface[1]) + np.abs(surface[2])) * PIXEL / POINTS + 1e-9
        touched = np.clip((travel + surface[0]) / width + 0.5, 0, 1)
        return np.asarray(touched * zenith / STEEPEST)[np.newaxis]

    def lift(self) -> None:
        """Do nothing: the body needs no way."""

    def expose(self, ratio: float, /) -> None:
        """Multiply the exposure."""
        self._fault = replace(self._fault, exposure=ratio * self._fault.exposure)
        self.header = replace(self.header, **zenith_scale(self._fault))

    def now(self) -> float:
        """Return a second for each frame."""
        return float(len(self._taken))


def of_touch(heights: Heights) -> Callable[[Surface, Fault, int], Answer]:
    """Return the heights of a touch."""

    def answer(surface: Surface, fault: Fault, seed: int) -> Answer:
        sensor = FaultySensor(heights, surface.shape, fault, 1000 * seed)
        outcome: list[Any] = []

        def compute() -> Any:
            outcome.append(engine.live.touch(sensor, _SIGMA))
            return outcome[0].result

        result, warned, notes = watched(compute)
        _, _, doubts = outcome[0].reason.partition("; ")  # after why it ended
        told = "; ".join(text for text in (warned, doubts) if text)
        return Answer(result.height - surface.height, result.height_sigma, told, notes)

    return answer
