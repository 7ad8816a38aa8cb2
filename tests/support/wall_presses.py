"""Small presses of a ball under the twin's lit wall, for tests of the zenith's calibration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from calibration_scenes import Frames, Thing
from calibration_scorer import ball
from numpy.typing import NDArray

from mirrorskin import hw

SHAPE, PIXEL = (48, 48), 0.25
DIAMETER, PRESS = 4.0, 0.9
FIVE = ((0.2, 0.1), (-3.6, -3.4), (3.5, -3.6), (-3.4, 3.6), (3.6, 3.3))
BODY = hw.twin.Body(asymmetry=0.05, asymmetry_azimuth=1.0)
DISTANCE = 150.0


def wall_presses() -> list[Frames]:
    """Return axial recordings of a ball at five places, with exact references and noise of one count."""
    return [_press(place, number) for number, place in enumerate(FIVE, 1)]


def _press(place: tuple[float, float], number: int) -> Frames:
    phase = np.arange(8) * np.pi / 4
    twin = hw.Twin(
        object=Thing(ball(DIAMETER, place)),
        shape=SHAPE,
        pixel_size=PIXEL,
        movement=hw.twin.Axial(phase, math.radians(2.5), PRESS),
        optics="cylinder",
        pattern="linear",
        body=BODY,
        camera=hw.twin.Camera(noise=1.0, seed=number, distance=DISTANCE),
        references="exact",
    )
    frames: NDArray[Any] = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    return Frames(f"place-{number}", frames, twin.header, phase=phase)
