"""A coin similar to 5 yen: hole, gear, ear of rice, water, and its value in writing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from mirrorskin.io.base.types import Floats
from mirrorskin.twin.objects import difference_slope

RADIUS = 11.0
HOLE_RADIUS = 2.5
THICKNESS = 1.5
RELIEF = 0.25
RELIEF_ZENITH = math.radians(35.0)
FLANK_ZENITH = math.radians(40.0)

_RIM_FOOT = 9.6
_LINE = 0.3  # half-width of a line at its foot
_RAMP = RELIEF / math.tan(RELIEF_ZENITH)
_GEAR_TEETH, _GEAR_RING, _GEAR_TIP, _TOOTH = 16, 3.3, 4.2, 0.36
_GEAR_REACH = math.hypot(_GEAR_TIP, _TOOTH)
_EAR_RADIUS, _STEM_START, _EAR_START = 6.9, math.radians(-110.0), math.radians(-35.0)
_GRAIN_PITCH, _GRAIN_PAIRS, _GRAIN_TILT = math.radians(11.0), 9, math.radians(28.0)
_GRAIN_LENGTH, _GRAIN_WIDTH, _GRAIN_OFFSET = 0.95, 0.45, 0.75  # halves of length and width
_EAR_REACH, _EAR_BOTTOM = 1.35, -2.5  # maximum distance of grains from the stem, and lowest y
_WATER_PITCH, _WATER_LINES, _WATER_TOP = 0.95, 7, -2.9
_WATER_INNER, _WATER_OUTER = 4.4, 9.0
_KANJI_HALF = 1.9

_Stroke = tuple[float, float, float, float]
_GO: tuple[_Stroke, ...] = (
    (-1.2, 1.3, 1.2, 1.3),
    (-0.1, 1.3, -0.5, -1.3),
    (-0.9, 0.2, 0.8, 0.2),
    (0.8, 0.2, 0.7, -1.3),
    (-1.5, -1.3, 1.5, -1.3),
)
_EN: tuple[_Stroke, ...] = (
    (-1.3, 1.3, 1.3, 1.3),
    (-1.3, 1.3, -1.3, -1.5),
    (1.3, 1.3, 1.3, -1.5),
    (0.0, 1.3, 0.0, 0.0),
    (-1.3, 0.0, 1.3, 0.0),
)
_WRITING = ((_GO, -4.5, -5.275), (_EN, 4.5, -5.275))


@dataclass(frozen=True, slots=True)
class Coin:
    """A coin of 22 mm diameter with a hole of 5 mm, on a table 1.5 mm below its rim.

    It is designed for this sensor: no wall is vertical. The relief (0.25 mm; rim and broad motifs up to z =
    0, lines to -0.04 mm) rises from the field in ramps of 35 degrees. The two flanks, outside 22 mm and
    inside 5 mm, fall to the table in ramps of 40 degrees, as a sheet would drape over them; a ramp steeper
    than 45 degrees would stay dark. Ramps are at least 0.12 mm wide, except where one ends in a corner.
    """

    name: ClassVar[str] = "coin"

    @property
    def radius(self) -> float:
        """Radius of the outer flank's foot on the table, mm."""
        return RADIUS + THICKNESS / math.tan(FLANK_ZENITH)

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z in mm of coin and table; finite everywhere."""
        r = np.hypot(x, y)
        face = np.clip(math.tan(RELIEF_ZENITH) * _inset(x, y, r), 0.0, RELIEF) - RELIEF
        flank = math.tan(FLANK_ZENITH) * np.minimum(RADIUS - r, r - HOLE_RADIUS)
        coin: Floats = np.minimum(face, flank)
        return np.maximum(coin, -THICKNESS)

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy: 0 where level, otherwise central differences of the height over 0.2 µm."""
        x, y = np.broadcast_arrays(x, y)
        z = self.height(x, y)
        ramp = (z != 0) & (z != -RELIEF) & (z != -THICKNESS)
        slope = np.zeros((2, *x.shape))
        slope[:, ramp] = difference_slope(self.height, x[ramp], y[ramp], (1e-4, 1e-4))
        return slope[0], slope[1]


# Each motif is its *inset*: the distance in mm from its outline, positive inside. Unions are maxima and
# intersections minima. The slope of an inset is 1, so all ramps made of it have the same inclination.


