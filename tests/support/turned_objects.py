"""Results of rotations of the twin on objects that were moved on the table."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from mirrorskin import engine, io
from mirrorskin.io.base.types import Floats
from mirrorskin.twin import Axial, Camera, Twin
from mirrorskin.twin.objects import Object


@dataclass(frozen=True)
class Moved:
    """An object that was shifted (mm), and turned about z (radians)."""

    thing: Object
    shift: tuple[float, float]
    angle: float

    @property
    def name(self) -> str:
        return f"moved {self.thing.name}"

    @property
    def radius(self) -> float:
        return self.thing.radius + math.hypot(*self.shift)

    def height(self, x: Floats, y: Floats) -> Floats:
        return self.thing.height(*self._back(x - self.shift[0], y - self.shift[1], self.angle))

    def slope(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        slopes = self.thing.slope(*self._back(x - self.shift[0], y - self.shift[1], self.angle))
        return self._back(*slopes, -self.angle)

    def _back(self, x: Floats, y: Floats, angle: float) -> tuple[Floats, Floats]:
        return (
            math.cos(angle) * x + math.sin(angle) * y,
            math.cos(angle) * y - math.sin(angle) * x,
        )


@functools.cache
def turned(thing: Object, seed: int, size: int = 128, pixel: float = 0.07) -> tuple[io.Result, float]:
    """Return a result, and how much higher its heights are than the true ones."""
    twin = Twin(
        object=thing,
        shape=(size, size),
        pixel_size=pixel,
        movement=Axial(io.Steps(math.pi / 4).positions(8), math.radians(2.5), 1.5),
        pattern="linear",
        camera=Camera(
            noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5, seed=seed
        ),
    )
    result = engine.reconstruct(twin, heights=twin.truth.height)
    assert result.height is not None
    return result, float(np.nanmean(result.height - twin.truth.height))
