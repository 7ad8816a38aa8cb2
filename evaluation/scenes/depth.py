"""Analytic objects that hide parts of themselves: normals, mask and true heights.

Each object is a height over the plane of the picture, viewed along z by parallel rays; if several overlap,
the highest is visible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.evaluation.scenes.inputs import Shape

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
Surface = Callable[[Map, Map], Map]
"""Function from x and y to heights, mm; NaN outside the object."""

SPAN = 100.0  # length of the picture's shorter side, mm
NOISE = 1.0  # standard deviation of a normal in each direction, degrees

_STEP = 1e-5  # step of the difference quotients for slopes, mm
_GRAZING = 0.05  # smallest z component of a normal, as in photometric stereo
_FACING = 0.2  # the same of both surfaces at a seam that determines their relative height


class Scene(NamedTuple):
    """The visible surfaces, and their true heights.

    Normals, (H, W, 3), have x to the right, y up the picture and z towards the viewer; NaN outside the mask.
    `piece` is the number of the connected surface, -1 outside. The relative height of two pieces is
    undetermined.
    """

    normals: Map
    mask: Mask
    height: Map
    piece: NDArray[np.int32]
    pixel_size: float

    def error(self, height: NDArray[np.floating[Any]]) -> float:
        """Return the mean absolute error, mm, after the best offset of each piece."""
        total, (measured, true, piece) = (
            0.0,
            (values[self.mask] for values in (height, self.height, self.piece)),
        )
        order = np.argsort(piece, kind="stable")
        for mine in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):
            error = true[mine] - measured[mine].astype(float)
            total += float(np.abs(error - np.median(error)).sum())
        return total / len(piece)


def see(shape: Shape, surfaces: Sequence[Surface], noise: float = 0.0, *, ragged: bool = False) -> Scene:
    """Return the scene of surfaces; `ragged` removes patches of the mask along its border."""
    rows, columns = shape
    pixel = SPAN / min(shape)
    x, y = np.meshgrid(
        (np.arange(columns) - (columns - 1) / 2) * pixel, ((rows - 1) / 2 - np.arange(rows)) * pixel
    )
    with np.errstate(invalid="ignore"):
        heights = np.stack([np.nan_to_num(surface(x, y), nan=-np.inf) for surface in surfaces])
        number = heights.argmax(axis=0)
        slopes = np.zeros((2, *shape))
        for count, surface in enumerate(surfaces):
            for slope, (right, up) in zip(slopes, ((_STEP, 0), (0, _STEP)), strict=True):
                rise = surface(x + right, y + up) - surface(x - right, y - up)
                np.copyto(slope, rise / (2 * _STEP), where=number == count)
    height = heights.max(axis=0)
    mask = np.isfinite(height)
    mask = _tear(mask) if ragged else mask
    number = np.where(mask, number, -1)
    slopes = np.nan_to_num(np.where(mask, slopes, 0), nan=1 / _GRAZING)  # at a rim
    normals = _limit(np.stack([*-slopes, np.ones(shape)]))
    piece = _pieces(np.where(mask, height, 0), normals, number, pixel)
    if noise:
        normals += np.radians(noise) * np.random.default_rng(0).standard_normal(normals.shape)
        normals = _limit(normals)
    normals = np.moveaxis(np.where(mask, normals, np.nan), 0, -1)
    return Scene(normals, mask, np.where(mask, height, np.nan), piece, pixel)


def _limit(normals: Map) -> Map:
    """Return unit normals whose z component is at least the smallest that is measured."""
    normals = normals / np.linalg.norm(normals, axis=0)
    normals[2] = np.maximum(normals[2], _GRAZING)
    return np.asarray(normals / np.linalg.norm(normals, axis=0))


def _tear(mask: Mask) -> Mask:
    """Return a mask without some patches along its border."""
    import cv2

    width = max(3, min(mask.shape) // 32)
    border = cv2.blur(mask.astype(np.float32), (width, width), borderType=cv2.BORDER_CONSTANT) < 0.99
    noise = np.random.default_rng(1).standard_normal(mask.shape, np.float32)
    return np.asarray(mask & ~(border & (cv2.GaussianBlur(noise, (0, 0), width / 6) > 0)))


def _pieces(height: Map, normals: Map, number: NDArray[np.int_], pixel: float) -> NDArray[np.int32]:
    """Return the number of the connected surface of each pixel; surfaces that meet at a visible seam are one.

    At a seam, the rise from a pixel to the next is between the rises computed from the slopes of both.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    place = np.arange(height.size).reshape(height.shape)
    ends: list[Map] = []
    for axis, sign in ((1, -1.0), (0, 1.0)):
        here, beyond = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        rise = sign * normals[1 - axis] / normals[2] * pixel
        gap = height[beyond] - height[here]
        low, high = np.minimum(rise[here], rise[beyond]), np.maximum(rise[here], rise[beyond])
        slack = 0.1 * np.maximum(high - low, pixel)
        facing = np.minimum(normals[2][here], normals[2][beyond]) > _FACING
        seam = (gap > low - slack) & (gap < high + slack) & facing
        seam &= (number[here] >= 0) & (number[beyond] >= 0)
        linked = (number[here] == number[beyond]) | seam
        ends.append(np.stack([place[here][linked], place[beyond][linked]]))
    first, second = np.concatenate(ends, axis=1)
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), (height.size,) * 2)
    _, label = connected_components(graph, directed=False)
    piece = np.full(height.size, -1, np.int32)
    piece[number.ravel() >= 0] = np.unique(label[number.ravel() >= 0], return_inverse=True)[1]
    return piece.reshape(height.shape)