def _inset(x: Floats, y: Floats, r: Floats) -> Floats:
    x, y, r = np.broadcast_arrays(x, y, r)
    inset = np.asarray(np.maximum(r - _RIM_FOOT, _GEAR_RING - r))
    # Motifs are limited to where they rise above the field; inside the ring the teeth have full height.
    motifs = [
        (_teeth, (r > _GEAR_RING - _RAMP) & (r < _GEAR_REACH)),
        (_ear, (np.abs(r - _EAR_RADIUS) < _EAR_REACH) & (y > _EAR_BOTTOM)),
        (_water, (y < _WATER_TOP + _LINE) & (r > _WATER_INNER) & (r < _WATER_OUTER)),
    ]
    for strokes, centre_x, centre_y in _WRITING:
        square = (np.abs(x - centre_x) < _KANJI_HALF) & (np.abs(y - centre_y) < _KANJI_HALF)
        motifs.append((partial(_character, strokes, centre_x, centre_y), square))
    for motif, near in motifs:
        inset[near] = np.maximum(inset[near], motif(x[near], y[near]))
    return inset


def _teeth(x: Floats, y: Floats) -> Floats:
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    pitch = 2 * math.pi / _GEAR_TEETH
    from_tooth = angle - pitch * np.round(angle / pitch)
    return np.minimum(_TOOTH - r * np.abs(np.sin(from_tooth)), _GEAR_TIP - r * np.cos(from_tooth))


def _ear(x: Floats, y: Floats) -> Floats:
    r, angle = np.hypot(x, y), np.arctan2(x, y)
    outwards = r - _EAR_RADIUS
    tip = _EAR_START + _GRAIN_PITCH * _GRAIN_PAIRS
    ends = _EAR_RADIUS * np.minimum(angle - _STEM_START, tip - angle)
    inset = np.minimum(_LINE - np.abs(outwards), ends)
    nearest = np.round((angle - _EAR_START) / _GRAIN_PITCH)
    # Grains overlap the part of their neighbours at the stem.
    for number in (nearest - 1, nearest, nearest + 1):
        pair = np.clip(number, 0, _GRAIN_PAIRS - 1)
        from_pair = angle - _EAR_START - pair * _GRAIN_PITCH
        along, across = r * np.sin(from_pair), r * np.cos(from_pair) - _EAR_RADIUS
        inset = np.maximum(inset, _grain(along, np.abs(across) - _GRAIN_OFFSET))
    return inset


def _grain(along: Floats, across: Floats) -> Floats:
    """Draw a lens, the overlap of two discs, tilted towards the tip of the ear."""
    cos, sin = math.cos(_GRAIN_TILT), math.sin(_GRAIN_TILT)
    length, width = along * cos + across * sin, across * cos - along * sin
    disc = (_GRAIN_LENGTH**2 + _GRAIN_WIDTH**2) / (2 * _GRAIN_WIDTH)
    return disc - np.hypot(length, np.abs(width) + disc - _GRAIN_WIDTH)


def _water(x: Floats, y: Floats) -> Floats:
    line = np.clip(np.round((_WATER_TOP - y) / _WATER_PITCH), 0, _WATER_LINES - 1)
    r = np.hypot(x, y)
    inset = np.minimum(_LINE - np.abs(y - _WATER_TOP + line * _WATER_PITCH), _WATER_OUTER - r)
    inset = np.minimum(inset, r - _WATER_INNER)
    for _, centre_x, centre_y in _WRITING:
        outside = np.maximum(np.abs(x - centre_x), np.abs(y - centre_y)) - _KANJI_HALF
        inset = np.minimum(inset, outside)
    return inset


def _character(
    strokes: tuple[_Stroke, ...], centre_x: float, centre_y: float, x: Floats, y: Floats
) -> Floats:
    insets = [_LINE - _distance_to_segment(x - centre_x, y - centre_y, stroke) for stroke in strokes]
    inset: Floats = np.max(insets, axis=0)
    return inset


def _distance_to_segment(x: Floats, y: Floats, stroke: _Stroke) -> Floats:
    x0, y0, x1, y1 = stroke
    dx, dy = x1 - x0, y1 - y0
    along = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx**2 + dy**2), 0.0, 1.0)
    return np.hypot(x - x0 - along * dx, y - y0 - along * dy)
