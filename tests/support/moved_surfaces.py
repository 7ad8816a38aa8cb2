"""Surfaces of known form, moved as rigid bodies, as maps with noise; and errors of the found poses.

It shares no code with mirrorskin but the type of a result. Float64; millimetres and radians.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose import Pose
from mirrorskin.io import Result, pixel_axes

Map = NDArray[np.float64]
Form = Callable[[Map, Map], tuple[Map, Map, Map]]
"""Height, and its slopes along x and y."""

RADIUS = 5.0


def bumpy(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """A dome with waves in it, which no motion leaves as it is."""
    first, two = 1.5 * x + 0.3, 2.1 * y + x
    height = -0.05 * (x * x + 0.7 * y * y + 0.3 * x * y) + 0.05 * np.sin(first) * np.cos(1.2 * y)
    dz_dx = -0.05 * (2 * x + 0.3 * y) + 0.075 * np.cos(first) * np.cos(1.2 * y) + 0.03 * np.cos(two)
    dz_dy = -0.05 * (1.4 * y + 0.3 * x) - 0.06 * np.sin(first) * np.sin(1.2 * y) + 0.063 * np.cos(two)
    return height + 0.03 * np.sin(two), dz_dx, dz_dy


def ball(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """A ball, its top in the origin."""
    z = np.sqrt(np.maximum(RADIUS**2 - x * x - y * y, 0.01))
    return z - RADIUS, -x / z, -y / z


def rod(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """A cylinder along y."""
    z = np.sqrt(np.maximum(RADIUS**2 - x * x, 0.01))
    return z - RADIUS, -x / z, 0 * y


def plane(x: Map, y: Map) -> tuple[Map, Map, Map]:
    """A plane that leans a little."""
    return 0.05 * x, 0 * x + 0.05, 0 * y


def sampled(
    form: Form,
    vector: tuple[float, ...] | Map = (0, 0, 0),
    shift: tuple[float, ...] | Map = (0, 0, 0),
    *,
    rng: np.random.Generator,
    shape: tuple[int, int] = (60, 80),
    pixel: float = 0.05,
    height_sigma: float = 1e-3,
    normals_sigma: float = 0.01,
) -> Result:
    """Return maps of a moved surface, with noise of the sigmas that they name."""
    x, y = pixel_axes(shape, (pixel, pixel))
    place = np.stack([*np.meshgrid(x, y), np.zeros(shape)], axis=-1)
    turn = Rotation.from_rotvec(vector).as_matrix()
    for _ in range(30):  # Newton's steps along z
        local = (place - np.asarray(shift)) @ turn
        height, dz_dx, dz_dy = form(local[..., 0], local[..., 1])
        upright = np.dstack([-dz_dx, -dz_dy, np.ones(shape)]) @ turn.T
        step = (local[..., 2] - height) / upright[..., 2]
        place[..., 2] -= step
        if np.abs(step).max() < 1e-9:
            break
    normals = upright + normals_sigma / np.sqrt(2) * across(upright, rng)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Result(
        height=(place[..., 2] + rng.normal(0, height_sigma, shape)).astype(np.float32),
        height_sigma=np.full(shape, height_sigma, np.float32),
        normals=normals.astype(np.float32),
        normals_sigma=np.full(shape, normals_sigma, np.float32),
        x=x,
        y=y,
    )


def across(vectors: Map, rng: np.random.Generator) -> Map:
    """Return normal random vectors at right angles to others, in units of their length."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit = vectors / length
    random = rng.normal(size=vectors.shape)
    return np.asarray(length * (random - unit * np.sum(random * unit, axis=-1, keepdims=True)))


def error_of(pose: Pose, vector: Map, shift: Map) -> Map:
    """Return the small rotation and translation, (6,), that lead from a pose to the true one."""
    rest = Rotation.from_rotvec(vector) * Rotation.from_rotvec(pose.rotation).inv()
    return np.concatenate([rest.as_rotvec(), shift - rest.apply(pose.translation)])


def error_at(pose: Pose, point: Map, expected: Map, ways: Map) -> float:
    """Return chi square of where a point comes to, for each of some ways (k, 3)."""
    x, y, z = moved = pose.apply(point)
    change = ways @ np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])
    error = ways @ (expected - moved)
    return float(error @ np.linalg.solve(change @ pose.covariance @ change.T, error)) / len(ways)
