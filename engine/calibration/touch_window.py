"""Touches: reading of a press and a turn, and windows of them whose surfaces are eliminated.

The unknowns of a window are the heights z of its pixels. A normal is that of the slopes of z, by differences
that are exact for polynomials of sixth degree; the slopes may differ from it by what these differences leave
out where the surface is rough. Frames of the turn determine the slopes, and the press ties z to absolute
heights. The light that a pixel sees is the mean over its footprint: to second order, angles to the axis
are those of the mean normal, and a term that grows with the variance of the footprint and the square of
the curvature of the surface.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.base.sources import EditedSource
from mirrorskin.engine.calibration.sources import pixel_size_of, read_turn
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.engine.diagnosis.turn_light import (
    GLOBALS,
    UNEVEN,
    PixelScale,
    SlopeAngles,
    Sums,
    light_of,
    uneven_terms,
)
from mirrorskin.engine.diagnosis.turn_nuisances import (
    LEAST_LIGHT,
    count_of,
    follow_model,
    frame_priors,
    offset_prior,
    picture_axes,
    shows_model,
)
from mirrorskin.engine.fusion.fusion import press_evidence
from mirrorskin.engine.press.intervals import IntervalScatter, interval_evidence
from mirrorskin.io import Block, Header, InputError, Source
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.rotation.registration import BORDER

SHARED = (
    *GLOBALS,
    *(f"uneven_{term}" for term in ("x", "y", "xx", "xy", "yy")),
    *("oval_x", "oval_y", "footprint", "pivot_z", "pixel_size"),
)
"""Names of the sensor's parameters in the order of a fit."""

FOOTPRINT = PIXEL + LEAST_BLUR**2
"""Assumed variance of a pixel's footprint, square pixels; the parameter is the relative error of it."""

_STENCIL = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0  # first derivative at the middle
MARGIN = 3
"""Pixels at the edge of a window whose slopes are not used."""

_ROUGH = 0.1  # share of the second difference of slopes by which a slope may differ from that of the heights
_SMOOTH = 1e-6  # weight of second differences of heights, relative to that of slopes: where nothing is seen
_SMOOTHING = 1.0  # pixels: of slopes, before their changes from pixel to pixel are computed
_OUTLIER_RATIO = 3.0  # pixels with a larger misfit are excluded; times the usual misfit
_PIECE = 96  # rows of products
_SLOPE_WEIGHT = 1e3  # of a slope by the wave of a pixel
NOT_FOLLOWED = (
    "the brightness does not follow the turn. Press deeper, on something with relief, and check phases, tilt"
    " and pivot"
)
"""Why a touch is not used that does not fit the model."""

TURNS = np.linspace(-math.pi, math.pi, 24, endpoint=False)
"""Angles by which azimuths are turned to find the phase of a stage, radians."""


class Poses(NamedTuple):
    """Movement of the body in a turn of T frames, as it was assumed to register them."""

    phase: Doubles  # (T, 1), radians
    tilt: float  # half-angle, radians
    arm: float | None  # mm from the pivot up to the sheet's rest plane; None: frames are not registered


class _Moves(NamedTuple):
    """Changes of the slopes that pixels show in frames, (2, T, n)."""

    by_tilt: Doubles  # relative
    by_phase: Doubles
    by_pivot: Doubles  # per mm of its height


class Eliminated(NamedTuple):
    """Information of a window on the nuisances: gains and offsets of the frames, and `SHARED`."""

    own: Doubles  # (K, K)
    pull: Doubles  # (K,)
    step: Callable[[Doubles], Doubles]  # of the heights, (S * S,) mm, for a step of the nuisances


