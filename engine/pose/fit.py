"""The least-squares fit of a rigid motion between two maps, on a device."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose.correlation import SIDE, Relief, starts, turned_starts, working_pixel
from mirrorskin.engine.pose.maps import PoseMap, Workspace, coarser
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.io import InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.skin.pose import (
    BLOCK,
    COVARIANCE_AT,
    FEWEST,
    FOUND,
    INDEPENDENT,
    LEAST,
    MAX_STEP,
    NO_LIMIT,
    PARTS,
    PIXELS_AT,
    POSE,
    SHIFT_AT,
    TURN_AT,
)

MIN_COMMON = 0.2
"""Smallest share of the smaller map's pixels that two maps must share to be compared."""

_UPPER = np.zeros((6, 6), np.intp)  # index of each element of a symmetric matrix in the upper triangle
_UPPER[np.triu_indices(6)] = _UPPER.T[np.triu_indices(6)] = np.arange(21)
_MIN_INFORMATION = 1e-5  # share of the mean information that is added to all directions, for rounding errors
_LIKELY = 0.5, 0.02  # noise assumed by `Equations.free` during steps, near the solution and far from it
_MAX_CHI2 = 3.0  # chi square above which a motion is far from the solution
_COARSEST = 24  # pixels along the shorter side of the coarsest maps
MAX_STEPS, _LAST_STEP = 40, 1e-2  # maximum number of steps; step, in standard deviations, that ends them
_POOR = 2.0  # typical chi square above which other starts are tried
_ANGLES, _SHIFTS, _TRIED = 24, 13, 6  # starts of the grid: rotations, shifts per axis, and number refined
_REACH = 0.8  # maximum shift relative to the map's extent
_FINAL_STEPS = 200  # maximum number of steps at the chosen motion: they are short where pixels are coarse
_BETTER = 0.95  # chi square, relative to that of starts that are preferred, below which other ones are taken
_OTHER = 3.0  # pixels by which motions differ
_GOOD = 1.3  # typical chi square below which no further start is tried
_NONE, _ALL = np.zeros((6, 0)), np.eye(6)


class Equations:
    """Sums over the pixels that two maps share at some motion; lengths in units of the object's size.

    Attributes
    ----------
    pixels : float
    normal_matrix, unbiased : ndarray, (6, 6)
        J'WJ, and J'WK, in which the noise of the Jacobians is averaged out; J'WJ if K was not computed.
    chi_square : float
        Chi square per degree of freedom; `compared` is their number.
    """

    def __init__(self, total: Doubles, size: float) -> None:
        self._total, self._size = total, size
        chi, self.compared, heights, normals = total[27:31].tolist()
        self.normal_matrix: NDArray[Any] = total[_UPPER] * _squared_scale(size)
        self.unbiased: NDArray[Any] = self.normal_matrix
        if len(total) > PARTS[-2]:
            self.unbiased = total[PARTS[-2] :].reshape(6, 6) * _squared_scale(size)
        self.pixels: float = max(normals, heights)
        self.chi_square: float = chi / max(self.compared, 1e-9)

    @property
    def right(self) -> NDArray[Any]:
        """J'Wr, (6,)."""
        return self._total[21:27] * _scale_of(self._size)

    def scatter(self) -> tuple[NDArray[Any], int]:
        """Return the sum over blocks of the products of their J'Wr, (6, 6), and the number of blocks."""
        raise NotImplementedError

    def free(self, noise: float | None = None) -> Doubles:
        """Return orthonormal directions, (6, k), that the maps do not determine.

        The noise of the Jacobian adds spurious information on every direction, which is absent in the product
        of two Jacobians with independent noise. A direction is undetermined if more than half of its
        information is spurious; the limit is lower if the fit is worse than predicted by the standard
        deviations.
        """
        full = self.normal_matrix + _MIN_INFORMATION * np.trace(self.normal_matrix) / 6 * np.eye(6)
        eigenvalues, directions = eigh((self.unbiased + self.unbiased.T) / 2, full)
        noise = noise or max(self.chi_square, 1.0)
        return np.linalg.qr(directions[:, eigenvalues < noise / (1 + noise)])[0]

    def covariance(self, free: Doubles) -> Doubles:
        """Return the covariance of the motion, except in some directions.

        It is estimated from the scatter of the blocks' scores, so errors of adjacent pixels may be
        correlated. A few blocks determine its size but hardly its shape, which is then closer to the
        covariance of independent errors.
        """
        (products, count), independent, unbiased = self.scatter(), self.normal_matrix, self.unbiased
        directions = complement(free) if free.size else None
        if directions is not None:
            products, independent, unbiased = (
                directions.T @ matrix @ directions for matrix in (products, independent, unbiased)
            )
        inverse = np.linalg.inv(unbiased)
        alike = inverse if unbiased is independent else np.linalg.inv(independent)
        scatter = products * (count / max(count - 6, 1))
        size = np.vdot(alike, scatter) / len(independent)
        share = count / (count + INDEPENDENT)
        middle = share * scatter + ((1 - share) * size) * independent
        covariance = inverse @ middle @ inverse.T
        return np.asarray(covariance if directions is None else directions @ covariance @ directions.T)


