"""Stitching: the results of several touches are merged into one larger surface."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.base.provenance import signature
from mirrorskin.engine.base.resample import SamplePoints
from mirrorskin.engine.pose.fit import PairFit
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.engine.pose.pose import IDENTITY, Pose, pose_of
from mirrorskin.io import InputError, Result, select_turn
from mirrorskin.io.base.findings import Finding, carried, with_findings
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import StitchStatus, status_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.numerics.least_squares import MEDIAN_SQUARE, second_differences
from mirrorskin.kernels.skin.pose_maps import SHARPEST

_MIN_COMMON = 0.2  # smallest share of the smaller map's pixels that two touches must have in common
_MAX_CHI2 = 4.0  # largest chi square of a link between two touches
_POSE_ITERATIONS, _NEWTON_STEPS = 5, 8  # steps for the poses, and for a height along z
_LEVELLINGS = 3  # iterations for a touch of unknown offset, because positions of pixels depend on the height
_DISAGREEMENT_Z_SCORE = 4.0  # sigmas between a touch and the mean above which they disagree
_LARGEST = 1 << 28  # largest number of pixels of the stitched surface
_UNFIT = 1e-9  # smallest information of a direction, relative to the largest


@dataclass(frozen=True, slots=True, eq=False)
class Stitch:
    """One surface of several touches.

    Attributes
    ----------
    result : Result
        Height, its standard deviation, status (0 no height, 1 one touch or touches that agree, 2 touches that
        differ by more than 4 standard deviations), contact and, if all touches have them, normals; x and y as
        in the first touch. The standard deviation includes the errors of the poses.
    poses : tuple of Pose
        The motion of the object from the first touch to each; the first one is the identity.
    links : int
        Number of pairs of touches that were compared.
    """

    result: Result
    poses: tuple[Pose, ...]
    links: int


def stitch(
    results: Sequence[Maps],
    pixel_size: ArrayLike | None = None,
    *,
    names: Sequence[str] | None = None,
    device: str | Device | None = None,
) -> Stitch:
    """Merge the maps of several touches of one object into one larger surface.

    The motion from each touch to the next is estimated by `mirrorskin.engine.pose.estimate_pose`, then the
    motions between all others that share a fifth of their pixels. The poses are a least-squares fit to all
    motions, weighted by their covariances (a pose graph: Lu and Milios, Autonomous Robots 4, 1997). Heights
    of all touches are then resampled to the pixels of the first, and merged by inverse-variance weighting.

    Parameters
    ----------
    results : sequence of Result, mapping, xarray.Dataset or path
        Two or more, each with heights, the maps for `estimate_pose`, and an overlap with an earlier one.
        An unknown offset of heights is determined from the overlap. Where heights have no standard
        deviations, as those of another program's surface, their noise is estimated, with a warning.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the results.
    names : sequence of str, optional
        Names of the results in messages, by default their paths or numbers.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Fewer than two results, one that does not overlap earlier ones, or maps that `estimate_pose` refuses.

    Examples
    --------
    >>> from mirrorskin import engine, io
    >>> def waves(at):
    ...     x, y = np.meshgrid(np.arange(-30, 31) * 0.1, np.arange(20, -21, -1) * 0.1)
    ...     p, q = 0.2 * np.cos(x - at) * np.cos(y), -0.2 * np.sin(x - at) * np.sin(y)
    ...     normals = np.dstack([-p, -q, np.ones_like(p)]) / np.sqrt(1 + p * p + q * q)[..., None]
    ...     sigma = np.full(x.shape, 0.01)
    ...     height = 0.2 * np.sin(x - at) * np.cos(y)
    ...     return io.Result(height=height, height_sigma=0.1 * sigma, normals=normals, normals_sigma=sigma)
    >>> whole = engine.pose.stitch([waves(0.0), waves(-1.0)], pixel_size=0.1)
    >>> whole.result.height.shape, (whole.poses[1].translation.round(2) + 0.0).tolist()
    ((41, 71), [-1.0, 0.0, 0.0])
    """
    if not isinstance(results, Sequence) or isinstance(results, str):
        raise InputError(f"the touches are a {type(results).__name__}: give a list of results")
    if len(results) < 2:
        raise InputError(f"{len(results)} results make no larger surface: give two or more")
    if names is None:
        names = [
            os.fspath(result) if isinstance(result, str | os.PathLike) else f"result {number}"
            for number, result in enumerate(results)
        ]
    touches = [
        select_turn(as_result(result, name), None) for result, name in zip(results, names, strict=True)
    ]
    opened = open_device(device)
    maps = []
    relative = bool(np.any(touches[0].offset_unknown)) if touches[0].offset_unknown is not None else False
    touches = [_comparable(touch, name) for touch, name in zip(touches, names, strict=True)]
    for touch, name in zip(touches, names, strict=True):
        try:
            maps.append(PoseMap.of(touch, pixel_size, opened))
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
    graph = _Graph(maps, names, opened)
    poses = graph.solve()
    merged = _merged(touches, maps, poses, names)
    if relative and merged.offset_unknown is None:
        piece = np.where(np.isfinite(merged.height), 0, -1).astype(np.int32)
        merged = merged.assign(component=piece, offset_unknown=np.ones(1, np.uint8))
    inherited = carried({}, **{str(name): touch.process for name, touch in zip(names, touches, strict=True)})
    merged = merged.assign(process={**merged.process, **inherited})
    return Stitch(merged, tuple(poses), len(graph.links))


def _comparable(touch: Result, name: str) -> Result:
    """Return a touch with what a surface file lacks: the noise of its heights, which it shows.

    Its heights count although their zero is arbitrary: the pose contains the offset.
    """
    if touch.height_sigma is not None:
        return touch
    height = touch.height
    if height is None or touch.normals is not None or min(height.shape) < 3:
        raise InputError(
            f"{name} has no height_sigma, which is needed to merge heights: reconstruct it again"
        )
    bend = second_differences(height.astype(np.float64))
    bend = bend[np.isfinite(bend)]
    rounding = float(np.finfo(np.float32).eps * np.nanmax(np.abs(height)))
    noise = max(math.sqrt(float(np.median(bend**2)) / MEDIAN_SQUARE) if bend.size else 0.0, rounding)
    text = (
        f"no standard deviations of heights: a noise of {noise:.2g} mm is estimated from second differences,"
        " without errors that neighbours share"
    )
    sigma = np.where(np.isfinite(height), np.float32(noise), np.float32(np.nan))
    if touch.offset_unknown is not None and touch.offset_unknown.size == 1:
        touch = touch.assign(component=None, offset_unknown=None)
    return with_findings(touch.assign(height_sigma=sigma), Finding("no sigma", text))


class _Graph:
    """A pose graph: touches, and the motions between pairs of them."""

    def __init__(self, maps: Sequence[PoseMap], names: Sequence[str], device: Device) -> None:
        self._maps, self._device = maps, device
        self.links: dict[tuple[int, int], Pose] = {}
        self._motions = [STILL]
        for new in range(1, len(maps)):
            self._join(new, names)
        for first in range(len(maps)):
            for second in range(first + 1, len(maps)):
                if (first, second) not in self.links:
                    self._compare(first, second)

    def _join(self, new: int, names: Sequence[str]) -> None:
        """Link a touch to the latest earlier one with enough overlap."""
        for old in range(new - 1, -1, -1):
            fit = PairFit(self._maps[old], self._maps[new], self._device)
            try:
                pose = pose_of(fit, *fit.solve())
            except InputError:
                continue
            if self._is_link(pose, old, new):
                self.links[old, new] = pose
                self._motions.append(self._motions[old].then(pose.motion))
                return
        raise InputError(f"{names[new]} shares too little with those before it: give results that overlap")

    def _compare(self, first: int, second: int) -> None:
        """Link two touches if they overlap at their current poses, and agree there."""
        start = self._motions[first].inverse().then(self._motions[second])
        fit = PairFit(self._maps[first], self._maps[second], self._device)
        if fit.equations(start).pixels < _MIN_COMMON * self._smaller(first, second):
            return
        try:
            pose = pose_of(fit, *fit.solve(start, near=True))
        except InputError:
            return
        if self._is_link(pose, first, second):
            self.links[first, second] = pose

    def _smaller(self, *numbers: int) -> int:
        return min(self._maps[number].extent.pixels for number in numbers)

    def _is_link(self, pose: Pose, first: int, second: int) -> bool:
        return pose.chi_square < _MAX_CHI2 and pose.pixels >= _MIN_COMMON * self._smaller(first, second)

    def solve(self) -> list[Pose]:
        """Return the motion from the first touch to each, by least squares over all links."""
        count, motions = 6 * (len(self._maps) - 1), self._motions
        for _ in range(_POSE_ITERATIONS):
            normal, gradient = np.zeros((count, count)), np.zeros(count)
            for (first, second), link in self.links.items():
                between = motions[first].inverse().then(motions[second])
                error = link.motion.inverse().then(between)
                rest = np.concatenate([Rotation.from_matrix(error.turn).as_rotvec(), error.shift])
                weight = _information(link)
                parts = {first: -between.adjoint(), second: np.eye(6)}
                for i, jacobian_i in parts.items():
                    for k, jacobian in parts.items():
                        if i and k:
                            normal[_part(i), _part(k)] += jacobian_i.T @ weight @ jacobian
                    if i:
                        gradient[_part(i)] -= jacobian_i.T @ weight @ rest
            covariance = np.linalg.pinv(normal, _UNFIT, hermitian=True)
            step = (covariance @ gradient).reshape(-1, 6)
            steps = zip(motions[1:], step, strict=True)
            motions = [STILL, *(motion.small_step(d, np.zeros(3)) for motion, d in steps)]
        poses = [IDENTITY]
        for number, motion in enumerate(motions[1:], 1):
            link = next(pose for (_, second), pose in self.links.items() if second == number)
            poses.append(
                replace(
                    link,
                    rotation=np.asarray(Rotation.from_matrix(motion.turn).as_rotvec()),
                    translation=motion.shift,
                    covariance=np.asarray(covariance[_part(number), _part(number)], np.float64),
                )
            )
        return poses


def _part(number: int) -> slice:
    return slice(6 * number - 6, 6 * number)


def _information(pose: Pose) -> Doubles:
    """Return the inverse of a pose's covariance, 0 along undetermined directions."""
    variance = np.diag(pose.covariance)
    lengths = np.sqrt(np.where(variance > _UNFIT**2 * variance.max(), variance, 1.0))
    scaled = pose.covariance / np.outer(lengths, lengths)
    return np.asarray(np.linalg.pinv(scaled, _UNFIT, hermitian=True) / np.outer(lengths, lengths))


