"""The rigid motion of an object between two results, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.io import InputError, Result
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.pose import BLOCK, PARTS, SUMS

Doubles = NDArray[np.float64]

_UPPER = np.triu_indices(6)
_FLOOR = 1e-5  # of the mean information: what rounding and the pixels' size leave of none
_NOISE = 1.0  # times the information that noise pretends, which a direction's own must exceed
_FEWEST = 20  # pixels that two maps must share
_COARSEST = 24  # pixels along the shorter side of the coarsest maps
_STEPS, _STILL = 40, 1e-3  # steps at most, and the step in standard deviations that ends them
_BLOCKS = 100  # whose scatter tells as much of the covariance's form as independence does
_POOR = 2.0  # chi square from which on other starts are tried
_ANGLES, _SHIFTS, _REACH, _SHARED, _TRIED = 24, 7, 0.4, 0.3, 6  # of the search
_NONE = np.zeros((6, 0))
_LONGEST = 0.35  # of the object's size: the longest step


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid motion x' = R x + t of an object, in millimetres from the picture's centre.

    Attributes
    ----------
    rotation : ndarray, (3,), float64
        Rotation vector of R: its axis times its angle, radians.
    translation : ndarray, (3,), float64
        t, mm.
    covariance : ndarray, (6, 6), float64
        Of a small rotation d (radians) and translation e (mm) after the motion, by which the true one
        differs: x' = x' + d x x' + e. Along `undetermined` it is 0, and means nothing.
    chi_square : float
        Of the fit, for each degree of freedom; 1 where the maps' sigmas say how they differ.
    pixels : int
        Pixels of the first map that have a counterpart in the second.
    undetermined : ndarray, (k, 6), float64
        Orthonormal directions (d, e) about which the maps say nothing, such as a ball's spin.
    """

    rotation: Doubles
    translation: Doubles
    covariance: Doubles
    chi_square: float
    pixels: int
    undetermined: Doubles

    @property
    def matrix(self) -> Doubles:
        """R, (3, 3)."""
        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix(), np.float64)

    @property
    def sigma(self) -> Doubles:
        """Standard deviations of the six parts, (6,); infinite where an undetermined direction has a share."""
        free = (np.abs(self.undetermined) > _SHARE).any(axis=0)
        return np.where(free, np.inf, np.sqrt(np.diag(self.covariance)))

    def apply(self, points: ArrayLike) -> Doubles:
        """Move points, (..., 3), mm."""
        return np.asarray(points, np.float64) @ self.matrix.T + self.translation


_SHARE = 1e-3


def estimate_pose(
    first: Result,
    second: Result,
    pixel_size: ArrayLike | None = None,
    *,
    start: Pose | None = None,
    device: str | Device | None = None,
) -> Pose:
    """Find how an object moved from one result to the next.
    """
    opened = open_device(device)
    maps = PoseMap.of(first, pixel_size, opened), PoseMap.of(second, pixel_size, opened)
    return PairFit(*maps, opened).pose(start)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rotation matrix and a translation."""

    turn: Doubles
    shift: Doubles

    def apply(self, points: Doubles) -> Doubles:
        """Move points, (..., 3)."""
        return points @ self.turn.T + self.shift

    def after(self, step: Doubles, centre: Doubles) -> Motion:
        """Return the motion followed by a small one about a point."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return Motion(turn @ self.turn, turn @ (self.shift - centre) + centre + step[3:])


STILL = Motion(np.eye(3), np.zeros(3))