class BlockEquations(Equations):
    """Equations from the sums of blocks, (blocks, numbers)."""

    def __init__(self, sums: NDArray[np.floating], size: float) -> None:
        super().__init__(sums.sum(axis=0, dtype=np.float64), size)
        self._sums = sums

    def scatter(self) -> tuple[NDArray[Any], int]:
        """Return the sum over blocks of the products of their J'Wr, (6, 6), and the number of blocks."""
        _, scores, _, _, heights, normals, *_ = _split(self._sums.astype(np.float64))
        scores = scores * _scale_of(self._size)
        return scores.T @ scores, int(np.count_nonzero(normals + heights))

    def after(self, step: Doubles) -> BlockEquations:
        """Return the sums after a step, (6,), for residuals that are linear in it."""
        sums = self._sums.astype(np.float64)
        upper, right, chi, *_ = _split(sums)
        step = step * _scale_of(self._size)
        added = upper[:, _UPPER] @ step
        chi += ((2 * right + added) @ step)[:, np.newaxis]
        right += added
        return BlockEquations(sums, self._size)

    @cached_property
    def typical(self) -> float:
        """Median chi square of the blocks, which is insensitive to a dent in the object."""
        _, _, chi, expected, *_ = _split(self._sums.astype(np.float64))
        used = expected > 0
        return float(np.median(chi[used] / expected[used])) if used.any() else math.inf


class Followed:
    """A motion that `PairFit.submit` searched for.

    Attributes
    ----------
    motion : Motion
    bend : float
        Error that a coarse step leaves over the square of the step, both in sigmas.
    pixels, chi_square : float
        As of `Equations`.
    """

    def __init__(self, found: NDArray[np.floating]) -> None:
        values = found.astype(np.float64)
        self.bend, self.pixels = float(found[1]), float(found[PIXELS_AT])
        self.chi_square = float(found[PIXELS_AT + 1])
        turn, shift = values[TURN_AT:SHIFT_AT].reshape(3, 3), values[SHIFT_AT:PIXELS_AT]
        self.motion: Motion = Motion(turn, shift).rigid()
        self._covariance = values[COVARIANCE_AT:][_UPPER]

    def covariance(self, free: Doubles) -> Doubles:
        """Return the covariance of the motion, except in the directions in which it was not followed."""
        return self._covariance