def plane(along: float, up: float) -> Surface:
    """Return a plane through the origin with slopes along x and y."""
    return lambda x, y: along * x + up * y


def ellipsoid(centre: Sequence[float], radii: Sequence[float], axes: Map) -> Surface:
    """Return the visible half of an ellipsoid with the given axes, (3, 3)."""
    form = axes @ np.diag(1 / np.square(radii)) @ axes.T

    def surface(x: Map, y: Map) -> Map:
        u, v = x - centre[0], y - centre[1]
        half = form[0, 2] * u + form[1, 2] * v
        rest = form[0, 0] * u * u + 2 * form[0, 1] * u * v + form[1, 1] * v * v - 1
        return np.asarray(centre[2] + (np.sqrt(half**2 - form[2, 2] * rest) - half) / form[2, 2])

    return surface


def ball(shape: Shape) -> Scene:
    """Return a ball in front of an inclined wall, which it does not touch."""
    return see(shape, [plane(0.2, -0.1), ellipsoid((5, -3, 45), (28, 28, 28), np.eye(3))])


def torus(shape: Shape) -> Scene:
    """Return an inclined ring, half embedded in a ground, so that one side is above it."""

    def ring(x: Map, y: Map) -> Map:
        return np.asarray(3 + 0.35 * x + np.sqrt(11**2 - (np.hypot(x, y) - 28) ** 2))

    return see(shape, [plane(0.0, 0.1), ring])


def stairs(shape: Shape) -> Scene:
    """Return five inclined steps on a floor: each ends in cliffs on three sides and in a seam on one."""

    def step(number: int, x: Map, y: Map) -> Map:
        inside = (np.abs(x) < 30 - 3 * number) & (y > 9 * number - 30) & (y < 9 * number - 12)
        return np.where(inside, 5.0 * number + 0.3 * (y + 30 - 9 * number) + 0.1 * x, np.nan)

    return see(shape, [plane(0.05, 0.0), *(partial(step, number) for number in range(1, 6))])


def leaves(shape: Shape) -> Scene:
    """Return leaves at random angles, which hide the ground and each other."""
    generator = np.random.default_rng(3)

    def leaf(numbers: Map, x: Map, y: Map) -> Map:
        wide, long, rise, azimuth, from_left, low = numbers
        cosine, sine = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
        u, v = cosine * (x - from_left) + sine * (y - low), cosine * (y - low) - sine * (x - from_left)
        height = 2 + np.tan(np.radians(rise)) * v - 0.03 * u * u - 0.012 * v * v
        return np.where((u / wide) ** 2 + (v / long - 1) ** 2 < 1, height, np.nan)

    surfaces = [plane(0.1, 0.05)]
    for place in (np.indices((5, 5)).reshape(2, -1).T - 2) * 19.0:
        numbers = generator.uniform((5, 9, 25, 0, -4, -4), (8, 13, 50, 360, 4, 4))
        surfaces.append(partial(leaf, numbers + np.array([0, 0, 0, 0, *place])))
    return see(shape, surfaces)


def folds(shape: Shape, noise: float = NOISE) -> Scene:
    """Return layers of folded cloth over a body, which end in cliffs or meet in seams; noisy, torn."""

    def layer(number: int, x: Map, y: Map) -> Map:
        turn, phase = 0.5 * number, 1.3 * number
        height = 20 - x**2 / 90 - y**2 / 120
        height += 2.5 * np.sin(0.28 * (x * np.cos(turn) + y * np.sin(turn)) + phase)
        height += 3 * np.sin(0.16 * (y - 0.3 * x) + 2 * phase) + 4.0 * number * np.sin(x / 16 + phase)
        body = 1 - (x / 38) ** 2 - (y / 45) ** 2
        hem = 60 - 22 * number - y + 6 * np.sin(x / 9 + phase) if number else body
        return np.where(np.minimum(body, hem) >= 0, height, np.nan)

    return see(shape, [partial(layer, number) for number in range(4)], noise, ragged=True)


def heap(number: int, shape: Shape) -> Scene:
    """Return a random heap of ellipsoids, with or without a ground; noisy and torn if ``number`` is odd."""
    generator = np.random.default_rng(number)
    surfaces: list[Surface] = [plane(*generator.uniform(-0.3, 0.3, 2))] if number % 3 else []
    for _ in range(generator.integers(8, 20)):
        centre, radii = generator.uniform((-38, -38, -5), (38, 38, 30)), generator.uniform(6, 22, 3)
        axes = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        surfaces.append(ellipsoid([*centre], [*radii], axes))
    return see(shape, surfaces, NOISE if number % 2 else 0.0, ragged=bool(number % 2))


SCENES: dict[str, Callable[..., Scene]] = {
    scene.__name__: scene for scene in (ball, torus, stairs, leaves, folds)
}
HELD_OUT: dict[str, Callable[..., Scene]] = {f"heap {k}": partial(heap, k) for k in range(10)}
"""Held-out heaps: only the weight of the plain surface in robust integration was chosen on them."""