def _merged(
    touches: Sequence[Result], maps: Sequence[PoseMap], poses: Sequence[Pose], names: Sequence[str]
) -> Result:
    """Resample all touches to the pixels of the first, and merge them by inverse-variance weighting."""
    x, y = _axes(maps, poses)
    shape = len(y), len(x)
    if shape[0] * shape[1] > _LARGEST:
        raise InputError(f"the whole would have {shape[1]} x {shape[0]} pixels: give results that overlap")
    sums = _Sums(shape)
    with_normals = all(touch.normals is not None and touch.normals_sigma is not None for touch in touches)
    unknown = touches[0].offset_unknown is not None and bool(np.any(touches[0].offset_unknown))
    placed: list[_Moved] = []
    for touch, map_, pose in zip(touches, maps, poses, strict=True):
        relative = unknown or (touch.offset_unknown is not None and bool(touch.offset_unknown.any()))
        before = sums if relative and placed else None
        moved = _Moved.of(touch, map_, pose, x, y, with_normals, before)
        sums.add(moved)
        placed.append(moved)
    return sums.result(placed, x, y, poses, names, unknown)


def _axes(maps: Sequence[PoseMap], poses: Sequence[Pose]) -> tuple[Doubles, Doubles]:
    """Return x and y, mm, of pixels on the first map's grid that contain all maps."""
    x, y, step_x, step_y = maps[0].grid
    moved = [pose.inverse().apply(map_.points)[:, :2] for map_, pose in zip(maps, poses, strict=True)]
    points = np.concatenate(moved)
    (lowest_x, low), (highest_x, high) = points.min(axis=0), points.max(axis=0)
    columns = np.arange(np.round((lowest_x - x) / step_x), np.round((highest_x - x) / step_x) + 1)
    rows = np.arange(np.round((y - high) / step_y), np.round((y - low) / step_y) + 1)
    return x + columns * step_x, y - rows * step_y