@dataclass(slots=True, eq=False)
class Window:
    """A square window of a touch: samples of its inner pixels, and the heights of its S x S pixels."""

    counts: Doubles  # (T, n), of inner pixels
    scale: PixelScale  # of inner pixels
    places: Doubles  # (5, n): terms of uneven light
    pixel_size: tuple[float, float]  # mm
    place: tuple[slice, slice]  # rows and columns of inner pixels in the picture
    usable: NDArray[np.bool_]  # (n,)
    middle: Doubles  # (S * S,): middles of the intervals of a press, mm; NaN where unknown
    half: Doubles  # (S * S,): half-widths, mm
    relief: Doubles  # (n,): heights with which inner pixels were registered, mm
    z: Doubles  # (S * S,): heights, mm
    noise_gain: float  # factor of the noise by registration
    smooth: Doubles  # (S - 6, S - 6): 1 at inner pixels whose slopes are differences across no edge, or 0
    evidence: tuple[Doubles, Doubles] | None = field(default=None)  # heights of the press, and their weights
    left: Doubles = field(default_factory=lambda: np.empty(0))  # (T, m): residuals of usable pixels
    rough: Doubles = field(default_factory=lambda: np.empty(0))  # (m,): second differences of slopes

    @property
    def size(self) -> int:
        """Pixels along a side."""
        return math.isqrt(len(self.z))

    def start(self, wave: Doubles) -> Doubles:
        """Compute first heights from zeniths and azimuths of the frames' waves, (3, n), and the press.

        Returns the misfit of these slopes to a surface if all azimuths were mirrored or not, and turned by
        `TURNS`, (2, len(TURNS)).
        """
        steepness, azimuth = np.hypot(*_slopes_of(wave)), np.arctan2(wave[2], wave[1])
        parts = [
            -steepness * np.stack([np.cos(angle), np.sin(angle)])
            for mirrored in (azimuth, -azimuth)
            for angle in (mirrored, mirrored + math.pi / 2)
        ]
        stated = np.where(np.tile(self.usable, 2), np.reshape(parts, (4, -1)), 0.0).T
        weight = _SLOPE_WEIGHT * np.tile(self.usable, 2).astype(np.float64)
        slopes, firm = _slopes(self.size, self.pixel_size), self._press_weight()
        same = _SLOPE_WEIGHT * self.usable
        solver = _Solver(self.pixel_size, np.stack([same, np.zeros_like(same), same]), firm)
        known = np.nan_to_num(self.middle) * firm
        right = np.column_stack([slopes.T @ (weight[:, np.newaxis] * stated), known])
        *by_slopes, by_press = solver.backward(solver.forward(right)).T
        misfits = np.empty((2, len(TURNS)))
        for kind, turn in np.ndindex(misfits.shape):
            share = math.cos(TURNS[turn]), math.sin(TURNS[turn])
            z = by_press + share[0] * by_slopes[2 * kind] + share[1] * by_slopes[2 * kind + 1]
            slope = share[0] * stated[:, 2 * kind] + share[1] * stated[:, 2 * kind + 1]
            misfits[kind, turn] = np.sum(weight * (slopes @ z - slope) ** 2)
            misfits[kind, turn] += np.nansum(firm * (self.middle - z) ** 2)
        self.z = by_press + by_slopes[0]
        return misfits

    def _press_weight(self) -> Doubles:
        return np.nan_to_num(3 / self.half**2)

    def use_intervals(self, spread: IntervalScatter) -> None:
        """Take heights of the press from their intervals, at the present heights."""
        known = np.isfinite(self.middle)
        height, weight = self.z.copy(), np.zeros(len(self.z))
        found = interval_evidence(self.z[known], self.middle[known], self.half[known], spread)
        height[known], weight[known] = found
        self.evidence = height, weight

    def look(self, poses: Poses, gains: Doubles, offsets: Doubles, values: Doubles) -> Sums:
        """Compute residuals, and return the normal equations of slopes of usable pixels and nuisances."""
        named, chosen = dict(zip(SHARED, values.tolist(), strict=True)), self.usable
        inner = self.size - 2 * MARGIN
        maps = (_slopes(self.size, self.pixel_size) @ self.z).reshape(2, inner, inner)
        maps *= 1 - named["pixel_size"]
        slopes = maps.reshape(2, -1)[:, chosen]
        by_column, by_row = self._changes(maps)
        turned = poses.phase + named["phase"]
        double = np.cos(2 * turned), np.sin(2 * turned)
        larger = (1 + named["tilt"]) * (1 + named["oval_x"] * double[0] + named["oval_y"] * double[1])
        ahead = named["phase"] + named["oval_y"] * double[0] - named["oval_x"] * double[1]
        tilt, phase = poses.tilt * larger, poses.phase + ahead
        moves = self._moves(poses, by_column, by_row)
        seen = slopes[:, np.newaxis] + (larger - 1) * moves.by_tilt + ahead * moves.by_phase
        seen = seen + named["pivot_z"] * moves.by_pivot
        angles = SlopeAngles.of(seen, phase, tilt, (by_column, by_row))
        bend = FOOTPRINT * angles.bend
        levels = self.scale
        scale = PixelScale(levels.gain[chosen], levels.base[chosen], levels.dark[chosen], levels.full)
        light = light_of(
            angles, (1 + named["footprint"]) * bend, scale, gains[:, np.newaxis], offsets[:, np.newaxis],
            values[: len(GLOBALS) + UNEVEN], self.places[:, chosen],
        )  # fmt: skip
        self.left = self.counts[:, chosen] - scale.dark - light.light
        by_slope = light.by_angle * angles.by_slopes
        tilt_row = light.by_globals[GLOBALS.index("tilt")]
        phase_row = light.by_globals[GLOBALS.index("phase")]
        tilt_row *= poses.tilt
        tilt_row += np.sum(by_slope * moves.by_tilt, axis=0)
        phase_row += np.sum(by_slope * moves.by_phase, axis=0)
        rest = np.concatenate([
            light.by_globals,
            [
                tilt_row * double[0] - phase_row * double[1],
                tilt_row * double[1] + phase_row * double[0],
                light.by_angle * bend,
                np.sum(by_slope * moves.by_pivot, axis=0),
                -np.sum(by_slope * slopes[:, np.newaxis], axis=0),
            ],
        ])  # fmt: skip
        self.rough = _second_differences(maps)[chosen]
        return Sums.of(self.left, by_slope, light.by_gain, rest)

    def _changes(self, maps: Doubles) -> tuple[Doubles, Doubles]:
        """Return changes of slopes, (2, S - 6, S - 6), from column to column and row to row, (2, m).

        Slopes are smoothed before, as their noise would make the surface seem more bent than it is, but not
        across edges.
        """
        share = np.maximum(cv2.GaussianBlur(self.smooth, (0, 0), _SMOOTHING), 1e-9)
        smoothed = [cv2.GaussianBlur(part * self.smooth, (0, 0), _SMOOTHING) / share for part in maps]
        by_column, by_row = (np.gradient(np.stack(smoothed), axis=axis).reshape(2, -1) for axis in (2, 1))
        return by_column[:, self.usable], by_row[:, self.usable]

    @property
    def heights(self) -> Doubles:
        """Heights of inner pixels, (n,) mm."""
        inner = slice(MARGIN, self.size - MARGIN)
        return self.z.reshape(self.size, self.size)[inner, inner].ravel()

    @property
    def misplaced(self) -> float:
        """RMS error of the heights with which frames were registered, mm."""
        return float(np.sqrt(np.mean((self.relief - self.heights)[self.usable] ** 2)))

    def _moves(self, poses: Poses, by_column: Doubles, by_row: Doubles) -> _Moves:
        """Return how the slopes that a pixel shows change if frames were registered with a wrong movement.

        A frame is sampled where the assumed movement p' = sin(tilt) (z - q) (cos(phase), sin(phase)) puts the
        point of a pixel, with the pivot's height q: the point that is seen is off by the difference.
        """
        if poses.arm is None:
            zeros = np.zeros((2, len(poses.phase), by_column.shape[1]))
            return _Moves(zeros, zeros, zeros)
        arm = poses.arm + self.relief[self.usable]
        cosine, sine = np.cos(poses.phase), np.sin(poses.phase)
        x, y = by_column[:, np.newaxis] / self.pixel_size[0], by_row[:, np.newaxis] / -self.pixel_size[1]
        outwards, onwards = cosine * x + sine * y, cosine * y - sine * x  # per mm
        lean = math.sin(poses.tilt)
        by_tilt = -poses.tilt * math.cos(poses.tilt) * arm * outwards
        return _Moves(by_tilt, -lean * arm * onwards, lean * outwards)

    def exclude_outliers(self) -> None:
        """Exclude pixels that do not follow the model."""
        misfit = np.sqrt(np.mean(self.left**2, axis=0))
        self.usable[self.usable] = misfit < _OUTLIER_RATIO * float(np.median(misfit))

    def eliminate(self, sums: Sums, noise: float) -> Eliminated:
        """Return the information on the nuisances that remains after the heights are eliminated.

        ``noise`` is the variance of a sample. A slope may differ from that of the heights by a normal
        deviate; to eliminate it changes all sums by the same projection.
        """
        rough = np.maximum((_ROUGH * self.rough) ** 2, 1e-16)
        inner = np.linalg.inv(sums.matrices + (noise / rough)[:, np.newaxis, np.newaxis] * np.eye(2))
        by_cross, by_push = inner @ sums.cross, np.einsum("iab,ib->ia", inner, sums.push)
        own = sums.own - _products(_flat(sums.cross), _flat(by_cross))
        pull = sums.pull - np.einsum("iak,ia->k", sums.cross, by_push)
        matrices = sums.matrices - sums.matrices @ inner @ sums.matrices
        cross = sums.cross - sums.matrices @ by_cross
        push = sums.push - np.einsum("iab,ib->ia", sums.matrices, by_push)

        slopes = _slopes(self.size, self.pixel_size)
        slopes = slopes[np.concatenate([self.usable, self.usable])]
        slopes_x, slopes_y = slopes[: len(matrices)], slopes[len(matrices) :]
        height, weight = self.evidence or (self.middle, self._press_weight())
        spread = np.zeros((3, len(self.usable)))
        spread[:, self.usable] = matrices[:, (0, 0, 1), (0, 1, 1)].T / noise
        solver = _Solver(self.pixel_size, spread, weight)
        coupled = (slopes_x.T @ cross[:, 0] + slopes_y.T @ cross[:, 1]) / noise
        right = (slopes_x.T @ push[:, 0] + slopes_y.T @ push[:, 1]) / noise - solver.smoothing * (
            _smoothness(self.size) @ self.z
        )
        right += weight * np.where(weight > 0, height - self.z, 0.0)
        reduced = solver.forward(np.column_stack([coupled, right]))
        products = _products(reduced[:, :-1], reduced)
        own, pull = own / noise - products[:, :-1], pull / noise - products[:, -1]
        return Eliminated(own, pull, functools.partial(_step, solver, reduced))


