"""Small presses of a ball under the twin's lit wall, for tests of the zenith's calibration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.evaluation.calibration.scenes import Frames, Thing
from mirrorskin.evaluation.calibration.scorer import ball
from mirrorskin.io import WallResponse
from mirrorskin.kernels.rotation.response import shade_terms, sight_slopes, wall_light
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE, PIXEL = (48, 48), 0.25
DIAMETER, PRESS = 4.0, 0.9
FIVE = ((0.2, 0.1), (-3.6, -3.4), (3.5, -3.6), (-3.4, 3.6), (3.6, 3.3))
BODY = Body(asymmetry=0.05, asymmetry_azimuth=1.0)
DISTANCE = 150.0


def wall_presses() -> list[Frames]:
    """Return axial recordings of a ball at five places, with exact references and noise of one count."""
    return [_press(place, number) for number, place in enumerate(FIVE, 1)]


def light_of_response(response: WallResponse, place: Any, z: float, normals: Any) -> tuple[Any, Any]:
    """Return light and whether it is in reach, (N, n), of pixels at places, (2, n); normals are (N, n, 3)."""
    at = place - np.reshape(response.axis, (2, 1))
    geometry = response.radius, response.rim, response.scatter
    points = np.stack([*at, np.full(at.shape[1], z), *sight_slopes(at, response.sight)])
    normals = np.broadcast_to(normals, (len(normals), at.shape[1], 3))
    light, within = wall_light(points, normals, geometry, response.lamps, response.curve, response.reach)
    return light * (1 + response.shade @ shade_terms(*at / response.radius)), within


def _press(place: tuple[float, float], number: int) -> Frames:
    phase = np.arange(8) * np.pi / 4
    twin = Twin(
        object=Thing(ball(DIAMETER, place)),
        shape=SHAPE,
        pixel_size=PIXEL,
        movement=Axial(phase, math.radians(2.5), PRESS),
        optics="cylinder",
        pattern="linear",
        body=BODY,
        camera=Camera(noise=1.0, seed=number, distance=DISTANCE),
        references="exact",
    )
    frames: NDArray[Any] = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    return Frames(frames, twin.header, f"place-{number}", phase=phase)
