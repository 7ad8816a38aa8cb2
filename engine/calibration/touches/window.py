"""Windows of touches, whose surfaces are eliminated.

The unknowns of a window are the heights z of its pixels, which are splines. A normal is that of the slopes
of z, by differences that are exact for polynomials of sixth degree; the slopes may differ from it by what
these differences leave out where the surface is rough. Frames of the turn determine the slopes, and the
press ties z to absolute heights. The light that a pixel sees is the mean over its footprint: to second
order, angles to the axis are those of the mean normal, and a term that grows with the variance of the
footprint and the square of the curvature of the surface.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.touches.heights import (
    MARGIN,
    PRODUCTS,
    SPACINGS,
    HeightSolver,
    HeightSystem,
    local_matrix,
    shortening_matrix,
    slope_matrix,
)
from mirrorskin.engine.calibration.touches.light import LinearLight, Seen
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.diagnosis.turn_light import Sums
from mirrorskin.engine.press.intervals import IntervalScatter, interval_evidence
from mirrorskin.kernels.array_types import Doubles

MOVEMENT = ("tilt", "phase", "oval_x", "oval_y", "footprint", "pivot_z", "pixel_size", "compliance")
"""Names of the parameters of movement, pixels and gel; in a fit, those of the response come before."""

_ROUGH = 0.1  # share of the second difference of slopes by which they may be wrong, in a first fit
_ROUGH_AT_END = 1.0  # the same of the difference between slopes over five and seven pixels, if it is sharp
_SMOOTHING = 1.0  # pixels: of slopes, before their changes from pixel to pixel are computed
_OUTLIER_RATIO = 3.0  # pixels with a larger misfit are excluded; times the usual misfit
_UNDER_WALL = 2.0  # the same of pixels under a wall, where a few of them tell much of one parameter or other
_NEAR = 9  # pixels around which splines must follow the surface
_LEAST_NEAR = 0.1  # share of these pixels that counts, at least
_MOST = 0.75  # least share of pixels that splines follow
_LOCALLY = 6.0  # standard deviations of chi-square there, by which finer splines are better
_CLEAR = 1.0  # the same, over all pixels
_ORDERS = np.arange(1, 5)  # of waves of an interval that show pixels at the same place in it
_BLUR = 1 / 3  # least blur of an interval's ends, in distances between places of pixels in it
_PIECE = 96  # rows of products
_SLOPE_WEIGHT = 1e3  # of a slope by the wave of a pixel
_STEEPEST = math.radians(80)

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
    """Information of a window on the nuisances: gains and offsets of the frames, and the parameters."""

    own: Doubles  # (K, K)
    pull: Doubles  # (K,)
    heights: Callable[[Doubles], Doubles]  # (S * S,) mm, for a step of the nuisances


@dataclass(slots=True, eq=False)
class Window:
    """A square window of a touch: samples of its inner pixels, and the heights of its S x S pixels."""

    counts: Doubles  # (T, n), of inner pixels
    response: LinearLight | WallLight  # of inner pixels
    pixel_size: tuple[float, float]  # mm
    place: tuple[slice, slice]  # rows and columns of inner pixels in the picture
    usable: NDArray[np.bool_]  # (n,)
    middle: Doubles  # (S * S,): middles of the intervals of a press, mm; NaN where unknown
    half: Doubles  # (S * S,): half-widths, mm
    error: Doubles  # (S * S,): standard deviations of what heights are corrected by for the gel, mm
    compliance: float  # of the gel, with which the press is corrected, 1/mm
    by_compliance: Doubles  # (S * S,): derivatives of heights of the press, mm per 1/mm; 0 where unknown
    relief: Doubles  # (n,): heights with which inner pixels were registered, mm
    z: Doubles  # (S * S,): heights, mm
    noise_gain: float  # factor of the noise by registration
    smooth: Doubles  # (S - 6, S - 6): 1 at inner pixels whose slopes are differences across no edge, or 0
    depth: tuple[float, float]  # prior of the mean height without a press, and its standard deviation, mm
    spacing: int = 1  # pixels between knots of the splines that its heights are
    relief_shown: float = math.inf  # chi-square of a pixel by the relief that the coarsest splines lack
    evidence: tuple[Doubles, Doubles] | None = field(default=None)  # heights of the press, and their weights
    risen: Doubles | float = 0.0  # (S * S,): how much higher the press shows heights by the compliance, mm
    left: Doubles = field(default_factory=lambda: np.empty(0))  # (T, m): residuals of usable pixels
    rough: Doubles = field(default_factory=lambda: np.empty(0))  # (m,): possible errors of slopes

    @property
    def size(self) -> int:
        """Pixels along a side."""
        return math.isqrt(len(self.z))

    def start(self, wave: Doubles) -> Doubles:
        """Compute first heights from zeniths and azimuths of the frames' waves, (3, n), and the press.

        Returns the misfit of these slopes to a surface if all azimuths were mirrored or not, and turned by
        `TURNS`, (2, len(TURNS)).
        """
        steepness, azimuth = np.hypot(*slopes_of_waves(wave)), np.arctan2(wave[2], wave[1])
        parts = [
            -steepness * np.stack([np.cos(angle), np.sin(angle)])
            for mirrored in (azimuth, -azimuth)
            for angle in (mirrored, mirrored + math.pi / 2)
        ]
        stated = np.where(np.tile(self.usable, 2), np.reshape(parts, (4, -1)), 0.0).T
        weight = _SLOPE_WEIGHT * np.tile(self.usable, 2).astype(np.float64)
        slopes, firm = slope_matrix(self.size, self.pixel_size), self._press_weight()
        same = _SLOPE_WEIGHT * self.usable
        of_slopes = np.zeros((len(PRODUCTS), len(same)))
        of_slopes[[PRODUCTS.index((axis, axis)) for axis in (0, 1)]] = same
        solver = HeightSystem(self.pixel_size, of_slopes, firm).solver(1)
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
        if self.is_pressed:
            self.z = by_press + by_slopes[0]
        else:  # near the heights that are given: between parts of a surface that are apart, slopes tell none
            near = np.full(len(self.z), _SLOPE_WEIGHT)
            solver = HeightSystem(self.pixel_size, of_slopes, near).solver(1)
            self.z = solver.backward(solver.forward(right[:, :1] + (near * self.z)[:, np.newaxis]))[:, 0]
        return misfits

    @property
    def is_pressed(self) -> bool:
        """Whether a press shows heights; otherwise they have an unknown constant."""
        return bool(np.isfinite(self.middle).any())

    @property
    def of_press(self) -> Doubles:
        """Middles of the intervals of the press by the present compliance, (S * S,) mm; NaN if unknown."""
        return np.asarray(self.middle + self.risen)

    def _copies(self) -> float:
        """Return how many pixels, on average, are at the same place between two steps of the press."""
        place = (self.z - self.of_press) / (2 * self.half)
        wave = np.exp(2j * np.pi * _ORDERS[:, np.newaxis] * place[np.isfinite(place)])
        return max(1.0, float(np.mean(np.abs(wave.sum(axis=1)) ** 2) / max(wave.shape[1], 1)))

    def _press_weight(self) -> Doubles:
        return np.nan_to_num(1 / (self.half**2 / 3 + self.error**2))

    def use_intervals(self, spread: IntervalScatter) -> None:
        """Take heights of the press from their intervals, at the present heights.

        Pixels at the same place between two steps count once, and the ends of intervals are not known better
        than by the distance between such places.
        """
        known, copies = np.isfinite(self.middle), self._copies()
        z, middle, half = self.z[known], self.of_press[known], self.half[known]
        distance = max(float(np.ptp(z)), 2 * float(np.median(half))) * copies / len(z)
        blur = math.hypot(max(spread.blur, _BLUR * distance), float(np.median(self.error[known])))
        found = interval_evidence(z, middle, half, spread._replace(blur=blur))
        height, weight = self.z.copy(), np.zeros(len(self.z))
        height[known], weight[known] = found.height, found.weight / copies
        self.evidence = height - self.risen, weight

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of a fit."""
        return (*self.response.names, *MOVEMENT)

    def look(self, poses: Poses, gains: Doubles, offsets: Doubles, values: Doubles, is_sharp: bool) -> Sums:
        """Compute residuals, and return the normal equations of usable pixels and nuisances.

        A pixel has two slopes, and a height, which determines where the body's movement puts its point.
        Where the surface is rough, slopes may be wrong: by less if it ``is_sharp``, near the true one and
        shown by samples that are not interpolated.
        """
        named, chosen = dict(zip(self.names, values.tolist(), strict=True)), self.usable
        self.risen = (named["compliance"] - self.compliance) * self.by_compliance
        inner = self.size - 2 * MARGIN
        maps = (slope_matrix(self.size, self.pixel_size) @ self.z).reshape(2, inner, inner)
        maps *= 1 - named["pixel_size"]
        slopes = maps.reshape(2, -1)[:, chosen]
        changes = self._changes(1 - named["pixel_size"])
        turned = poses.phase + named["phase"]
        double = np.cos(2 * turned), np.sin(2 * turned)
        larger = (1 + named["tilt"]) * (1 + named["oval_x"] * double[0] + named["oval_y"] * double[1])
        ahead = named["phase"] + named["oval_y"] * double[0] - named["oval_x"] * double[1]
        moves = self._moves(poses, slopes, *changes)
        above = (self.relief - self.heights)[chosen]
        seen = Seen(
            slopes=slopes[:, np.newaxis]
            + (larger - 1) * moves.by_tilt
            + ahead * moves.by_phase
            + (named["pivot_z"] + above) * moves.by_pivot,
            phase=poses.phase + ahead,
            tilt=poses.tilt * larger,
            changes=changes,
            heights=self.heights[chosen],
            pivot_z=named["pivot_z"],
            gains=gains[:, np.newaxis],
            offsets=offsets[:, np.newaxis],
        )
        light = self.response.of(seen, chosen, named)
        self.left = self.counts[:, chosen] - light.counts
        tilt_row = poses.tilt * light.by_tilt + np.sum(light.by_slopes * moves.by_tilt, axis=0)
        phase_row = light.by_phase + np.sum(light.by_slopes * moves.by_phase, axis=0)
        by_pivot = np.sum(light.by_slopes * moves.by_pivot, axis=0)
        of_movement = [
            tilt_row,
            phase_row,
            tilt_row * double[0] - phase_row * double[1],
            tilt_row * double[1] + phase_row * double[0],
            light.by_footprint,
            by_pivot,
            -np.sum(light.by_slopes * slopes[:, np.newaxis], axis=0),
            np.zeros(self.left.shape),  # the compliance changes heights of the press, but no light
        ]
        if is_sharp:
            shorter = shortening_matrix(self.size, self.pixel_size) @ self.z
            self.rough = _ROUGH_AT_END * np.hypot(*shorter.reshape(2, -1))[chosen]
        else:
            self.rough = _ROUGH * _second_differences(maps)[chosen]
        rest = np.concatenate([light.by_response, of_movement])
        by_unknowns = np.concatenate([light.by_slopes, [-by_pivot]])
        return Sums.of(self.left, by_unknowns, light.by_gains, rest)

    def _changes(self, scale: float) -> tuple[Doubles, Doubles]:
        """Return changes of slopes, times a factor, from column to column and row to row, (2, m)."""
        along, across, both = self._bends()
        x, y = scale / self.pixel_size[0], -scale / self.pixel_size[1]
        return np.stack([x * along, y * both]), np.stack([x * both, y * across])

    def _bends(self) -> Doubles:
        """Return second differences of heights at usable pixels, along rows, columns and both, (3, m).

        They are smoothed, as noise would make the surface seem more bent than it is, but not across edges.
        """
        z = self.z.reshape(self.size, self.size)
        bends = np.zeros((3, *z.shape))
        bends[0, :, 1:-1], bends[1, 1:-1] = np.diff(z, 2, axis=1), np.diff(z, 2, axis=0)
        bends[2] = np.gradient(np.gradient(z, axis=0), axis=1)
        clear = np.pad(self.smooth, MARGIN, "edge")
        share = np.maximum(cv2.GaussianBlur(clear, (0, 0), _SMOOTHING), 1e-9)
        inner = slice(MARGIN, -MARGIN)
        return np.stack([
            (cv2.GaussianBlur(bend * clear, (0, 0), _SMOOTHING) / share)[inner, inner].ravel()[self.usable]
            for bend in bends
        ])  # fmt: skip

    @property
    def heights(self) -> Doubles:
        """Heights of inner pixels, (n,) mm."""
        inner = slice(MARGIN, self.size - MARGIN)
        return self.z.reshape(self.size, self.size)[inner, inner].ravel()

    @property
    def misplaced(self) -> float:
        """RMS error of the heights with which frames were registered, mm."""
        return float(np.sqrt(np.mean((self.relief - self.heights)[self.usable] ** 2)))

    def _moves(self, poses: Poses, slopes: Doubles, by_column: Doubles, by_row: Doubles) -> _Moves:
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
        lean = math.sin(poses.tilt)
        rise = 1 + lean * (cosine * slopes[0] + sine * slopes[1])
        outwards, onwards = (cosine * x + sine * y) / rise, (cosine * y - sine * x) / rise  # per mm
        by_tilt = -poses.tilt * math.cos(poses.tilt) * arm * outwards
        return _Moves(by_tilt, -lean * arm * onwards, lean * outwards)

    def exclude_outliers(self) -> None:
        """Exclude pixels that do not follow the model."""
        misfit = np.sqrt(np.mean(self.left**2, axis=0))
        ratio = _OUTLIER_RATIO if isinstance(self.response, LinearLight) else _UNDER_WALL
        self.usable[self.usable] = misfit < ratio * float(np.median(misfit))

    def eliminate(self, sums: Sums, noise: float, chooses: bool) -> Eliminated:
        """Return the information on the nuisances that remains after the heights are eliminated.

        ``noise`` is the variance of a sample. A slope may differ from that of the heights by a normal
        deviate; to eliminate it changes all sums by the same projection.
        """
        rough = np.maximum(self.rough**2, 1e-16)
        of_slopes, by_slopes = sums.matrices[:, :2, :2], sums.matrices[:, :, :2]
        inner = np.linalg.inv(of_slopes + (noise / rough)[:, np.newaxis, np.newaxis] * np.eye(2))
        by_cross, by_push = inner @ sums.cross[:, :2], np.einsum("iab,ib->ia", inner, sums.push[:, :2])
        own = sums.own - _products(_flat(sums.cross[:, :2]), _flat(by_cross))
        pull = sums.pull - np.einsum("iak,ia->k", sums.cross[:, :2], by_push)
        matrices = sums.matrices - by_slopes @ inner @ np.swapaxes(by_slopes, 1, 2)
        cross = sums.cross - by_slopes @ by_cross
        push = sums.push - np.einsum("iab,ib->ia", by_slopes, by_push)

        local = local_matrix(self.size, self.pixel_size)[np.tile(self.usable, 3)]
        height, weight = self.evidence or (self.middle, self._press_weight() / self._copies())
        height = np.where(weight > 0, height + self.risen, 0.0)
        spread = np.zeros((len(PRODUCTS), len(self.usable)))
        spread[:, self.usable] = np.stack([matrices[:, first, second] for first, second in PRODUCTS]) / noise
        system = HeightSystem(self.pixel_size, spread, weight)
        level = 0.0 if self.is_pressed else float(np.mean(self.z))
        seen = push + np.einsum("iab,bi->ia", matrices, (local @ (self.z - level)).reshape(3, -1))
        coupled = local.T @ np.swapaxes(cross, 0, 1).reshape(local.shape[0], -1) / noise
        right = local.T @ seen.T.ravel() / noise
        right += weight * height
        apart = np.zeros(len(self.usable), np.bool_)
        if chooses:
            self.spacing, apart = self._choose(system, right, spread)
        solver = system.solver(self.spacing)
        own, pull = own / noise, pull / noise
        by_compliance, at = weight * self.by_compliance, MOVEMENT.index("compliance") - len(MOVEMENT)
        coupled[:, at] -= by_compliance
        own[at, at] += by_compliance @ self.by_compliance
        pull[at] -= by_compliance @ (height - self.z)
        reduced = solver.forward(np.column_stack([coupled, right]))
        products = _products(reduced[:, :-1], reduced)
        own, pull = own - products[:, :-1], pull - products[:, -1]
        pull = pull + coupled.T @ (self.z - level)
        chosen = self.usable
        self.usable = chosen & ~apart  # from the next look on
        heights = functools.partial(_heights, solver, reduced, level)
        if self.is_pressed:
            return Eliminated(own, pull, heights)
        away = float(np.mean(self.heights[chosen])) - self.depth[0]
        return _without_level(own, pull, heights, self.depth[1], away)

    def _choose(
        self, system: HeightSystem, right: Doubles, of_slopes: Doubles
    ) -> tuple[int, NDArray[np.bool_]]:
        """Return the largest spacing of knots whose splines follow the surface as well as finer ones.

        In addition, returns the few pixels at which they do not, (n,). ``of_slopes``, (3, n) or more, are the
        weights of slopes in the system.
        """
        chosen, most, finest = 1, 0, np.empty(0)
        inner, count = self.size - 2 * MARGIN, max(1, int(np.count_nonzero(self.usable)))
        near = np.maximum(self._mean_nearby(self.usable.astype(np.float64)), _LEAST_NEAR)
        left = np.zeros(len(self.usable), np.bool_)
        for spacing in SPACINGS:
            solver = system.solver(spacing)
            reduced = solver.forward(right[:, np.newaxis])
            z = solver.backward(reduced)[:, 0]
            if most:
                expected = (most - len(reduced)) / inner**2  # chi-square of a pixel, by noise
                square = self._chi_square(z - finest, of_slopes)
                nearby, rest = self._mean_nearby(square) / near, self.usable & ~left
                usual = float(np.median(nearby[rest])) if rest.any() else math.inf
                apart = nearby > usual + _LOCALLY * math.sqrt(2 * usual) / _NEAR
                followed = rest & ~apart
                if np.count_nonzero(followed) < _MOST * count:
                    break
                if np.mean(square[followed]) > expected + _CLEAR * math.sqrt(2 * expected / count):
                    break
                left |= apart & self.usable
            chosen, most, finest = spacing, len(reduced), z
        coarsest = system.solver(SPACINGS[-1])
        smooth = coarsest.backward(coarsest.forward(right[:, np.newaxis]))[:, 0]
        self.relief_shown = float(np.sum(self._chi_square(finest - smooth, of_slopes))) / count
        return chosen, left

    def _chi_square(self, z: Doubles, of_slopes: Doubles) -> Doubles:
        """Return the squares of slopes of a difference of heights, times their weights, (n,)."""
        x, y = (slope_matrix(self.size, self.pixel_size) @ z).reshape(2, -1)
        squares = zip((x * x, 2 * x * y, y * y), of_slopes, strict=False)
        return np.asarray(sum(square * weight for square, weight in squares))

    def _mean_nearby(self, values: Doubles) -> Doubles:
        """Return the mean of values of inner pixels, (n,), over the square around each."""
        inner = self.size - 2 * MARGIN
        return np.asarray(cv2.blur(values.reshape(inner, inner), (_NEAR, _NEAR)), np.float64).ravel()