class Equations:
    """Sums over the pixels that two maps share at some motion; lengths in units of the object's size.

    Attributes
    ----------
    pixels : float
    normal_matrix, unbiased : ndarray, (6, 6)
        J'WJ, and J'WK, in which noise of the Jacobians averages out.
    right : ndarray, (6,)
        J'Wr.
    scores : ndarray, (blocks, 6)
        The same of each block.
    chi_square : float
    """

    def __init__(self, sums: NDArray[np.float32], size: float) -> None:
        scale = np.array([1 / size] * 3 + [1.0] * 3)
        parts = np.split(sums.astype(np.float64), PARTS[1:-1], axis=1)
        upper, scores, chi, expected, self.heights, self.normals, whole = parts
        self.normal_matrix = np.zeros((6, 6))
        self.normal_matrix[_UPPER] = upper.sum(axis=0)
        self.normal_matrix += np.triu(self.normal_matrix, 1).T
        self.normal_matrix *= np.outer(scale, scale)
        self.unbiased = whole.sum(axis=0).reshape(6, 6) * np.outer(scale, scale)
        self.scores = scores * scale
        self.right = self.scores.sum(axis=0)
        self.pixels = max(float(self.normals.sum()), float(self.heights.sum()))
        self.compared = float(expected.sum())
        self.chi_square = float(chi.sum()) / max(self.compared, 1e-9)

    def free(self) -> Doubles:
        """Return orthonormal directions, (6, k), about which the maps say nothing."""
        full = self.normal_matrix + _FLOOR * np.trace(self.normal_matrix) / 6 * np.eye(6)
        told, ways = eigh((self.unbiased + self.unbiased.T) / 2, full)
        noise = _NOISE * max(self.chi_square, 1.0)
        return np.linalg.qr(ways[:, told < noise / (1 + noise)])[0]

    def covariance(self, free: Doubles) -> Doubles:
        """Return the covariance of the motion outside of some directions.

        The scatter of the blocks' scores makes it, however errors of neighbours go together. Few blocks tell
        its size but hardly its form, which is then more that of independent errors.
        """
        ways = complement(free)
        count, alone = np.count_nonzero(self.normals + self.heights), ways.T @ self.normal_matrix @ ways
        scatter = ways.T @ self.scores.T @ self.scores @ ways * count / max(count - 6, 1)
        size = np.trace(np.linalg.solve(alone, scatter)) / len(alone)
        middle = (count * scatter + _BLOCKS * size * alone) / (count + _BLOCKS)
        inverse = np.linalg.inv(ways.T @ self.unbiased @ ways)
        return np.asarray(ways @ inverse @ middle @ inverse.T @ ways.T)


def complement(free: Doubles) -> Doubles:
    """Return orthonormal directions, (6, 6 - k), at right angles to others."""
    return np.asarray(np.linalg.svd(free, full_matrices=True)[0][:, free.shape[1] :])