def _split(sums: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Divide sums, (..., numbers), into the parts listed in `PARTS`."""
    ends = PARTS[1 : PARTS.index(sums.shape[-1]) + 1]
    return [sums[..., start:end] for start, end in itertools.pairwise((0, *ends))]


@lru_cache
def _scale_of(size: float) -> Doubles:
    """Return the factors that convert rotations and translations to units of the object's size."""
    return np.repeat([1 / size, 1.0], 3)


@lru_cache
def _squared_scale(size: float) -> Doubles:
    """Return the products of these factors, (6, 6)."""
    return np.outer(_scale_of(size), _scale_of(size))


def _symmetric(upper: Doubles, size: float) -> Doubles:
    """Return the matrices, (..., 6, 6), whose upper triangles are given, in units of the object's size."""
    return np.asarray(upper[..., _UPPER] * _squared_scale(size))


def complement(free: Doubles) -> Doubles:
    """Return orthonormal directions, (6, 6 - k), orthogonal to the given ones."""
    if not free.size:
        return _ALL
    return np.asarray(np.linalg.svd(free, full_matrices=True)[0][:, free.shape[1] :])


class PairFit:
    """Two maps on a device, and the motion between them."""

    first: PoseMap
    second: PoseMap
    device: Device

    def __init__(
        self, first: PoseMap, second: PoseMap, device: Device, workspace: Workspace | None = None
    ) -> None:
        self.first, self.second, self.device = first, second, device
        self._workspace = workspace or Workspace(device)
        self._array = self._workspace.array

    def after(self, first: PoseMap) -> PairFit:
        """Return the fit of another first map to the same second one, which uses the same memory."""
        return PairFit(first, self.second, self.device, self._workspace)

    def equations(self, motion: Motion, unbiased: bool = False) -> BlockEquations:
        """Return the sums at a motion."""
        return BlockEquations(self._sums([motion], unbiased)[0], self.second.extent.size)

    def submit(self, expected: Motion, key: Array, bend: float) -> None:
        """Start the search for the motion near an expected one.

        ``key`` is that of `constants`, and ``bend`` the last one of `Followed`.
        """
        (rows, columns), turn, (x, y, z) = self.first.shape, expected.turn.tolist(), expected.shift.tolist()
        group = self.device.layout.group
        self.device.kernel("pose", "pose_follow", BESIDE=0, GROUP=group)(
            group,
            rows=rows,
            columns=columns,
            other_rows=self.second.shape[0],
            other_columns=self.second.shape[1],
            expected_x=(*turn[0], x),
            expected_y=(*turn[1], y),
            expected_z=(*turn[2], z),
            expected_bend=bend,
            key=key,
            first=self.first.records,
            second=self.second.records,
            sums=self._array("sums of blocks", self._blocks, PARTS[-2]),
            found=self._array("found", FOUND),
            moved=32 * rows * columns,
        )

    def answer(self) -> Followed | None:
        """Wait for the motion; return None if there is none, or the maps hardly match there."""
        found = self._array("found", FOUND).read()
        return Followed(found) if found[0] else None

    def constants(self, typical: float, directions: Doubles) -> Array:
        """Return what `submit` needs of two maps, on the device.

        They are the typical chi square and the directions in which the motion is followed.
        """
        first, second = self.first, self.second
        numbers = first.flat_limit, second.flat_limit, second.extent.size, typical
        projection = (directions @ directions.T).ravel()
        values = [*second.extent.middle, *first.grid, *second.grid, *numbers, *projection]
        return self.device.from_host("key", values)

    @property
    def _blocks(self) -> int:
        rows, columns = self.first.shape
        return -(-rows // BLOCK) * -(-columns // BLOCK)

    def _sums(self, motions: Sequence[Motion], unbiased: bool = False) -> NDArray[np.float32]:
        """Return the sums of each block at each motion, (n, blocks, numbers); J'WK only if ``unbiased``."""
        first, second = self.first, self.second
        (rows, columns), blocks = first.shape, self._blocks
        limits = first.flat_limit, second.flat_limit, NO_LIMIT
        maps = *second.extent.middle, *first.grid, *second.grid, *limits
        rows_of_poses = [[*motion.turn.ravel(), *motion.shift, *maps] for motion in motions]
        poses = self._array("poses", len(motions), POSE)
        poses.write(np.asarray(rows_of_poses, np.float32))
        sums = self._array("sums", len(motions), blocks, PARTS[-1 if unbiased else -2])
        self.device.kernel("pose", "pose_equations", BESIDE=int(unbiased))(
            len(motions) * blocks,
            count=len(motions),
            rows=rows,
            columns=columns,
            other_rows=second.shape[0],
            other_columns=second.shape[1],
            first=first.records,
            second=second.records,
            poses=poses,
            sums=sums,
            moved=32 * rows * columns * len(motions),
        )
        return sums.read()

    def solve(
        self, start: Motion | None = None, near: bool = False
    ) -> tuple[Motion, BlockEquations, Doubles]:
        """Return the motion, its equations, and the directions that they do not determine.

        Without a start, the identity is tried, then a search. A ``near`` start needs no coarse maps.
        """
        levels = [self] if near else self._levels
        motion, typical = self._descend(levels, start or STILL)
        for searched, guesses in self._searches() if start is None and not typical < _POOR else ():
            other, other_typical, _ = self._best_of(searched, guesses)
            if other_typical < typical:
                motion, typical, start, levels = other, other_typical, other, searched
            if typical < _POOR:
                break
        if motion is None:
            raise InputError("the two maps share too few pixels: give a start, or results that overlap")
        return self._determined(levels, motion, start or STILL)

    def solve_from(
        self, far: Sequence[Motion], near: Sequence[Motion]
    ) -> tuple[Motion, BlockEquations, Doubles]:
        """Return what `solve` does for the best of some starts: refined from coarse maps, or as precise."""
        coarse, fine = (
            (*self._best_of(levels, guesses), levels)
            for levels, guesses in ((self._levels, far), (self._fine_levels(), near))
        )
        motion, _, start, levels = coarse if coarse[1] * _BETTER < fine[1] else fine
        if motion is None:
            raise InputError("the two maps share too few pixels: give a start, or results that overlap")
        return self._determined(levels, self.refine(motion, steps=_FINAL_STEPS) or motion, start)

    def rival(self, motion: Motion, guesses: Sequence[Motion]) -> Motion | None:
        """Return a motion refined from some guesses that fits about as well as one from which it differs."""
        if not guesses:
            return None
        levels = self._fine_levels()
        middle, pixel = self.first.extent.middle, max(self.first.grid[2:])
        limit = self.equations(motion).typical / _BETTER
        for guess in guesses:
            other, typical = self._descend(levels, guess)
            if other is None or typical > limit or not self.shares_enough(other):
                continue
            if np.linalg.norm(other.apply(middle) - motion.apply(middle)) > _OTHER * pixel:
                return other
        return None

    def _determined(
        self, levels: list[PairFit], motion: Motion, start: Motion
    ) -> tuple[Motion, BlockEquations, Doubles]:
        """Return a motion, as its start along undetermined directions, and what `solve` returns."""
        now = self.equations(motion, unbiased=True)
        free = now.free()
        if free.shape[1] == 6:
            raise InputError("the maps determine no motion: the surface is too plain for its noise")
        if free.shape[1]:
            motion = self._descend(levels, start, free)[0] or motion
            now = self.equations(motion, unbiased=True)
        return motion, now, free

    def halved(self) -> PairFit:
        """Return the fit of the same maps at half their resolution."""
        first, second = coarser([self.first, self.second], min(self.first.shape) // 2)[0]
        return PairFit(first, second, self.device)

    @cached_property
    def _coarser(self) -> list[PairFit]:  # without this one: a cycle would keep its maps on the device
        """The maps at half their resolution, at a quarter, and so on."""
        pairs = itertools.takewhile(
            lambda pair: min(map_.extent.pixels for map_ in pair) >= FEWEST,
            coarser([self.first, self.second], _COARSEST),
        )
        return [PairFit(first, second, self.device) for first, second in pairs]

    @property
    def _levels(self) -> list[PairFit]:
        """The maps from fine to coarse."""
        return [self, *self._coarser]

    def _fine_levels(self) -> list[PairFit]:
        """Return those whose pixels are about as large as those of correlated maps, or smaller."""
        limit = 1.5 * working_pixel((self.first, self.second), SIDE)
        return [self, *itertools.takewhile(lambda fit: max(fit.first.grid[2:]) <= limit, self._coarser)]

    def _descend(
        self, levels: list[PairFit], start: Motion | None, free: Doubles = _NONE
    ) -> tuple[Motion | None, float]:
        """Refine a start from coarse to fine maps; return the motion and its typical chi square."""
        motion = start
        for level in reversed(levels):
            if motion is not None:
                motion = level.refine(motion, free)
        return motion, math.inf if motion is None else self.equations(motion).typical

    def _searches(self) -> Iterator[tuple[list[PairFit], list[Motion]]]:
        """Yield starts without a guess, the fastest first, and the maps by which to refine them."""
        maps = self.first, self.second
        pixel = working_pixel(maps, SIDE)
        levels = self._fine_levels()
        reliefs = Relief.of(self.first, pixel), Relief.of(self.second, pixel)
        yield levels, [start.motion for start in starts(*reliefs, MIN_COMMON)]
        yield self._levels, self._levels[-1]._from_grid()
        yield levels, [start.motion for start in turned_starts(maps, reliefs, MIN_COMMON)]

    def _best_of(
        self, levels: list[PairFit], guesses: Sequence[Motion]
    ) -> tuple[Motion | None, float, Motion]:
        """Refine motions from some guesses; return the best, its typical chi square, and its guess."""
        best, lowest, origin = None, math.inf, STILL
        for start in guesses:
            motion, typical = self._descend(levels, start)
            if motion is not None and typical < lowest and self.shares_enough(motion):
                best, lowest, origin = motion, typical, start
            if lowest < _GOOD:
                break
        return best, lowest, origin

    def shares_enough(self, motion: Motion) -> bool:
        """Return whether the maps share a fifth of the smaller one's pixels."""
        fewest = min(self.first.extent.pixels, self.second.extent.pixels)
        return self.equations(motion).pixels > MIN_COMMON * fewest

    def _from_grid(self) -> list[Motion]:
        """Return the best motions of a grid of rotations about z and shifts, after a step of Gauss-Newton.

        It finds smooth forms, which differ by little from pixel to pixel, where a correlation has no peak.
        """
        candidates: list[tuple[float, Motion]] = []
        size = self.second.extent.size
        for grid in self._grid():
            sums = self._sums(grid).sum(axis=1, dtype=np.float64)
            upper, right, chi, compared, heights, normals = _split(sums)
            overlap = np.maximum(heights, normals)[:, 0] > MIN_COMMON * self.first.extent.pixels
            matrix, slope = _symmetric(upper[overlap], size), right[overlap] * _scale_of(size)
            matrix += (
                _MIN_INFORMATION
                * np.trace(matrix, axis1=1, axis2=2)[:, np.newaxis, np.newaxis]
                / 6
                * np.eye(6)
            )
            gain = np.vecdot(slope, np.linalg.solve(matrix, slope[..., np.newaxis])[..., 0])
            merit = (chi[overlap, 0] - gain) / np.maximum(compared[overlap, 0], 1e-9)
            candidates += zip(merit, itertools.compress(grid, overlap), strict=True)
        candidates.sort(key=lambda candidate: candidate[0])
        return [motion for _, motion in candidates[:_TRIED]]

    def _grid(self) -> Iterator[list[Motion]]:
        """Yield the motions with each rotation."""
        extent, shifts = np.ptp(self.first.points, axis=0), np.linspace(-_REACH, _REACH, _SHIFTS)
        for angle in np.linspace(0, 2 * math.pi, _ANGLES, endpoint=False):
            turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
            middle = self.first.extent.middle - turn @ self.first.extent.middle
            yield [
                Motion(turn, middle + np.array([along, up, 0]) * extent) for along in shifts for up in shifts
            ]

    def refine(self, motion: Motion, free: Doubles = _NONE, steps: int = MAX_STEPS) -> Motion | None:
        """Refine a motion until steps outside of the free directions are small; None without overlap."""
        for _ in range(steps):
            now = self.equations(motion, unbiased=not free.size)
            if now.pixels < FEWEST:
                return None
            directions = complement(free if free.size else now.free(_LIKELY[now.chi_square > _MAX_CHI2]))
            if not directions.size:
                break
            motion, moved, _ = self.step(motion, now, directions)
            if moved < _LAST_STEP:
                break
        return motion

    def step(self, motion: Motion, now: Equations, directions: Doubles) -> tuple[Motion, float, Doubles]:
        """Return the motion after a Gauss-Newton step in given directions; the step in sigmas, and itself."""
        matrix = directions.T @ now.normal_matrix @ directions
        matrix += LEAST * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
        step = -directions @ np.linalg.solve(matrix, directions.T @ now.right)
        step /= max(float(np.linalg.norm(step)) / (MAX_STEP * self.second.extent.size), 1.0)
        sigmas = math.sqrt(step @ now.normal_matrix @ step / max(now.chi_square, 1.0))
        moved = motion.small_step(step * _scale_of(self.second.extent.size), self.second.extent.middle)
        return moved, sigmas, step
