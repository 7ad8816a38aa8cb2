"""The twin's pictures of balls and flats with any inclination of the body, not only along a circle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from poses import rotation_y, rotation_z

from mirrorskin.twin import Axial, Body, Camera, Twin
from mirrorskin.twin.movement import Pose

Map = NDArray[np.float64]

EIGHTHS = np.arange(8) * np.pi / 4


@dataclass(frozen=True)
class Ball:
    """A ball anywhere under the sheet, millimetres; its top touches the sheet at travel 0."""

    ball: float
    x: float = 0.0
    y: float = 0.0
    name: str = "ball"

    @property
    def radius(self) -> float:
        return self.ball + math.hypot(self.x, self.y)

    def height(self, x: Map, y: Map) -> Map:
        square = self.ball**2 - (x - self.x) ** 2 - (y - self.y) ** 2
        return np.sqrt(np.where(square > 0, square, np.nan)) - self.ball

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        rise = self.height(x, y) + self.ball
        return -(x - self.x) / rise, -(y - self.y) / rise


@dataclass(frozen=True)
class Flat:
    """A plate of a zenith and azimuth, radians, that the whole field lies on: its edge is far outside."""

    zenith: float = 0.0
    azimuth: float = 0.0
    radius: float = 15.0
    name: str = "flat"

    def height(self, x: Map, y: Map) -> Map:
        return np.asarray(-math.tan(self.zenith) * (self.radius + self._along(x, y)))

    def slope(self, x: Map, y: Map) -> tuple[Map, Map]:
        steep = np.full(np.shape(x), -math.tan(self.zenith))
        return steep * math.cos(self.azimuth), steep * math.sin(self.azimuth)

    def _along(self, x: Map, y: Map) -> Map:
        return np.asarray(x * math.cos(self.azimuth) + y * math.sin(self.azimuth))


def circle(tilt: float, phase: ArrayLike = EIGHTHS) -> Map:
    """Return the leans of a precession, (T, 2), radians."""
    phase = np.asarray(phase, float)
    return tilt * np.stack([np.cos(phase), np.sin(phase)], axis=1)


def pictures(
    thing: Any,
    lean: Map,
    press: float,
    pivot: ArrayLike,
    *,
    shape: tuple[int, int] = (120, 120),
    pixel_size: float = 0.1,
    seed: int = 1,
    body: Body | None = None,
    camera: Camera | None = None,
    **options: Any,
) -> NDArray[Any]:
    """Render a frame for each lean, (T, H, W)."""
    camera = camera or Camera(noise=1.5, seed=seed)
    bound = Axial([0.0], max(1e-3, float(np.hypot(*lean.T).max())), press, tuple(np.asarray(pivot, float)))
    twin = Twin(
        object=thing, shape=shape, pixel_size=pixel_size, movement=bound, body=body, camera=camera, **options
    )
    frames = np.empty((len(lean), *shape), twin.dtype)
    for number, (pose, frame) in enumerate(zip(poses(lean, press, pivot), frames, strict=True)):
        twin.look(lambda _, pose=pose: pose, number, frame)
    return frames


def poses(lean: Map, press: float, pivot: ArrayLike) -> list[Pose]:
    """Lower the body, then let it lean about its pivot."""
    centre, presses = np.asarray(pivot, float), []
    for x, y in lean:
        azimuth = math.atan2(y, x)
        turn = rotation_z(azimuth) @ rotation_y(math.hypot(x, y)) @ rotation_z(-azimuth)
        presses.append(Pose(turn, turn @ (np.array([0.0, 0.0, press]) - centre) + centre))
    return presses