def _heights(solver: HeightSolver, reduced: Doubles, level: float, nuisances: Doubles) -> Doubles:
    """Return the heights for a step of the nuisances."""
    return level + solver.backward(reduced[:, -1:] - reduced[:, :-1] @ nuisances[:, np.newaxis])[:, 0]


def _without_level(
    own: Doubles, pull: Doubles, heights: Callable[[Doubles], Doubles], sigma: float, away: float
) -> Eliminated:
    """Return the information that remains after a constant of all heights is eliminated.

    It has a standard deviation by its prior, from which it is ``away``, mm; it stays within this deviation.
    Heights only matter where the body's movement puts their points: a constant does what a lower pivot does,
    of which nothing remains.
    """
    at = MOVEMENT.index("pivot_z") - len(MOVEMENT)
    by_level, weight = -own[:, at], own[at, at] + sigma**-2
    push = -pull[at] - away * sigma**-2
    own, pull = own - np.outer(by_level, by_level) / weight, pull - by_level * push / weight
    own[at] = own[:, at] = pull[at] = 0.0

    def moved(step: Doubles) -> Doubles:
        level = float(np.clip(away + (push - by_level @ step) / weight, -sigma, sigma)) - away
        step = step.copy()
        step[at] -= level
        return np.asarray(heights(step) + level)

    return Eliminated(own, pull, moved)


def _second_differences(maps: Doubles) -> Doubles:
    """Return the size of second differences of maps of slopes, (2, N, N), along both axes, (N * N,)."""
    total = np.zeros(maps.shape[1:])
    for axis in (1, 2):
        middle = [slice(None)] * 2
        middle[axis - 1] = slice(1, -1)
        total[tuple(middle)] += np.sum(np.diff(maps, 2, axis=axis) ** 2, axis=0)
    return np.sqrt(total).ravel()


def _flat(cross: Doubles) -> Doubles:
    return cross.reshape(-1, cross.shape[2])


def _products(first: Doubles, second: Doubles) -> Doubles:
    """Return the products of columns, in pieces that are too small for linear algebra to start threads."""
    pieces = range(0, len(first), _PIECE)
    return np.asarray(sum(first[at : at + _PIECE].T @ second[at : at + _PIECE] for at in pieces))


def slopes_of_waves(wave: Doubles) -> Doubles:
    """Return the slopes, (2, m), of waves of zeniths, (3, m), with azimuths as they appear."""
    size = np.tan(np.clip(wave[0], 0, _STEEPEST)) / np.maximum(np.hypot(wave[1], wave[2]), 1e-30)
    return np.asarray(-size * wave[1:])