class PairFit:
    """Two maps on a device, and the motion between them."""

    def __init__(self, first: PoseMap, second: PoseMap, device: Device) -> None:
        self.first, self.second, self.device = first, second, device
        points = first.points()
        self.middle = points.mean(axis=0)
        self.size = float(np.sqrt(np.mean(np.sum((points - self.middle) ** 2, axis=1))))

    def equations(self, motion: Motion, beside: bool = False, step: int = 1) -> Equations:
        """Return the sums at a motion."""
        first, second = self.first, self.second
        rows, columns = first.records.shape[:2]
        side = BLOCK * step
        blocks = -(-rows // side) * -(-columns // side)
        pose = self.device.given(
            "pose",
            np.concatenate(
                [motion.turn.ravel(), motion.shift, motion.apply(self.middle), first.grid, second.grid,
                 [first.least, second.least]]
            ),
        )  # fmt: skip
        sums = self.device.array("sums", (blocks, SUMS), np.float32, zeroed=False)
        self.device.kernel("pose", "pose_equations", BESIDE=int(beside))(
            blocks,
            rows=rows,
            columns=columns,
            other_rows=second.records.shape[0],
            other_columns=second.records.shape[1],
            step=step,
            first=first.array,
            second=second.array,
            pose=pose,
            sums=sums,
            moved=32 * rows * columns // step**2,
        )
        return Equations(sums.download(), self.size)

    def pose(self, start: Motion | None = None) -> Pose:
        """Return the motion with its covariance, from a start, or from none and then from many."""
        levels = self._levels()
        found, chi_square = self._descend(levels, start or STILL)
        if start is None and not chi_square < _POOR:
            other = self._descend(levels, levels[-1].search())
            found, chi_square = min((found, chi_square), other, key=lambda one: one[1])
            start = other[0] if found is other[0] else None
        if found is None:
            raise InputError("the two maps share too few pixels: give a start, or results that overlap")
        now = self.equations(found, beside=True)
        free = now.free()
        if free.shape[1] == 6:
            raise InputError("the maps determine no motion: the surface is too plain for its noise")
        if free.shape[1]:
            again = self._descend(levels, start or STILL, free)[0]
            found = found if again is None else again
            now = self.equations(found, beside=True)
        return self._as_pose(found, now, free)

    def _as_pose(self, motion: Motion, now: Equations, free: Doubles) -> Pose:
        """Return a motion about the picture's centre, and what its equations say of it."""
        x, y, z = motion.apply(self.middle)
        moved = np.eye(6)
        moved[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        moved[:, :3] /= self.size
        return Pose(
            Rotation.from_matrix(motion.turn).as_rotvec(),
            motion.shift,
            moved @ now.covariance(free) @ moved.T,
            now.chi_square,
            int(now.pixels),
            np.linalg.qr(moved @ free)[0].T,
        )

    def _levels(self) -> list[PairFit]:
        """Return the maps from fine to coarse."""
        levels = [self]
        while min(levels[-1].first.records.shape[:2]) >= 2 * _COARSEST:
            first, second = (one.halved(self.device) for one in (levels[-1].first, levels[-1].second))
            if min(len(first.points()), len(second.points())) < _FEWEST:
                break
            levels.append(PairFit(first, second, self.device))
        return levels

    def _descend(
        self, levels: list[PairFit], start: Motion | None, free: Doubles = _NONE
    ) -> tuple[Motion | None, float]:
        """Return the motion that is found from a start, from the coarsest maps on, and its chi square."""
        motion = start
        for level in reversed(levels):
            if motion is not None:
                motion = level.refine(motion, free)
        return motion, math.inf if motion is None else self.equations(motion).chi_square

    def search(self) -> Motion | None:
        """Return the best of the motions that are found from turns about z and shifts of all sizes."""
        found = []
        for start in self._starts():
            now = self.equations(start)
            if now.pixels > _SHARED * len(self.first.points()):
                matrix = now.normal_matrix + _FLOOR * np.trace(now.normal_matrix) / 6 * np.eye(6)
                gain = now.right @ np.linalg.solve(matrix, now.right)
                found.append((now.chi_square - gain / now.compared, start))
        found.sort(key=lambda one: one[0])
        best, least = None, math.inf
        for _, start in found[:_TRIED]:
            motion = self.refine(start)
            now = None if motion is None else self.equations(motion)
            if now is not None and now.pixels > _SHARED * len(self.first.points()) and now.chi_square < least:
                best, least = motion, now.chi_square
        return best

    def _starts(self) -> Iterator[Motion]:
        extent = np.ptp(self.first.points(), axis=0)
        for angle in np.linspace(0, 2 * math.pi, _ANGLES, endpoint=False):
            turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
            for along in np.linspace(-_REACH, _REACH, _SHIFTS):
                for up in np.linspace(-_REACH, _REACH, _SHIFTS):
                    shift = np.array([along, up, 0]) * extent
                    yield Motion(turn, self.middle - turn @ self.middle + shift)

    def refine(self, motion: Motion, free: Doubles = _NONE) -> Motion | None:
        """Return the motion from which no step outside of some directions leads further; None without overlap."""
        ways, scale = complement(free), np.array([1 / self.size] * 3 + [1.0] * 3)
        for _ in range(_STEPS):
            now = self.equations(motion)
            if now.pixels < _FEWEST:
                return None
            matrix = ways.T @ now.normal_matrix @ ways
            matrix += _FLOOR / 10 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
            step = -ways @ np.linalg.solve(matrix, ways.T @ now.right)
            far = float(np.linalg.norm(step)) / (_LONGEST * self.size)
            step /= max(far, 1.0)
            motion = motion.after(step * scale, motion.apply(self.middle))
            if step @ now.normal_matrix @ step < _STILL**2 * max(now.chi_square, 1.0):
                break
        return motion
