"""Figures of overlapping bodies, seen along parallel rays or by a pinhole camera, by formula.

A figure is the union of implicit bodies: functions of the place that are negative inside. Rays are followed
to the first place where the function is 0; its gradient is the normal. Bodies hide each other, so the depth
has steps; they touch in creases, or are joined smoothly. Errors of normals are added afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, shift

from mirrorskin.engine.integration import Camera
from mirrorskin.io import Result

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
Body = Callable[[Map], Map]
"""Places (..., 3) to a number that is 0 on the surface, negative inside and no larger than the distance."""

SPAN = 100.0  # of the picture's shorter side, mm
FAR = 500.0  # from the pinhole to the middle of a figure, mm
_STEPS, _CLOSE, _HIT = 160, 1e-6, 1e-3  # most steps along a ray; distances that end it, and that count, mm
_STEP = 1e-4  # of the difference quotients for normals, mm
_GRAZING = 0.02  # smallest cosine between a normal and its ray that is measured


class Figure(NamedTuple):
    """What is seen: normals (H, W, 3), the mask, and the true height, or depth with a camera, mm."""

    normals: Map
    mask: Mask
    truth: Map
    camera: Camera | None
    pixel_size: float

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `engine.integrate`."""
        size = {"camera": self.camera} if self.camera else {"pixel_size": self.pixel_size}
        return {"normals": self.normals, "mask": self.mask, **size}

    def error(self, height: Map) -> float:
        """Return the mean error, mm, about the median of each part that is connected in the mask.

        With a camera, the depth of a part is scaled by the median instead, as normals do not determine it.
        """
        parts, count = label(self.mask)
        errors = []
        for number in range(1, count + 1):
            heights, true = height[parts == number].astype(float), self.truth[parts == number]
            error = heights * np.nanmedian(true / heights) - true if self.camera else heights - true
            errors.append(error if self.camera else error - np.nanmedian(error))
        return float(np.nanmean(np.abs(np.concatenate(errors))))

    def scores(self, result: Result) -> NDArray[np.float64]:
        """Return errors over standard deviations, about the mean of each component of a result.

        Between components, a result states that it does not know the height.
        """
        scores = []
        for number in range(int(result.component.max()) + 1):
            part = (result.component == number) & self.mask & np.isfinite(result.height)
            heights, true, sigma = (
                m[part].astype(float) for m in (result.height, self.truth, result.height_sigma)
            )
            if self.camera:
                scale = np.exp(np.mean(np.log(true / heights)))
                heights, sigma = scale * heights, scale * sigma
            error = heights - true
            if part.sum() > 1:
                scores.append((error - (0 if self.camera else np.mean(error))) / sigma)
        return np.concatenate(scores)


# --- Bodies --------------------------------------------------------------------------------------------


def ellipsoid(centre: Any, radii: Any, axes: Map | None = None) -> Body:
    """Return an ellipsoid with the given axes, (3, 3)."""
    centre, radii = np.asarray(centre, float), np.asarray(radii, float)

    def body(at: Map) -> Map:
        local = at - centre if axes is None else (at - centre) @ axes
        k0 = np.linalg.norm(local / radii, axis=-1)
        return np.asarray((k0 - 1) * radii.min())

    return body


def capsule(start: Any, end: Any, radius: float, end_radius: float | None = None) -> Body:
    """Return a rod with round ends; its radius may change along it."""
    start, along = np.asarray(start, float), np.asarray(end, float) - np.asarray(start, float)
    change = 0.0 if end_radius is None else end_radius - radius

    def body(at: Map) -> Map:
        fraction = np.clip((at - start) @ along / (along @ along), 0, 1)
        distance = np.linalg.norm(at - start - fraction[..., np.newaxis] * along, axis=-1)
        return np.asarray((distance - radius - change * fraction) * 0.9)

    return body


def ring(centre: Any, radius: float, thickness: float, axes: Map) -> Body:
    """Return a torus about the third of the axes, (3, 3)."""

    def body(at: Map) -> Map:
        local = (at - np.asarray(centre, float)) @ axes
        return np.asarray(
            np.hypot(np.hypot(local[..., 0], local[..., 1]) - radius, local[..., 2]) - thickness
        )

    return body


def box(centre: Any, half: Any, rounding: float, axes: Map) -> Body:
    """Return a box with round edges."""

    def body(at: Map) -> Map:
        over = np.abs((at - np.asarray(centre, float)) @ axes) - (np.asarray(half, float) - rounding)
        outside = np.linalg.norm(np.maximum(over, 0), axis=-1)
        return np.asarray(outside + np.minimum(over.max(axis=-1), 0) - rounding)

    return body


def ground(height: float, right: float = 0.0, up: float = 0.0) -> Body:
    """Return the half space below a leaning plane."""
    steep = math.sqrt(1 + right**2 + up**2)
    return lambda at: np.asarray((at[..., 2] - height - right * at[..., 0] - up * at[..., 1]) / steep)


def united(*bodies: Body) -> Body:
    """Return the union: bodies meet in creases."""
    return lambda at: np.minimum.reduce([body(at) for body in bodies])