@dataclass(frozen=True, slots=True, eq=False)
class _Moved:
    """A touch at the pixels of the first one: (H, W), NaN without a height."""

    height: Doubles
    variance: Doubles  # including that of the pose and of a determined offset
    common: Doubles  # variance of errors common to all pixels: of the pose and the offset
    contact: NDArray[np.bool_]
    normals: Doubles | None
    normal_variance: Doubles | None

    @classmethod
    def of(
        cls,
        touch: Result,
        map_: PoseMap,
        pose: Pose,
        x: Doubles,
        y: Doubles,
        with_normals: bool,
        before: _Sums | None,
    ) -> _Moved:
        """Move a touch; an unknown offset is determined from earlier touches."""
        assert touch.height is not None
        x0, y0, step_x, step_y = map_.grid
        height = np.asarray(touch.height, np.float32).copy()
        if touch.filled is not None:
            height[touch.filled != 0] = np.nan
        across, up = (part.ravel() for part in np.meshgrid(x, y))
        motion, size = pose.motion, (len(y), len(x))
        down, right = np.gradient(height)
        slopes = right / step_x, -down / step_y
        above = np.full(across.shape, float(np.nanmedian(pose.inverse().apply(map_.points)[:, 2])))
        level, middle, of_level = 0.0, np.zeros(6), 0.0
        for _ in range(1 if before is None else _LEVELLINGS):
            motion = Motion(motion.turn, motion.shift - [0.0, 0.0, level * motion.turn[2, 2]])
            for _ in range(_NEWTON_STEPS):
                place = motion.apply(np.stack([across, up, above], axis=-1))
                points = SamplePoints.at(
                    (place[:, 0] - x0) / step_x, (y0 - place[:, 1]) / step_y, height.shape
                )
                surface = points.interpolate(height).astype(np.float64)
                here = np.nan_to_num(surface - place[:, 2])
                above = above + here / motion.turn[2, 2]
            p, q = (np.nan_to_num(points.interpolate(np.asarray(slope, np.float32))) for slope in slopes)
            upright = np.stack([-p, -q, np.ones_like(p)], axis=-1)
            steep = upright @ motion.turn[:, 2]  # change of the surface's distance per change of z
            lever = np.concatenate([np.cross(place, upright), upright], axis=-1) / steep[:, np.newaxis]
            touch_variance = (
                points.interpolate(_variance_of(touch).astype(np.float32)).astype(np.float64) / steep**2
            )
            if before is not None:
                heights = np.where(np.isfinite(surface), above, np.nan)
                level, middle, of_level = before.level(heights, touch_variance, lever)
            if not np.isfinite(level):
                break
        lever -= middle  # levelling removes the mean effect of the pose's error
        common = np.einsum("ni,ij,nj->n", lever, pose.covariance, lever) + of_level
        above, variance = above + level, touch_variance + common
        answered = np.isfinite(surface) & np.isfinite(variance)
        touched = np.isfinite(touch.height) if touch.contact is None else touch.contact != 0
        contact = points.nearest_values(touched, False) & points.inside
        normals = square = None
        if with_normals:
            assert touch.normals is not None
            assert touch.normals_sigma is not None
            normals = points.interpolate_vectors(np.asarray(touch.normals, np.float32)) @ motion.turn
            square = points.interpolate(np.asarray(touch.normals_sigma, np.float32)).astype(np.float64) ** 2
            normals, square = normals.reshape(*size, 3), square.reshape(size)
        return cls(
            np.where(answered, above, np.nan).reshape(size),
            np.where(answered, variance, np.nan).reshape(size),
            np.where(answered, common, np.nan).reshape(size),
            contact.reshape(size),
            normals,
            square,
        )