def _step(solver: _Solver, reduced: Doubles, nuisances: Doubles) -> Doubles:
    """Return the step of heights for a step of the nuisances."""
    return solver.backward(reduced[:, -1:] - reduced[:, :-1] @ nuisances[:, np.newaxis])[:, 0]


def _second_differences(maps: Doubles) -> Doubles:
    """Return the size of second differences of maps of slopes, (2, N, N), along both axes, (N * N,)."""
    total = np.zeros(maps.shape[1:])
    for axis in (1, 2):
        middle = [slice(None)] * 2
        middle[axis - 1] = slice(1, -1)
        total[tuple(middle)] += np.sum(np.diff(maps, 2, axis=axis) ** 2, axis=0)
    return np.sqrt(total).ravel()


@functools.lru_cache(maxsize=4)
def _slopes(size: int, pixel_size: tuple[float, float]) -> Any:
    """Return the matrix from S x S heights to slopes along x and y of inner pixels, (2 n, S * S)."""
    from scipy.sparse import vstack

    along_x, along_y = _derivatives(size)
    return vstack([along_x / pixel_size[0], along_y / -pixel_size[1]]).tocsr()


@functools.cache
def _derivatives(size: int) -> tuple[Any, Any]:
    """Return matrices from S x S heights to differences along columns and rows at inner pixels."""
    from scipy.sparse import csr_matrix, diags, kron

    inner = size - 2 * MARGIN
    first = diags(list(_STENCIL), list(range(2 * MARGIN + 1)), shape=(inner, size))
    keep = csr_matrix((np.ones(inner), (np.arange(inner), np.arange(inner) + MARGIN)), (inner, size))
    return kron(keep, first).tocsr(), kron(first, keep).tocsr()


