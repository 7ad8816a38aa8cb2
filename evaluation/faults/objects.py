"""Hard objects under an elastic sheet: steep, textured, or of about one slope.

The sheet is the object's surface, smoothed by a Gaussian. Heights and slopes at the points of a picture
come from samples at these points, which reach beyond the picture; those at the centres of pixels from cubic
splines through them. Methods may be chosen by their answers on `CHOSEN`, not by those on `HELD_OUT`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from mirrorskin.evaluation.faults.camera import POINTS, Floats, points
from mirrorskin.evaluation.faults.estimators import PIXEL, Surface

SHAPE = 64, 96  # pixels
SHEETS = 0.5, 2.0  # standard deviations of the Gaussian, pixels
MARGINS = 0.2, 0.3  # mm: a press starts so far above the sheet, and ends so far below
_AROUND = 12  # pixels around the picture that the sheet is computed from
_LEVEL = 0.3  # mm: travel at which the highest point is touched
_MARKS = 30  # grinding marks of the scratched plate


def _thread(x: Floats, y: Floats) -> Floats:
    """Return a screw of 24 mm along x: flanks of 40 degrees, pitch of 0.8 mm, flat crests and roots."""
    pitch, slope = 0.8, np.tan(np.radians(40))
    from_crest = np.abs((x + 0.15 * y) / pitch - np.rint((x + 0.15 * y) / pitch)) * pitch
    flank = np.clip(from_crest - pitch / 16, 0, pitch * 3 / 8)
    return np.asarray(np.sqrt(144 - y**2) - 12 - slope * flank)


def _tilted(x: Floats, y: Floats) -> Floats:
    """Return a plate that is tilted by 1.4 degrees, so that its pixels do not all turn light in one frame."""
    return np.asarray(0.02 * x + 0.015 * y)


def _twill(x: Floats, y: Floats) -> Floats:
    """Return a cloth of threads of 0.25 mm, each over two and under two, one further in each row."""
    width, wave = 0.25, 0.035
    warp, weft = np.floor(x / width), np.floor(y / width)

    def yarn(across: Floats, along: Floats, shift: Floats) -> Any:
        up = wave * np.tanh(2 * np.sin(np.pi / 2 * (along - shift) + np.pi / 4))
        return up + 0.06 * (np.sqrt(np.maximum(1 - (2 * across - 1) ** 2, 0)) - 1)

    one, other = yarn(x / width - warp, y / width, warp), yarn(y / width - weft, x / width, weft + 2)
    return np.asarray(np.maximum(one, other) + _tilted(x, y))


def _dimples(x: Floats, y: Floats) -> Floats:
    """Return a ball of 40 mm with dimples: bowls with sharp rims, 0.9 mm wide and 0.13 mm deep."""
    distance, radius, depth = 0.95, 0.45, 0.13
    sphere = (radius**2 + depth**2) / (2 * depth)
    row = np.rint(y / (distance * np.sqrt(3) / 2))
    candidates = []
    for near in (row - 1, row, row + 1):
        shift = distance / 2 * (near % 2)
        from_center = x - shift - distance * np.rint((x - shift) / distance)
        candidates.append(np.hypot(from_center, y - near * distance * np.sqrt(3) / 2))
    nearest = np.minimum(np.minimum(candidates[0], candidates[1]), candidates[2])
    bowl = np.where(
        nearest < radius, sphere - depth - np.sqrt(sphere**2 - np.minimum(nearest, radius) ** 2), 0
    )
    return np.asarray(bowl - (x**2 + y**2) / 40)


def _coin(x: Floats, y: Floats) -> Floats:
    """Return the rim of a coin of 12 mm: a wall of 50 degrees, a groove, and beads of 0.35 mm beside it."""
    radius, angle = np.hypot(x + 5.2, y), np.arctan2(y, x + 5.2)
    wall = np.tan(np.radians(50))
    rim = np.clip(wall * (radius - 5.3), 0, 0.2) - np.clip(wall * (radius - 6.3), 0, 0.2)
    groove = -0.03 * np.exp(-(((radius - 5.95) / 0.06) ** 2))
    step = 0.42 / 4.95
    along = (angle - step * np.rint(angle / step)) * 4.95
    bead = np.sqrt(np.maximum(0.175**2 - along**2 - (radius - 4.95) ** 2, 0)) * 0.6
    relief = 0.05 * np.tanh(6 * np.sin(2.2 * x + 1.5) * np.cos(2.6 * y)) * (radius < 4.6)
    return np.asarray(rim + groove + bead + relief + _tilted(x, y))


def _scratch(x: Floats, y: Floats) -> Floats:
    """Return a ground plate, tilted by 3 degrees, with a scratch of 0.2 mm, its burrs, and one of 0.06 mm."""
    generator = np.random.default_rng(5)
    along, across = np.cos(0.3) * x + np.sin(0.3) * y, np.cos(0.3) * y - np.sin(0.3) * x
    marks = sum(
        amplitude * np.sin(2 * np.pi * across / length + phase)
        for amplitude, length, phase in zip(
            generator.uniform(0.0001, 0.0008, _MARKS),
            generator.uniform(0.08, 0.4, _MARKS),
            generator.uniform(0, 2 * np.pi, _MARKS),
            strict=True,
        )
    )
    from_scratch = np.abs(np.cos(1.0) * x - np.sin(1.0) * y + 0.15 * np.sin(1.3 * y))
    scratch = np.minimum(from_scratch / 0.1 - 1, 0) * 0.09
    burr = 0.03 * np.exp(-(((from_scratch - 0.14) / 0.035) ** 2))
    second = -0.05 * np.exp(-(((along - 0.9 + 0.2 * across) / 0.03) ** 2))
    return np.asarray(np.tan(np.radians(3)) * x + marks + scratch + burr + second)


def _print(x: Floats, y: Floats) -> Floats:
    """Return raised characters of a matrix printer: 7 x 5 dots of 0.2 mm, 0.1 mm high, on flat paper."""
    pitch, radius = 0.28, 0.1
    column, row = np.rint(x / pitch).astype(int), np.rint(y / pitch).astype(int)
    dots = np.random.default_rng(11).random((64, 64)) < 0.55
    there = dots[row % 64, column % 64] & (column % 6 != 0) & (row % 8 != 0)
    distance = np.hypot(x - column * pitch, y - row * pitch)
    dot = 0.1 * np.clip((radius - distance) / 0.05, 0, 1) * there
    paper = 0.004 * np.sin(2 * np.pi * x / 1.7) * np.sin(2 * np.pi * y / 2.3)
    return np.asarray(dot + paper + _tilted(x, y))


CHOSEN: Mapping[str, Callable[[Floats, Floats], Floats]] = {
    "thread": _thread,
    "twill": _twill,
    "dimples": _dimples,
}
HELD_OUT: Mapping[str, Callable[[Floats, Floats], Floats]] = {
    "coin": _coin,
    "scratch": _scratch,
    "print": _print,
}
OBJECTS = {**CHOSEN, **HELD_OUT}


@functools.cache
def under_sheet(name: str, sheet: float) -> Surface:
    """Return the sheet on an object; the sheet's standard deviation is in pixels."""
    return smoothed(name, OBJECTS[name], sheet)