def _variance_of(touch: Result) -> Doubles:
    """Return the variance of a touch's heights, (H, W); NaN if unknown."""
    sigma = np.asarray(touch.height_sigma, np.float64)
    return np.where(sigma > 0, np.maximum(sigma**2, SHARPEST), np.nan)


class _Sums:
    """Sums over touches, pixel by pixel."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._weight, self._height, self._common = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._normal_weight, self._normals = np.zeros(shape), np.zeros((*shape, 3))
        self._contact = np.zeros(shape, bool)

    def add(self, moved: _Moved) -> None:
        finite = np.isfinite(moved.height)
        weight = np.where(finite, 1 / moved.variance, 0.0)
        self._weight += weight
        self._height += weight * np.nan_to_num(moved.height)
        self._common += weight * np.nan_to_num(moved.common)
        self._contact |= moved.contact
        if moved.normals is not None and moved.normal_variance is not None:
            defined = np.isfinite(moved.normals).all(axis=-1) & (moved.normal_variance > 0)
            weight = np.where(defined, 1 / np.where(defined, moved.normal_variance, 1.0), 0.0)
            self._normal_weight += weight
            self._normals += weight[..., np.newaxis] * np.nan_to_num(moved.normals)

    def mean(self) -> Doubles:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self._height / self._weight)

    def level(self, height: Doubles, variance: Doubles, lever: Doubles) -> tuple[float, Doubles, float]:
        """Return the offset of heights, (n,), to earlier ones, its mean lever, and its variance.

        Errors of pixels are independent. Errors of the poses, which are common to pixels, are not averaged
        out; with several touches, their weighted mean is an upper bound. All values are NaN without common
        pixels.
        """
        off = self.mean().ravel() - height
        shared = np.isfinite(off) & np.isfinite(variance)
        if not shared.any():
            return np.nan, np.zeros(6), np.nan
        before = self._weight.ravel()[shared]
        weight = 1 / (variance[shared] + 1 / before)
        total = float(weight.sum())
        common = float(weight @ (self._common.ravel()[shared] / before)) / total
        middle = np.asarray(weight @ lever[shared] / total)
        return float(weight @ off[shared]) / total, middle, 1 / total + common

    def result(
        self,
        placed: Sequence[_Moved],
        x: Doubles,
        y: Doubles,
        poses: Sequence[Pose],
        names: Sequence[str],
        unknown: bool,
    ) -> Result:
        height = self.mean()
        with np.errstate(divide="ignore"):
            sigma = 1 / np.sqrt(self._weight)
        apart, spread = np.zeros(height.shape), np.zeros(height.shape)
        for moved in placed:
            off = np.nan_to_num(moved.height - height)
            apart = np.fmax(apart, off**2 / np.where(np.isfinite(moved.variance), moved.variance, 1.0))
            spread += np.where(np.isfinite(moved.variance), off**2 / moved.variance, 0.0)
        covered = self._weight > 0
        differs = covered & (apart > _DISAGREEMENT_Z_SCORE**2)
        with np.errstate(invalid="ignore", divide="ignore"):
            sigma = np.where(differs, np.maximum(sigma, np.sqrt(spread / self._weight)), sigma)
        status = np.where(
            differs,
            StitchStatus.INCONSISTENT,
            np.where(covered, StitchStatus.CONSISTENT, StitchStatus.NO_HEIGHT),
        ).astype(np.uint8)
        maps: dict[str, Any] = {}
        if self._normal_weight.any():
            with np.errstate(invalid="ignore", divide="ignore"):
                normals = self._normals / np.linalg.norm(self._normals, axis=-1, keepdims=True)
                spread = 1 / np.sqrt(self._normal_weight)
            maps["normals"] = normals.astype(np.float32)
            maps["normals_sigma"] = np.where(self._normal_weight > 0, spread, np.nan).astype(np.float32)
        if unknown:
            maps["component"] = np.where(covered, 0, -1).astype(np.int32)
            maps["offset_unknown"] = np.ones(1, np.uint8)
        process: dict[str, ProcessValue] = {**signature(), "method": "stitch", "touches": len(placed)}
        for number, (name, pose) in enumerate(zip(names, poses, strict=True)):
            process[f"touch_{number}"] = str(name)
            parts = ", ".join(f"{part:.6g}" for part in (*pose.rotation, *pose.translation))
            process[f"pose_{number}"] = f"{parts} (rad, mm)"
        return Result(
            height=np.where(covered, height, np.nan).astype(np.float32),
            height_sigma=np.where(covered, sigma, np.nan).astype(np.float32),
            status=status,
            contact=self._contact.astype(np.uint8),
            x=x,
            y=y,
            process=process,
            declarations={"status": status_of(StitchStatus)},
            **maps,
        )
