"""Rotations about z and shifts between two maps, by correlation of their heights: starts of a fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import Motion
from mirrorskin.io.watch.saturation import MAD
from mirrorskin.kernels.array_types import Doubles

SIDE = 128
"""Pixels along the longer side of the correlated maps, at most."""
_SIDE_OF_TURNS = 64  # the same for maps that are correlated at all rotations
_NARROW, _WIDE = 0.7, 5.0  # standard deviations, pixels, of the Gaussians whose difference is the band pass
_SUPPORT = 0.6  # smallest share of the wide Gaussian on valid pixels
_CLIP = 3.0  # standard deviations to which relief is limited, so that a step or a dent is not all of it
_PEAKS = 4  # peaks of a correlation that are tried
_NEXT_PEAK = 3  # distance between peaks, pixels
_TURNS = 6  # rotations that are refined
_LEAST = 0.5  # smallest share of the overlap that must have relief on both sides


class Start(NamedTuple):
    """A motion, and its peak of the correlation in standard deviations of the correlation's values."""

    significance: float
    motion: Motion


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights without their coarse shape and their noise, on square pixels.

    Attributes
    ----------
    values : ndarray, (H, W), float32
        0 where unknown.
    known : ndarray, (H, W), float32
        1 where the value is known, else 0.
    origin : tuple of float
        x and y, mm, of the first pixel.
    pixel : float
        mm.
    """

    values: NDArray[np.float32]
    known: NDArray[np.float32]
    origin: tuple[float, float]
    pixel: float

    @classmethod
    def of(cls, map_: PoseMap, pixel: float) -> Relief:
        """Return the relief of a map."""
        records = map_.records.read()
        x0, y0, step_x, step_y = map_.grid
        known = np.isfinite(records[..., 0])
        height = _without_form(np.where(known, records[..., 3], 0.0).astype(np.float64), known)
        columns, rows = (
            max(1, round(n * step / pixel))
            for n, step in ((known.shape[1], step_x), (known.shape[0], step_y))
        )
        weight = known.astype(np.float32)
        narrow, support = (_smooth(part, _NARROW * pixel, step_x, step_y) for part in (height, weight))
        wide, wide_support = (_smooth(part, _WIDE * pixel, step_x, step_y) for part in (height, weight))
        with np.errstate(invalid="ignore", divide="ignore"):
            band = narrow / support - wide / wide_support
        known &= wide_support > _SUPPORT
        if not known.any():
            nothing = np.zeros((rows, columns), np.float32)
            return cls(nothing, nothing, (x0, y0), pixel)
        middle = np.median(band[known])
        limit = _CLIP * MAD * np.median(np.abs(band[known] - middle))
        band = np.where(known, np.clip(band - middle, -limit, limit), 0.0).astype(np.float32)
        origin = x0 - step_x / 2 + pixel / 2, y0 + step_y / 2 - pixel / 2
        # Pixel (i, j) of the new grid is at these pixels of the map.
        grid = np.array(
            [[pixel / step_x, 0, (origin[0] - x0) / step_x], [0, pixel / step_y, (y0 - origin[1]) / step_y]]
        )
        values, mask = _warped(band, known.astype(np.float32), grid, (columns, rows))
        return cls(values, mask, origin, pixel)

    @property
    def reach(self) -> float:
        """The longer side, mm."""
        return float(max(self.values.shape) * self.pixel)

    def turned(self, angle: float) -> Relief:
        """Return the relief rotated about the origin of x and y."""
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        rows, columns = self.values.shape
        (left, top), pixel = self.origin, self.pixel
        corners = np.array(
            [(left + i * pixel, top - k * pixel) for i in (0, columns - 1) for k in (0, rows - 1)]
        )
        moved = corners @ turn.T
        low, high = moved.min(axis=0), moved.max(axis=0)
        wide, tall = (math.ceil(length / pixel) + 1 for length in high - low)
        # Column i and row k of the new grid are at x = low[0] + i pixel, y = high[1] - k pixel; the pixel of
        # the old one is that point rotated back.
        at_first = np.array([low[0], high[1]]) @ turn
        grid = np.array(
            [
                [turn[0, 0], -turn[1, 0], (at_first[0] - left) / pixel],
                [-turn[0, 1], turn[1, 1], (top - at_first[1]) / pixel],
            ]
        )
        values, known = _warped(self.values, self.known, grid, (wide, tall))
        return Relief(values, known, (float(low[0]), float(high[1])), pixel)

    @cached_property
    def transforms(self) -> dict[tuple[int, int], list[NDArray[np.complex64]]]:
        """Fourier transforms of the values, their squares and the mask, by the size of the padded map."""
        return {}

    def transformed(self, size: tuple[int, int]) -> list[NDArray[np.complex64]]:
        """Return the Fourier transforms of the values, their squares and the mask."""
        if size not in self.transforms:
            parts = self.values, self.values**2, self.known
            self.transforms[size] = [fft.rfft2(part, size) for part in parts]
        return self.transforms[size]


def starts(
    first: Relief,
    second: Relief,
    min_common: float,
    angle: float = 0.0,
    near: tuple[float, float, float] | None = None,
) -> list[Start]:
    """Return the motions at the highest peaks of the normalised cross-correlation of two reliefs.

    Only pixels that both know count (Padfield, IEEE Transactions on Image Processing 21, 2012). Peaks are
    compared by their correlation times the root of the shared area, as a correlation by chance is inversely
    proportional to it.

    Parameters
    ----------
    first, second : Relief
        Of the same pixel size.
    min_common : float
        Smallest share of the smaller relief that both must know.
    angle : float
        Rotation about z by which ``first`` is already rotated, radians.
    near : tuple of float, optional
        Shift along x and y, mm, and the largest distance from it along each.
    """
    shapes = first.values.shape, second.values.shape
    rows, columns = (fft.next_fast_len(a + b - 1, real=True) for a, b in zip(*shapes, strict=True))
    size = rows, columns
    mine, theirs = first.transformed(size), second.transformed(size)
    product, mine_square, their_square, shared = (
        fft.irfft2(np.conj(mine[i]) * theirs[k], size) for i, k in ((0, 0), (1, 2), (2, 1), (2, 2))
    )
    least = min_common * min(float(first.known.sum()), float(second.known.sum()))
    power = mine_square * their_square
    usable = (shared > max(_LEAST * least, 1.0)) & (power > 1e-6 * max(float(power.max()), 1e-300))
    if not usable.any():
        return []
    score = np.where(usable, product * np.sqrt(np.maximum(shared, 0) / np.where(usable, power, 1.0)), -np.inf)
    spread = max(float(np.std(score[usable])), 1e-12)
    along, up = _shifts(first, second, size)
    if near is not None:
        inside = (np.abs(along - near[0]) <= near[2]) & (np.abs(up - near[1])[:, np.newaxis] <= near[2])
        score[~inside] = -np.inf
    found = []
    turn = np.asarray(Rotation.from_rotvec([0, 0, angle]).as_matrix())
    for _ in range(_PEAKS):
        row, column = np.unravel_index(np.argmax(score), size)
        if not np.isfinite(score[row, column]) or score[row, column] <= 0:
            break
        shift = np.array([along[column], up[row], 0.0])
        found.append(Start(float(score[row, column]) / spread, Motion(turn, shift)))
        peak = [
            np.arange(at - _NEXT_PEAK, at + _NEXT_PEAK + 1) % n
            for at, n in zip((row, column), size, strict=True)
        ]
        score[np.ix_(*peak)] = -np.inf
    return found


def _shifts(first: Relief, second: Relief, size: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """Return the shifts, mm, along x of the columns, and along y of the rows, of a correlation."""
    pixels = []
    for number, length in zip(size, second.values.shape, strict=True):
        index = np.arange(number)
        pixels.append(np.where(index < length, index, index - number))
    (x1, y1), (x2, y2) = first.origin, second.origin
    return x2 - x1 + pixels[1] * first.pixel, y2 - y1 - pixels[0] * first.pixel


def turned_starts(
    maps: tuple[PoseMap, PoseMap], reliefs: tuple[Relief, Relief], min_common: float
) -> list[Start]:
    """Return the motions at the highest peaks of the correlation over all rotations about z.

    ``reliefs`` are those of the maps at the working pixel of `SIDE` pixels.
    """
    pixel = working_pixel(maps, _SIDE_OF_TURNS)
    mine, theirs = (Relief.of(map_, pixel) for map_ in maps)
    count = 2 * math.ceil(math.pi * max(mine.values.shape) / 4)
    angles = 2 * math.pi / count * np.arange(count)
    best = []
    for angle in angles:
        found = starts(mine.turned(angle), theirs, min_common, angle)
        best.append(found[0].significance if found else 0.0)
    order = np.argsort(best)[::-1][:_TURNS]
    mine, theirs = reliefs
    step = 2 * math.pi / count / 3
    near = (angles[number] + part * step for number, part in itertools.product(order, (-1, 0, 1)))
    found = [start for angle in near for start in starts(mine.turned(angle), theirs, min_common, angle)]
    return sorted(found, key=lambda start: -start.significance)[:_TURNS]


def working_pixel(maps: Sequence[PoseMap], side: int) -> float:
    """Return the pixel size, mm, at which the longest map has at most ``side`` pixels."""
    pixel = 0.0
    for map_ in maps:
        (rows, columns), (_, _, step_x, step_y) = map_.shape, map_.grid
        pixel = max(pixel, step_x, step_y, rows * step_y / side, columns * step_x / side)
    return pixel


def _without_form(height: Doubles, known: NDArray[np.bool_]) -> Doubles:
    """Return heights, (H, W), without their best paraboloid, 0 where unknown."""
    rows, columns = np.indices(known.shape, dtype=np.float64)
    x, y = columns / known.shape[1] - 0.5, rows / known.shape[0] - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    used = known & ((rows + columns) % 3 == 0)
    if np.count_nonzero(used) < 3 * len(terms):
        return height
    form = np.linalg.lstsq(terms[:, used].T, height[used], rcond=None)[0]
    return np.where(known, height - np.tensordot(form, terms, 1), 0.0)


def _smooth(values: NDArray[np.floating], sigma: float, step_x: float, step_y: float) -> NDArray[np.floating]:
    blurred = cv2.GaussianBlur(
        values, (0, 0), sigmaX=sigma / step_x, sigmaY=sigma / step_y, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(blurred)


def _warped(
    values: NDArray[np.float32], known: NDArray[np.float32], grid: Doubles, size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return values and mask at the pixels that an affine map, (2, 3), gives for those of the new size."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved, weight = (np.asarray(cv2.warpAffine(part, grid, size, flags=flags)) for part in (values, known))
    mask = (weight > 0.5).astype(np.float32)
    return moved * mask, mask
