"""Ten objects with steps of many heights, thin parts and textured relief, with noise from 0.002 to 0.05 rad.

Robust integration was developed on the first five; the others only judge it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from mirrorskin.evaluation.scenes.depth import Map, Scene, Surface, ellipsoid, plane, see
from mirrorskin.evaluation.scenes.inputs import Shape


def _textured(surface: Surface, depth: float, length: float, turn: float = 0.3) -> Surface:
    """Return a surface with waves of a depth and a length, mm."""
    k = 2 * np.pi / length

    def waves(x: Map, y: Map) -> Map:
        u, v = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
        return np.asarray(surface(x, y) + depth * np.sin(k * u) * np.cos(0.8 * k * v))

    return waves


def _inside(surface: Surface, region: Callable[[Map, Map], Map]) -> Surface:
    """Return the part of a surface where the region is above 0."""
    return lambda x, y: np.where(region(x, y) > 0, surface(x, y), np.nan)


def _box(left: float, right: float, low: float, high: float) -> Callable[[Map, Map], Map]:
    return lambda x, y: np.asarray(np.minimum(np.minimum(x - left, right - x), np.minimum(y - low, high - y)))


def _rod(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Surface:
    """Return the upper half of a rod."""
    (x0, y0, z0), (x1, y1, z1) = start, end
    length = np.hypot(x1 - x0, y1 - y0)
    along_x, along_y = (x1 - x0) / length, (y1 - y0) / length

    def surface(x: Map, y: Map) -> Map:
        along = (x - x0) * along_x + (y - y0) * along_y
        across = (y - y0) * along_x - (x - x0) * along_y
        inside = (along > 0) & (along < length) & (np.abs(across) < radius)
        top = z0 + (z1 - z0) * along / length + np.sqrt(np.maximum(radius**2 - across**2, 0))
        return np.where(inside, top, np.nan)

    return surface


def tiles(shape: Shape) -> Scene:
    """Return rows of overlapping roof tiles: inclined, each with a cliff below and a curved surface."""
    surfaces: list[Surface] = []
    for row in range(5):
        for column in range(6):
            x0, y0 = 17.0 * (column - 2.5) + 8.5 * (row % 2), 18.0 * (row - 2)

            def tile(x: Map, y: Map, x0: float = x0, y0: float = y0) -> Map:
                return np.asarray(6 - 0.25 * (y - y0) - 0.02 * (x - x0) ** 2)

            surfaces.append(_inside(tile, _box(x0 - 8.2, x0 + 8.2, y0 - 9, y0 + 14)))
    return see(shape, [plane(0.0, 0.0), *surfaces], np.degrees(0.01))


def wires(shape: Shape) -> Scene:
    """Return wires of 2 to 5 mm above rough ground, which cross each other."""
    rough = _textured(plane(0.05, -0.05), 0.4, 9.0)
    generator = np.random.default_rng(11)
    rods: list[Surface] = []
    for _ in range(7):
        a, b = generator.uniform(-45, 45, 2), generator.uniform(-45, 45, 2)
        height = generator.uniform(2, 25, 2)
        rods.append(_rod((a[0], a[1], height[0]), (b[0], b[1], height[1]), generator.uniform(1.0, 2.5)))
    return see(shape, [rough, *rods], np.degrees(0.02))


def letters(shape: Shape) -> Scene:
    """Return raised bars and rings of 1 to 8 mm with flat tops and bevels, on a wavy ground."""

    def raised(x: Map, y: Map) -> Map:
        bars = [_box(-40, -34, -30, 30), _box(-34, -12, 24, 30), _box(-34, -16, -3, 3), _box(10, 16, -30, 30)]
        height = 3 * np.sin(x / 14) * np.cos(y / 17)
        for number, bar in enumerate(bars):
            height = height + np.clip(1.5 * bar(x, y), 0, 1 + 2.3 * number)
        ring = 8 - np.abs(np.hypot(x - 30, y - 10) - 14)
        return np.asarray(height + np.clip(2.0 * (ring - 5), 0, 5))

    return see(shape, [raised], np.degrees(0.005))


def plates(shape: Shape) -> Scene:
    """Return textured plates at heights from 0.5 to 30 mm, whose cliffs no normal shows."""
    generator = np.random.default_rng(5)
    surfaces: list[Surface] = [_textured(plane(0.02, 0.03), 0.3, 12.0)]
    for number in range(9):
        x, y = generator.uniform(-35, 35, 2)
        wide, tall = generator.uniform(8, 20, 2)
        base = 0.5 * 1.6**number
        tilt = generator.uniform(-0.15, 0.15, 2)
        top = partial(lambda x, y, base, a, b: base + a * x + b * y, base=base, a=tilt[0], b=tilt[1])
        turned = _textured(top, 0.25, generator.uniform(6, 14), number)
        surfaces.append(_inside(turned, _box(x - wide, x + wide, y - tall, y + tall)))
    return see(shape, surfaces, np.degrees(0.03))


def jug(shape: Shape) -> Scene:
    """Return a jug: an ellipsoid, a neck, and a handle in front of both, without a ground."""
    body = ellipsoid((0, -10, 0), (32, 30, 24), np.eye(3))
    neck = _inside(lambda x, y: np.sqrt(np.maximum(14.0**2 - x**2, 0)) + 0 * y, _box(-13.9, 13.9, 10, 44))

    def handle(x: Map, y: Map) -> Map:
        ring = np.hypot(x - 6, 0.8 * (y - 4))
        return np.asarray(30 + 0.2 * y + np.sqrt(16 - (ring - 17) ** 2))

    with np.errstate(invalid="ignore"):
        return see(shape, [_textured(body, 0.15, 7.0), neck, handle], np.degrees(0.002))


def gears(shape: Shape) -> Scene:
    """Return two toothed wheels, one above the other, with domed faces and holes."""

    def wheel(x0: float, y0: float, radius: float, base: float, teeth: int) -> Surface:
        def face(x: Map, y: Map) -> Map:
            return np.asarray(base - 0.012 * ((x - x0) ** 2 + (y - y0) ** 2) + 0.1 * x)

        def region(x: Map, y: Map) -> Map:
            r, angle = np.hypot(x - x0, y - y0), np.arctan2(y - y0, x - x0)
            return np.asarray(np.minimum(radius + 3 * np.tanh(3 * np.cos(teeth * angle)) - r, r - 6))

        return _inside(face, region)

    return see(
        shape, [plane(-0.05, 0.1), wheel(-14, -10, 26, 14, 12), wheel(18, 15, 22, 24, 9)], np.degrees(0.01)
    )


def sieve(shape: Shape) -> Scene:
    """Return a textured dome with holes, through which a slope below is seen."""
    dome = _textured(lambda x, y: 25 - 0.006 * (x**2 + y**2), 0.2, 8.0)

    def region(x: Map, y: Map) -> Map:
        u, v = (x + 8) % 16 - 8, (y + 8) % 16 - 8
        return np.asarray(np.hypot(u, v) - 4.5 + 0.03 * x)

    return see(shape, [_textured(plane(0.2, -0.1), 0.3, 10.0), _inside(dome, region)], np.degrees(0.02))


def bowls(shape: Shape) -> Scene:
    """Return three bowls inside each other, whose front rims hide what is behind."""

    def bowl(radius: float, base: float, shift: float) -> Surface:
        def inner(x: Map, y: Map) -> Map:
            return np.asarray(base + 0.015 * (x**2 + (y - shift) ** 2) + 0.15 * y)

        return _inside(inner, lambda x, y: radius - np.hypot(x, y - shift))

    return see(shape, [plane(0.0, 0.0), bowl(42, 6, 0), bowl(28, 14, 6), bowl(14, 26, -4)], np.degrees(0.005))


def crystals(shape: Shape) -> Scene:
    """Return pyramids with flat faces that stand before each other."""
    generator = np.random.default_rng(21)
    surfaces: list[Surface] = [plane(0.1, 0.0)]
    for _ in range(9):
        x0, y0, top = generator.uniform((-35, -35, 10), (35, 35, 40))
        turn, steep = generator.uniform(0, np.pi), generator.uniform(0.5, 1.4)

        def pyramid(x: Map, y: Map, x0=x0, y0=y0, top=top, turn=turn, steep=steep) -> Map:  # type: ignore[no-untyped-def]
            u = np.cos(turn) * (x - x0) + np.sin(turn) * (y - y0)
            v = np.cos(turn) * (y - y0) - np.sin(turn) * (x - x0)
            far = np.maximum(np.abs(u), np.abs(v))
            return np.where(far < 12, top - steep * far, np.nan)

        surfaces.append(pyramid)
    return see(shape, surfaces, np.degrees(0.05))


def scales(shape: Shape) -> Scene:
    """Return rough fish scales whose edges rise by 0.3 to 3 mm."""
    surfaces: list[Surface] = [_textured(plane(0.0, 0.0), 0.2, 9.0)]
    for row in range(7):
        for column in range(7):
            x0, y0 = 14.0 * (column - 3) + 7 * (row % 2), 14.0 * (row - 3)
            lift = 0.3 + 2.7 * ((3 * row + 5 * column) % 7) / 6

            def scale(x: Map, y: Map, x0: float = x0, y0: float = y0, lift: float = lift) -> Map:
                return np.asarray(lift + 0.04 * (y - y0) - 0.01 * (x - x0) ** 2 - 0.01 * (y - y0) ** 2)

            surfaces.append(
                _inside(_textured(scale, 0.1, 5.0), lambda x, y, a=x0, b=y0: 8.5 - np.hypot(x - a, y - b))  # type: ignore[misc]
            )
    return see(shape, surfaces, np.degrees(0.01))


DEVELOPED_ON: dict[str, Callable[[Shape], Scene]] = {
    scene.__name__: scene for scene in (tiles, wires, letters, plates, jug)
}
HELD_OUT: dict[str, Callable[[Shape], Scene]] = {
    scene.__name__: scene for scene in (gears, sieve, bowls, crystals, scales)
}
"""Scenes on which nothing was chosen."""