def smoothed(name: str, heights: Callable[[Floats, Floats], Floats], sheet: float) -> Surface:
    """Return the surface of a function of x and y, smoothed by a Gaussian."""
    larger = SHAPE[0] + 2 * _AROUND, SHAPE[1] + 2 * _AROUND
    grid = heights(*np.broadcast_arrays(*points(larger, PIXEL)))
    spacing = PIXEL / POINTS
    filtered = [gaussian_filter(grid, sheet * POINTS, order=order) for order in ((0, 0), (0, 1), (1, 0))]
    maps = np.stack([filtered[0], filtered[1] / spacing, -filtered[2] / spacing])  # rows go down, y goes up
    rows, columns = (_AROUND * POINTS + np.arange(size * POINTS) for size in SHAPE)
    fine = maps[:, rows[:, np.newaxis], columns]
    centers = [(_AROUND + np.arange(size) + 0.5) * POINTS - 0.5 for size in SHAPE]
    at = np.meshgrid(*centers, indexing="ij")
    true = np.stack([map_coordinates(values, at, order=3) for values in maps])
    top = fine[0].max() + _LEVEL
    fine[0] -= top
    true[0] -= top
    return Surface(
        f"{name}, {sheet:g} px", fine, true, (_LEVEL - MARGINS[0], MARGINS[1] - float(fine[0].min()))
    )