@functools.cache
def _smoothness(size: int) -> Any:
    """Return the matrix of the sum of squares of second differences of S x S heights."""
    from scipy.sparse import diags, identity, kron

    second = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(size - 2, size))
    square, eye = second.T @ second, identity(size)
    return (kron(square, eye) + kron(eye, square) + 1e-3 * identity(size * size)).tocsc()


def _flat(cross: Doubles) -> Doubles:
    return cross.reshape(-1, cross.shape[2])


def _products(first: Doubles, second: Doubles) -> Doubles:
    """Return the products of columns, in pieces that are too small for linear algebra to start threads."""
    pieces = range(0, len(first), _PIECE)
    return np.asarray(sum(first[at : at + _PIECE].T @ second[at : at + _PIECE] for at in pieces))


class _Band(NamedTuple):
    """Where the entries of the system of S x S heights are, and how they follow from weights of slopes."""

    places: NDArray[np.intp]  # (m,): in the blocks of `_Solver`
    of_slopes: Any  # (m, 3 n): from the weights of squares along x, of products, and of squares along y
    smooth: Doubles  # (m,): entries of second differences
    diagonal: NDArray[np.intp]  # (S * S,): which entries are on the diagonal


@functools.lru_cache(maxsize=4)
def _band(size: int, pixel_size: tuple[float, float]) -> _Band:
    from scipy.sparse import coo_matrix

    slopes = _slopes(size, pixel_size)
    count = slopes.shape[0] // 2
    (at_x, at_y), (by_x, by_y) = (part.reshape(2, count, -1) for part in (slopes.indices, slopes.data))
    parts = []
    for kind, at, by, other_at, other_by in (
        (0, at_x, by_x, at_x, by_x),
        (1, at_x, by_x, at_y, by_y),
        (1, at_y, by_y, at_x, by_x),
        (2, at_y, by_y, at_y, by_y),
    ):
        products = by[:, :, np.newaxis] * other_by[:, np.newaxis]
        weight = np.broadcast_to(np.arange(count)[:, np.newaxis, np.newaxis] + kind * count, products.shape)
        row = np.broadcast_to(at[:, :, np.newaxis], products.shape)
        column = np.broadcast_to(other_at[:, np.newaxis], products.shape)
        parts.append([values.ravel() for values in (row, column, products, weight)])
    smooth = _smoothness(size).tocoo()
    parts.append([smooth.row, smooth.col, smooth.data, np.full(smooth.nnz, 3 * count)])
    row, column, values, weight = (np.concatenate(each) for each in zip(*parts, strict=True))
    kept = (row >= column) & (values != 0)
    row, column, values, weight = (each[kept] for each in (row, column, values, weight))
    above = row // size - column // size
    places = ((column // size * (2 * MARGIN + 1) + above) * size + row % size) * size + column % size
    places, entry = np.unique(places, return_inverse=True)
    entries = coo_matrix((values, (entry, weight)), (len(places), 3 * count + 1)).tocsc()
    on_diagonal = row == column
    diagonal = np.zeros(size * size, np.intp)
    diagonal[row[on_diagonal]] = entry[on_diagonal]
    return _Band(places, entries[:, :-1].tocsr(), entries[:, -1].toarray()[:, 0], diagonal)


class _Solver:
    """Cholesky factor L of the banded, symmetric system of a window of S x S heights.

    It consists of blocks of S x S, one for each row of the window, that are too small for linear algebra to
    start threads, which would wait for those of other users and of OpenCL.
    """

    _REACH = 2 * MARGIN  # rows of the window that a row depends on

    def __init__(self, pixel_size: tuple[float, float], of_slopes: Doubles, of_heights: Doubles) -> None:
        """Decompose the system with weights of slopes, (3, n), see `_Band`, and of heights, (S * S,)."""
        size = self._size = math.isqrt(len(of_heights))
        band = _band(size, pixel_size)
        entries = band.of_slopes @ of_slopes.ravel()
        entries[band.diagonal] += of_heights
        self.smoothing = _SMOOTH * float(np.mean(entries[band.diagonal]))
        blocks = np.zeros((size + self._REACH, 1 + self._REACH, size, size))
        blocks.ravel()[band.places] = entries + self.smoothing * band.smooth
        self._inverse = np.empty((size, size, size))  # of blocks of L on the diagonal
        self._below = np.empty((size, self._REACH, size, size))
        for number in range(size):
            self._inverse[number] = np.linalg.inv(np.linalg.cholesky(blocks[number, 0]))
            below = np.matmul(blocks[number, 1:], self._inverse[number].T, out=self._below[number])
            for further in range(self._REACH):
                blocks[number + 1 + further, : self._REACH - further] -= below[further:] @ below[further].T

    def forward(self, right: Doubles) -> Doubles:
        """Return L^-1 times right sides, (S * S, k)."""
        rows = self._rows(right)
        for number, inverse in enumerate(self._inverse):
            rows[number] = inverse @ rows[number]
            rows[number + 1 : number + 1 + self._REACH] -= self._below[number] @ rows[number]
        return rows[: self._size].reshape(right.shape)

    def backward(self, right: Doubles) -> Doubles:
        """Return L^-T times right sides, (S * S, k)."""
        rows = self._rows(right)
        for number in reversed(range(self._size)):
            further = rows[number + 1 : number + 1 + self._REACH]
            rows[number] -= np.sum(self._below[number].transpose(0, 2, 1) @ further, axis=0)
            rows[number] = self._inverse[number].T @ rows[number]
        return rows[: self._size].reshape(right.shape)

    def _rows(self, right: Doubles) -> Doubles:
        rows = np.zeros((self._size + self._REACH, self._size, right.shape[1]))
        rows[: self._size] = right.reshape(self._size, self._size, -1)
        return rows


# --- reading ------------------------------------------------------------------------------------------------

_FRAMES = 32  # frames of a turn that are used, at most, evenly spaced
_LEAST_FRAMES = 4
_SIDE = 48  # pixels along a side of a window
_LEAST_SIDE = 16
_WINDOWS = 2  # of a touch, at most
_AROUND = 2 * MARGIN + BORDER  # pixels next to the inner ones of a window on which they depend
_LEAST_USABLE = 0.05  # share of the pixels of a window at which the model holds
_LEAST_NOISE = 0.3  # counts of 8 bits: rounding
_FLICKER = 4.0  # the light of frames may differ by this times the usual standard deviation, unless stated
_FLOOR = 1e-12  # variance that keeps covariances of gains and offsets without their means regular
_LEVEL = 1.5  # tilts: zenith below which the wave of a pixel tells it better than the mean
_GENTLE = 3.0  # tilts: zenith up to which the amplitude of a wave may be any
_NEAR_AXIS = 0.5  # tilts: least difference of a zenith from the tilt, where the normal passes the axis
_VARIED = 0.2  # least scatter of the slopes of a touch, relative to the usual one
_STEEPEST = math.radians(80)
_EDGE = 4.0  # standard deviations between heights of neighbours, beyond their slope: an edge
_STEEPER = 1.2  # factor of slopes: they are approximate
_SWING = 0.4, 2.5  # range of the amplitude of the zenith, in tilts, from which the half-angle is guessed


class SensorModel(NamedTuple):
    """What is assumed of the sensor before a fit: the parameters of touches are relative to it."""

    gain: Doubles  # (H, W): counts per radian of zenith
    base: Doubles  # (H, W): counts at zenith 0
    dark: Doubles  # (H, W)
    full: float | None  # full light, counts; None: the brightest sample
    tilt: float
    pivot: tuple[float, float, float] | None  # None: frames are not registered


@dataclass(slots=True, eq=False)
class Touch:
    """Samples of a touch, and the gains and offsets of its frames."""

    name: str
    windows: list[Window]
    poses: Poses
    phase: Doubles  # (T,)
    frame_covariance: Doubles  # (2 T, 2 T)
    frame_values: Doubles  # (2 T,): gains and offsets of the frames
    least_noise: float  # counts
    time: float  # seconds since 1970; NaN if unknown
    tilt_seen: float  # radians: half-angle that the amplitude of the brightness shows
    misfits: Doubles  # of first slopes to surfaces; see `Window.start`
    varied: bool  # whether its slopes are not all alike
    is_warm: bool  # whether its surfaces are those of an earlier fit
    noise: float = 1.0  # variance of a sample

    @property
    def reason(self) -> str:
        """Why the touch is not used."""
        if not self.windows:
            return "it shows hardly any light in contact. Press deeper, on a larger object"
        if not self.varied:
            return "its slopes are all alike, as those of a plate or an edge. Touch something rough or round"
        return NOT_FOLLOWED

    def follows(self) -> bool:
        """Return whether samples differ from the fit hardly more than from any two waves of a pixel."""
        counts = np.concatenate([window.counts[:, window.usable] for window in self.windows], axis=1)
        left = np.concatenate([window.left for window in self.windows], axis=1)
        return follow_model(counts, left, self.phase, 1, self.least_noise)


def model_of(turn: Source, header: Header) -> SensorModel:
    """Return what the header of a recording states of the sensor."""
    shape = turn.shape[1:]
    if header.zenith_gain is None:
        raise InputError(
            f"{turn.name} has no zenith gain: touches improve an approximate one. Give it, such as"
            " --zenith-gain 360 --zenith-offset -60"
        )
    if header.tilt is None:
        raise InputError(f"{turn.name} has no tilt: give an approximate one, as in --tilt 2.5deg")
    gain, base, dark = (
        np.broadcast_to(np.asarray(0.0 if values is None else values, np.float64), shape)
        for values in (header.zenith_gain, header.zenith_offset, header.dark)
    )
    full = None
    if header.bright is not None:
        span = header.bright - np.asarray(0.0 if header.dark is None else header.dark, np.float64)
        full = float(np.nanmedian(span))
    pivot = header.pivot if header.pivot is not None else (0.0, 0.0, 0.0)
    return SensorModel(gain, base, dark, full, header.tilt, None if header.press is None else pivot)


@dataclass(frozen=True, slots=True)
class TouchReader:
    """A press and a turn at the same place, which can be read with other movements."""

    turn: Source
    middle: Doubles  # (H, W): heights of the press, mm; NaN where unknown
    half: Doubles  # (H, W): half-widths of their intervals, mm
    relief: Doubles  # (H, W): heights that register frames, mm
    device: str | Device | None
    earlier: Touch | None = None  # the same touch, read with almost the same movement

    @classmethod
    def of(cls, press: Source, turn: Source, device: str | Device | None = None) -> TouchReader:
        """Read a press."""
        shape = turn.shape[1:]
        if min(shape) < _LEAST_SIDE:
            raise InputError(
                f"{turn.name} has {shape[1]} x {shape[0]} pixels: at least {_LEAST_SIDE} a side are needed"
            )
        if press.motion != "vertical":
            raise InputError(f"{press.name} has {press.motion} motion: give a press and a turn of each touch")
        if press.shape[1:] != shape:
            raise InputError(f"{press.name} and {turn.name} have pictures of different sizes")
        pressed, evidence = press_evidence(press, {"device": device})
        relief = np.asarray(pressed.height, np.float64)
        if not np.isfinite(relief).any():
            raise InputError(f"no pixel of {press.name} turned light: press deeper, or leave it out")
        half = math.sqrt(3) * evidence.heights.sigma
        return cls(turn, evidence.heights.height, half, fill_with_nearest(relief), device)

    def with_heights(self, touch: Touch) -> TouchReader:
        """Return the reader with the surfaces of a touch, to register frames and to start with."""
        relief = self.relief.copy()
        for window in touch.windows:
            part = relief[window.place]
            usable = window.usable.reshape(part.shape)
            part[usable] = window.heights[window.usable]
        return replace(self, relief=relief, earlier=touch)

    def read(self, sensor: SensorModel, sense: int, ahead: float) -> Touch:
        """Read the turn, with its phases times ``sense``, 1 or -1, plus ``ahead``, radians."""

        def turned(block: Block) -> Block:
            return block if block.phase is None else replace(block, phase=sense * block.phase + ahead)

        source: Source = self.turn
        if sense < 0 or ahead:
            source = EditedSource(source, turned)
        registered = None
        if sensor.pivot is not None:
            header = replace(source.header, pivot=sensor.pivot, tilt=sensor.tilt)
            source = registered = Registered(source, self.relief, device=self.device, header=header)
        frames, phase = read_turn(source, _FRAMES)
        if len(phase) < _LEAST_FRAMES:
            raise InputError(f"{source.name} has {len(phase)} frames: at least {_LEAST_FRAMES} are needed")
        noise_gain = 1.0 if registered is None else float(np.nanmedian(registered.noise_gain))
        with naming(self.turn):
            return self._touch(frames, phase, noise_gain, sensor)

    def _touch(self, frames: NDArray[Any], phase: Doubles, noise_gain: float, sensor: SensorModel) -> Touch:
        header, shape = self.turn.header, self.turn.shape[1:]
        whole: NDArray[np.bool_] = np.asarray(valid(frames).all(axis=0))
        for level in (sensor.gain, sensor.base, sensor.dark):
            whole &= np.isfinite(level)
        if not whole.any():
            raise InputError("no pixel has valid samples in all frames: shorten the exposure")
        counts = frames[:, whole]
        extremes = np.array([np.min(counts), np.max(counts)], np.float64)
        if sensor.full is None:
            sensor = sensor._replace(full=float(np.max(counts - sensor.dark[whole])))
        if self.earlier is None:
            part = slice(0, shape[0]), slice(0, shape[1])
            view = self._view(frames, phase, whole, sensor, part)
            views = [(place, view) for place in _places(view.usable, view.wave)]
        else:
            views = []
            for window in self.earlier.windows:
                rows, columns = (
                    slice(max(0, each.start - _AROUND), each.stop + _AROUND) for each in window.place
                )
                place = tuple(slice(each.start - MARGIN, each.stop + MARGIN) for each in window.place)
                views.append(
                    ((place[0], place[1]), self._view(frames, phase, whole, sensor, (rows, columns)))
                )
        windows, misfits, slopes = list[Window](), np.zeros((2, len(TURNS))), list[Doubles]()
        for number, (place, view) in enumerate(views):
            window, wave = self._window(frames, sensor, noise_gain, place, view)
            if self.earlier is None:
                misfits += window.start(wave)
            else:
                window.z = self.earlier.windows[number].z
                window.usable &= self.earlier.windows[number].usable
            if not window.usable.any():
                continue
            windows.append(window)
            slopes.append(_slopes_of(wave[:, window.usable]))
        return Touch(
            name=self.turn.name,
            windows=windows,
            poses=Poses(phase[:, np.newaxis], sensor.tilt, self._arm(sensor)),
            phase=phase,
            frame_covariance=_frame_covariance(header, phase, extremes),
            frame_values=np.zeros(2 * len(phase)) if self.earlier is None else self.earlier.frame_values,
            least_noise=_LEAST_NOISE * count_of(extremes),
            time=_time_of(header),
            tilt_seen=float(np.median([view.tilt_seen for _, view in views])) if views else sensor.tilt,
            misfits=misfits,
            is_warm=self.earlier is not None,
            varied=bool(slopes) and _vary(np.concatenate(slopes, axis=1)),
        )

    def _arm(self, sensor: SensorModel) -> float | None:
        press = self.turn.header.press
        return None if sensor.pivot is None or press is None else press - sensor.pivot[2]

    def _view(
        self, frames: NDArray[Any], phase: Doubles, whole: NDArray[np.bool_], sensor: SensorModel,
        part: tuple[slice, slice],
    ) -> _View:  # fmt: skip
        """Return what frames show in a part of the picture."""
        assert sensor.full is not None
        counts, middle = frames[:, *part].astype(np.float64), self.middle[part]
        with np.errstate(invalid="ignore", divide="ignore"):
            wave = _wave((counts - sensor.base[part]) / sensor.gain[part], phase, sensor.tilt)
            tilt_seen, least = _tilt_seen(wave, sensor.tilt), np.min(counts, axis=0) - sensor.dark[part]
            gentle = (
                np.isfinite(middle) & (least > LEAST_LIGHT * sensor.full) & (wave[0] < _GENTLE * tilt_seen)
            )
            shown = whole[part] & (gentle | shows_model(wave, least, tilt_seen, sensor.full))
        usable = shown & (np.abs(wave[0] / tilt_seen - 1) > _NEAR_AXIS)
        if sensor.pivot is not None:
            usable = _without_border(usable)
        steepness = np.where(whole[part], np.tan(np.minimum(wave[0], _STEEPEST)), np.nan)
        smooth = _crosses_no_edge(middle, self.half[part], steepness, pixel_size_of(self.turn))
        return _View(part, wave, shown, usable & smooth, smooth, tilt_seen)

    def _window(
        self, frames: NDArray[Any], sensor: SensorModel, noise_gain: float, place: tuple[slice, slice],
        view: _View,
    ) -> tuple[Window, Doubles]:  # fmt: skip
        """Return the window at a place, and the waves of its inner pixels, (3, n)."""
        assert sensor.full is not None
        rows, columns = (slice(part.start + MARGIN, part.stop - MARGIN) for part in place)
        inner, seen = (rows, columns), view.of((rows, columns))
        usable, shown = view.usable[seen].ravel(), view.shown[view.of(place)]
        gain, base, dark = (
            np.where(usable, values[inner].ravel(), 1.0) for values in (sensor.gain, sensor.base, sensor.dark)
        )
        x, y = (
            axis[part] for axis, part in zip(picture_axes(frames.shape[1:]), (columns, rows), strict=True)
        )
        window = Window(
            counts=np.where(usable, frames[:, rows, columns].reshape(len(frames), -1), 0.0).astype(
                np.float64
            ),
            scale=PixelScale(gain, base, dark, sensor.full),
            places=np.stack(uneven_terms(*(axis.ravel() for axis in np.meshgrid(x, y)))),
            pixel_size=pixel_size_of(self.turn),
            place=inner,
            usable=usable,
            middle=np.where(shown, self.middle[place], np.nan).ravel(),
            half=np.where(shown, self.half[place], np.nan).ravel(),
            relief=self.relief[inner].ravel(),
            z=np.zeros(shown.size),
            noise_gain=noise_gain,
            smooth=view.smooth[seen].astype(np.float64),
        )
        return window, np.nan_to_num(view.wave[:, *seen].reshape(3, -1))


class _View(NamedTuple):
    """What frames show in a part of a picture."""

    part: tuple[slice, slice]
    wave: Doubles  # (3, H, W): see `_wave`
    shown: NDArray[np.bool_]  # (H, W): whether the model holds
    usable: NDArray[np.bool_]  # (H, W): whether samples can be used
    smooth: NDArray[np.bool_]  # (H, W): whether slopes cross no edge
    tilt_seen: float

    def of(self, place: tuple[slice, slice]) -> tuple[slice, slice]:
        """Return the rows and columns of a place of the picture in the part."""
        rows, columns = (
            slice(each.start - part.start, each.stop - part.start)
            for each, part in zip(place, self.part, strict=True)
        )
        return rows, columns


def _crosses_no_edge(
    middle: Doubles, half: Doubles, steepness: Doubles, size: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), at which the differences of heights that slopes are cross no edge.

    From one pixel to the next, heights of the press, the ``middle`` of intervals, change there by more than
    the steepness explains.
    """
    clear = np.ones(middle.shape, np.bool_)
    for axis, pixel in ((1, size[0]), (0, size[1])):
        height, width, steep = (np.moveaxis(part, axis, 0) for part in (middle, half, steepness))
        expected = _STEEPER * pixel * np.fmax(steep[1:], steep[:-1])
        expected += _EDGE * np.hypot(width[1:], width[:-1]) / math.sqrt(3)
        steps = np.pad(np.abs(np.diff(height, axis=0)) > expected, ((MARGIN, MARGIN), (0, 0)))
        for shift in range(2 * MARGIN):
            np.moveaxis(clear, axis, 0)[...] &= ~steps[shift : shift + len(height)]
    return clear


def _without_border(usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels whose registered samples are interpolated from usable ones alone.

    Where contact or the linear response ends, brightness has a bend, across which samples are wrong.
    """
    reach = np.ones((2 * BORDER + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(usable.astype(np.uint8), reach) > 0)


def _wave(angles: Doubles, phase: Doubles, tilt: float) -> Doubles:
    """Return the zenith of each pixel, and the apparent half-angle times cosine and sine of the azimuth.

    The cosines of angles to the axis, (T, H, W), are a wave of the phase: its mean is cos(zenith) cos(tilt),
    and its amplitude sin(zenith) sin(tilt), which is the better known if the zenith is less than the tilt.
    """
    mean, cosine, sine = np.einsum("kt,tij->kij", np.linalg.pinv(basis(phase)), np.cos(angles))
    zenith, size = np.arccos(np.clip(mean / math.cos(tilt), -1, 1)), np.hypot(cosine, sine)
    swing = np.arcsin(np.clip(size / np.maximum(np.sin(zenith), 1e-9), 0, 1))
    by_size = np.arcsin(np.clip(size / math.sin(tilt), 0, 1))
    zenith = np.where(zenith < _LEVEL * tilt, by_size, zenith)
    return np.stack([zenith, *(-swing * part / np.maximum(size, 1e-30) for part in (cosine, sine))])


def _slopes_of(wave: Doubles) -> Doubles:
    """Return the slopes, (2, m), of waves of zeniths, (3, m), with azimuths as they appear."""
    size = np.tan(np.clip(wave[0], 0, _STEEPEST)) / np.maximum(np.hypot(wave[1], wave[2]), 1e-30)
    return np.asarray(-size * wave[1:])


def _vary(slopes: Doubles) -> bool:
    """Return whether slopes, (2, m), differ from each other.

    Those of a plate or of a ramp change like gains and offsets of the frames, whatever is wrong.
    """
    low, middle, high = np.percentile(slopes, (16, 50, 84), axis=1)
    return bool(np.hypot(*(high - low)) / 2 > _VARIED * np.hypot(*middle))


def _tilt_seen(wave: Doubles, tilt: float) -> float:
    """Return the usual amplitude of the zenith: pixels are usable at any half-angle near the assumed one."""
    swing = np.hypot(wave[1], wave[2])
    usual = swing[(wave[0] > 3 * tilt) & (swing > _SWING[0] * tilt) & (swing < _SWING[1] * tilt)]
    return float(np.median(usual)) if usual.size else tilt


def _frame_covariance(header: Header, phase: Doubles, counts: Doubles) -> Doubles:
    """Return the covariance of gains and offsets of frames, whose means are those of the sensor."""
    gains, offsets = frame_priors(header, phase, offset_prior(header, counts))
    if header.frame_gain_sigma is None:
        gains = _FLICKER**2 * gains
    covariance = np.zeros((2 * len(phase),) * 2)
    without_mean = np.eye(len(phase)) - 1 / len(phase)
    for part, block in ((slice(None, len(phase)), gains), (slice(len(phase), None), offsets)):
        covariance[part, part] = without_mean @ block @ without_mean
    return np.asarray(covariance + _FLOOR * np.eye(len(covariance)))


def _time_of(header: Header) -> float:
    """Return the time of a recording, seconds since 1970; NaN if unknown."""
    try:
        start = datetime.fromisoformat(header.start_time)
    except ValueError:
        return math.nan
    return (start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp()


def _places(usable: NDArray[np.bool_], wave: Doubles) -> Iterator[tuple[slice, slice]]:
    """Yield the windows in which slopes vary most, without overlap."""
    side = min(_SIDE, *usable.shape)
    azimuth = np.arctan2(wave[2], wave[1])
    flat = [np.where(usable, wave[0] * turned, 0.0) for turned in (np.cos(azimuth), np.sin(azimuth))]

    def sums(values: Doubles) -> Doubles:
        table = np.pad(np.cumsum(np.cumsum(values, axis=0), axis=1), ((1, 0), (1, 0)))
        return np.asarray(
            table[side:, side:] - table[:-side, side:] - table[side:, :-side] + table[:-side, :-side]
        )

    count = sums(usable.astype(np.float64))
    spread = sum(sums(part**2) - sums(part) ** 2 / np.maximum(count, 1) for part in flat)
    score = np.where(count > _LEAST_USABLE * side**2, spread, -1.0)
    for _ in range(_WINDOWS):
        row, column = (int(number) for number in np.unravel_index(int(np.argmax(score)), score.shape))
        if score[row, column] < 0:
            return
        yield slice(row, row + side), slice(column, column + side)
        score[max(0, row - side + 1) : row + side, max(0, column - side + 1) : column + side] = -1.0