def melted(reach: float, *bodies: Body) -> Body:
    """Return the union whose creases are rounded over a reach, mm."""

    def body(at: Map) -> Map:
        total = bodies[0](at)
        for body in bodies[1:]:
            other = body(at)
            near = np.maximum(reach - np.abs(total - other), 0) / reach
            total = np.minimum(total, other) - near**2 * reach / 4
        return total

    return body


def without(body: Body, hole: Body) -> Body:
    """Return a body with a hole."""
    return lambda at: np.maximum(body(at), -hole(at))


def wavy(body: Body, depth: float, length: float) -> Body:
    """Return a body with a texture: waves of a length along three directions."""
    k = 2 * math.pi / length

    def waved(at: Map) -> Map:
        x, y, z = np.moveaxis(at, -1, 0)
        waves = np.sin(k * x + 0.4 * k * y) * np.cos(k * y) * np.cos(0.7 * k * z)
        return np.asarray((body(at) - depth * waves) / (1 + 1.5 * k * depth))

    return waved


# --- Pictures ------------------------------------------------------------------------------------------


def see(body: Body, shape: tuple[int, int], pinhole: bool) -> Figure:
    """Follow the rays of the pixels to a body that is about 100 mm large, in the middle."""
    rows, columns = shape
    pixel = SPAN / min(shape)
    start, end = (FAR - 120, FAR + 120) if pinhole else (0.0, 240.0)
    x = (np.arange(columns) - (columns - 1) / 2) * pixel
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel
    origin = np.stack([*np.meshgrid(x, y), np.full(shape, 120.0)], axis=-1)
    ray = np.broadcast_to([0.0, 0.0, -1.0], origin.shape)
    if pinhole:
        origin, ray = np.broadcast_to([0.0, 0.0, FAR], origin.shape), origin - [0, 0, FAR + 120]
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    reach, distance, moving = np.full(shape, start), np.full(shape, np.inf), np.ones(shape, bool)
    for _ in range(_STEPS):
        distance[moving] = body(origin[moving] + reach[moving, np.newaxis] * ray[moving])
        reach[moving] += distance[moving]
        moving &= (np.abs(distance) > _CLOSE) & (reach < end)
        if not moving.any():
            break
    at = origin + reach[..., np.newaxis] * ray
    normal = np.stack([body(at + _STEP * unit) - body(at - _STEP * unit) for unit in np.eye(3)], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    mask = (np.abs(distance) < _HIT) & (reach < end) & (-np.sum(normal * ray, axis=-1) > _GRAZING)
    truth = FAR - at[..., 2] if pinhole else at[..., 2]
    camera = Camera(FAR / pixel) if pinhole else None
    normals = np.where(mask[..., np.newaxis], normal, np.nan)
    return Figure(normals, mask, np.where(mask, truth, np.nan), camera, pixel)


def _unit(normals: Map) -> Map:
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def noisy(figure: Figure, angle: float, seed: int = 0, reach: float = 0.0) -> Figure:
    """Add noise of so many degrees, correlated over so many pixels."""
    noise = np.random.default_rng([seed, 5]).standard_normal(figure.normals.shape)
    if reach:
        noise = gaussian_filter(noise, (reach, reach, 0))
        noise /= noise.std()
    return figure._replace(normals=_unit(figure.normals + np.radians(angle) * noise))


def with_outliers(figure: Figure, fraction: float, seed: int = 0) -> Figure:
    """Replace a share of the normals by any that face the viewer."""
    generator = np.random.default_rng([seed, 6])
    wrong = _unit(generator.standard_normal(figure.normals.shape))
    wrong[..., 2] = np.maximum(np.abs(wrong[..., 2]), 0.1)
    hit = figure.mask & (generator.random(figure.mask.shape) < fraction)
    return figure._replace(normals=np.where(hit[..., np.newaxis], _unit(wrong), figure.normals))


def flattened(figure: Figure, fraction: float) -> Figure:
    """Flatten steep slopes, as light from other parts of the body does: by the share at 60 degrees."""
    x, y, z = np.moveaxis(figure.normals, -1, 0)
    steep = np.clip((1 - z) / 0.5, 0, None)
    return figure._replace(
        normals=_unit(np.stack([x * (1 - fraction * steep), y * (1 - fraction * steep), z], -1))
    )


def shadowed(figure: Figure, fraction: float, reach: float = 0.06) -> Figure:
    """Tilt normals next to depth steps on one side, as a shadow does there."""
    filled = np.where(figure.mask, figure.truth, np.nanmedian(figure.truth))
    high = -filled if figure.camera else filled
    width = reach * min(figure.mask.shape)
    above = (
        np.clip(gaussian_filter(shift(high, (0, width), mode="nearest"), width / 3) - high - 2, 0, 10) / 10
    )
    tilt = np.stack([fraction * above, np.zeros_like(above), np.zeros_like(above)], axis=-1)
    return figure._replace(normals=_unit(figure.normals + tilt))


# --- Figures -------------------------------------------------------------------------------------------


def doll(shape: tuple[int, int], pinhole: bool, joint: float = 0.0) -> Figure:
    """Return a sitting doll: its head hides its neck, arms and legs touch the body in creases."""
    join = united if not joint else partial(melted, joint)
    parts = [
        ellipsoid((0, -12, 0), (21, 26, 17)),
        ellipsoid((0, 22, 8), (20, 19, 18)),
        ellipsoid((-17, 37, 4), (8, 8, 4)),
        ellipsoid((17, 37, 4), (8, 8, 4)),
        ellipsoid((1, 18, 25), (6, 5, 5)),
        capsule((-17, 2, 2), (-24, -20, 10), 8),
        capsule((17, 2, 2), (24, -18, 6), 7),
        capsule((-13, -32, 5), (-17, -34, 26), 9, 10),
        capsule((13, -32, 5), (18, -34, 24), 9, 10),
    ]
    return see(join(*parts), shape, pinhole)


def carriers(shape: tuple[int, int], pinhole: bool) -> Figure:
    """Return two figures that hold a bag between them, whose front edge hides the back of its inside."""
    bag = without(ellipsoid((0, 0, 0), (26, 26, 30)), ellipsoid((0, 3, 0), (24, 25, 28)))
    bag = without(bag, ground_above(8, 0.3))
    sides = [
        part
        for sign in (-1, 1)
        for part in (
            capsule((sign * 34, -30, 4), (sign * 34, 14, 4), 9, 8),
            ellipsoid((sign * 34, 30, 6), (9, 11, 10)),
            capsule((sign * 34, 8, 8), (sign * 22, 2, 20), 4),
            capsule((sign * 36, -30, 4), (sign * 30, -42, 10), 6),
        )
    ]
    return see(united(bag, *sides), shape, pinhole)


def ground_above(height: float, lean: float) -> Body:
    """Return the half space above a plane across y that leans towards the viewer."""
    steep = math.hypot(1, lean)
    return lambda at: np.asarray((height - at[..., 1] - lean * at[..., 2]) / steep)


def random_figure(number: int, shape: tuple[int, int]) -> Figure:
    """Return a figure of bodies at random, in creases or joined smoothly, and an error of its normals.

    The number determines all: even ones are seen by a pinhole, every third one has a ground.
    """
    generator = np.random.default_rng([number, 77])
    bodies: list[Body] = []
    places = [np.zeros(3)]
    for _ in range(generator.integers(4, 11)):
        near = places[generator.integers(len(places))]
        place = near + generator.uniform((-26, -26, -14), (26, 26, 22))
        place = np.clip(place, (-32, -32, -20), (32, 32, 30))
        places.append(place)
        bodies.append(_random_body(generator, near, place))
    join = partial(melted, generator.uniform(3, 10)) if generator.random() < 0.5 else united
    body = join(*bodies)
    if number % 3 == 0:
        body = united(body, ground(generator.uniform(-25, -5), *generator.uniform(-0.2, 0.2, 2)))
    if generator.random() < 0.3:
        body = wavy(body, generator.uniform(0.1, 0.4), generator.uniform(5, 12))
    return _disturbed(see(body, shape, number % 2 == 0), generator, number)


def _random_body(generator: np.random.Generator, near: Map, place: Map) -> Body:
    kind, size = generator.integers(5), generator.uniform(7, 18)
    axes = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    if kind < 2:
        return ellipsoid(place, size * generator.uniform(0.6, 1.4, 3), axes)
    if kind == 2:
        return capsule(near, place, 0.5 * size, 0.5 * size * generator.uniform(0.7, 1.3))
    if kind == 3:
        return ring(place, size, 0.35 * size, axes)
    return box(place, size * generator.uniform(0.4, 1.0, 3), 0.2 * size, axes)


def _disturbed(figure: Figure, generator: np.random.Generator, number: int) -> Figure:
    """Return a figure whose normals have one of five errors, or none."""
    error = generator.integers(6)
    if error == 1:
        return noisy(figure, generator.uniform(0.5, 2.5), number)
    if error == 2:
        return noisy(with_outliers(figure, 0.01, number), 0.5, number)
    if error == 3:
        return flattened(figure, generator.uniform(0.02, 0.12))
    if error == 4:
        return shadowed(figure, generator.uniform(0.1, 0.4))
    if error == 5:
        return noisy(figure, 1.0, number, reach=2.0)
    return figure


SHAPE = 128, 128
CHOSEN_ON: dict[str, Callable[[], Figure]] = {
    "doll": lambda: doll(SHAPE, True),
    "doll, parallel rays, 1 degree of noise": lambda: noisy(doll(SHAPE, False), 1.0),
    "doll, smooth joints": lambda: doll(SHAPE, True, 6.0),
    "carriers": lambda: carriers(SHAPE, True),
    "carriers, parallel rays, flattened": lambda: flattened(carriers(SHAPE, False), 0.08),
} | {f"figure {k}": partial(random_figure, k, SHAPE) for k in range(14)}
"""Figures on which the constants of robust integration were chosen."""

HELD_OUT: dict[str, Callable[[], Figure]] = {
    f"figure {k}": partial(random_figure, k, SHAPE) for k in range(100, 130)
}
"""Figures on which no constant was chosen."""
