"""The ball of 10 mm for fusion: what a press and a turn tell of it, at best and on the twin; its judge."""

from __future__ import annotations

from typing import NamedTuple

import geometry
import numpy as np
import rotations
from geometry import SPHERE_RADIUS
from numpy.typing import NDArray
from rotations import EIGHTHS, SETUPS, TILT
from scipy import optimize
from stacks import ball

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]

LIT = 11.8, 45.0  # zenith in degrees of what turns light
DEEP = 57.0  # as far as the sheet lies on the ball


class Press(NamedTuple):
    """What fusion needs of an onset."""

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]


class Turn(NamedTuple):
    """What fusion needs of normals."""

    vectors: NDArray[np.float32]
    sigma: NDArray[np.float32]
    contact: NDArray[np.uint8]


class Verdict(NamedTuple):
    """Errors in mm, within a zenith, and of the cap within 5 degrees of the apex."""

    rms: float
    apex: float
    radius: float  # of the ball that fits best
    answered: float  # share of the pixels


def within(zenith: float, shape: tuple[int, int], pixel: float) -> Mask:
    """Return where the ball's zenith is at most so many degrees."""
    steepest = geometry.sphere(shape, pixel).zenith
    return np.asarray(np.nan_to_num(steepest, nan=np.pi) <= np.radians(zenith))


def pressed(step: float, shape: tuple[int, int], pixel: float) -> Press:
    """Return the middle of the step in which each pixel was touched that turns light."""
    lit = within(LIT[1], shape, pixel) & ~within(LIT[0], shape, pixel)
    height = (np.floor(geometry.sphere(shape, pixel).height / step) + 0.5) * step
    sigma = np.where(lit, step / np.sqrt(12), np.nan)
    return Press(np.where(lit, height, np.nan).astype(np.float32), sigma.astype(np.float32))


def turned(name: str, shape: tuple[int, int], pixel: float, device: object = None, seed: int = 3) -> Turn:
    """Return the normals that the engine tells from frames of eq. 10."""
    from mirrorskin.engine import estimate_normals

    surface, setup = geometry.sphere(shape, pixel), SETUPS[name]
    there = within(DEEP, shape, pixel)
    normals = rotations.direction(np.where(there, surface.zenith, 0), np.nan_to_num(surface.azimuth))
    frames = rotations.expose(normals, setup, seed)
    known = {"phase": setup.phase, "tilt": setup.tilt, "gain": setup.slope, "offset": setup.offset}
    found = estimate_normals(frames, **known, noise=setup.spread, device=device)
    return Turn(found.vectors, found.sigma, (found.contact * there).astype(np.uint8))


def twins(shape, pixel, step, count, dtype="uint8", noise=1.0, press=1.25, pivot=(0.0, 0.0, 0.0)):
    """Return a press under a uniform wall, and a turn under one that is linear in zenith from 0 on."""
    from mirrorskin import hw

    vertical = ball(shape, pixel, step * np.arange(1, count + 1), noise=noise, seed=5)
    axial = hw.Twin(
        object="sphere",
        shape=shape,
        pixel_size=pixel,
        movement=hw.twin.Axial(EIGHTHS, TILT, press=press, pivot=pivot),
        pattern="linear",
        body=hw.twin.Body(height=1e5, scatter=0.0),
        camera=hw.twin.Camera(dtype=np.dtype(dtype), noise=noise, seed=6),
    )
    return vertical, axial


def judge(height: NDArray[np.floating], zenith: float, pixel: float) -> Verdict:
    """Compare a surface with the ball."""
    error = height - geometry.sphere(height.shape, pixel).height
    inside, top = (within(part, height.shape, pixel) for part in (zenith, 5.0))
    answered = inside & np.isfinite(error)
    return Verdict(
        _rms(error[answered]),
        _rms(error[top]),
        fitted_radius(height, answered, pixel),
        float(answered.sum() / inside.sum()),
    )


def fitted_radius(height: NDArray[np.floating], where: Mask, pixel: float) -> float:
    """Fit a ball by least squares of the distances from its surface."""
    x, y = geometry.pixel_centres(height.shape, pixel)
    points = np.stack([x[where], y[where], height[where].astype(float)])

    def distance(centre_and_radius: Map) -> Map:
        centre = centre_and_radius[:3, np.newaxis]
        return np.asarray(np.linalg.norm(points - centre, axis=0) - centre_and_radius[3])

    start = np.array([0.1, 0.1, 0.9 - SPHERE_RADIUS, SPHERE_RADIUS - 1])
    return float(optimize.least_squares(distance, start).x[3])


def _rms(error: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(error.astype(float) ** 2)))
