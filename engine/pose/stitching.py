"""Stitching: the results of several touches are merged into one larger surface."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.base.provenance import signature
from mirrorskin.engine.base.resample import SamplePoints, fill_with_nearest
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import Motion
from mirrorskin.engine.pose.pose import Pose
from mirrorskin.engine.pose.pose_graph import PoseGraph, Poses, part
from mirrorskin.io import InputError, Result, select_turn
from mirrorskin.io.base.arguments import as_array
from mirrorskin.io.base.findings import Finding, carried, in_process, with_findings
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.io.model.maps import StitchStatus, status_of
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.numerics.least_squares import MEDIAN_SQUARE, second_differences
from mirrorskin.kernels.skin.pose_maps import SHARPEST

_NEWTON_STEPS, _LAST_STEP = 8, 1e-9  # steps for a height along z, and the step, mm, that ends them
_LEVELLINGS = 3  # iterations for touches of unknown offset, because positions of pixels depend on the height
_DISAGREEMENT_Z_SCORE = 4.0  # sigmas between a touch and the mean above which they disagree
_ALONE = 1 - 1e-6  # share of the weight above which a touch is the only one
_SAME_NOISE = 0.7, 1.4  # chi square of touches whose noise is that of their second differences
_MAX_DIFFERING = 0.02  # share of pixels with several touches that differ, above which there is a warning
_MAX_SPIKES = 0.9  # share of pixels that must remain without spikes
_LARGEST = 1 << 28  # largest number of pixels of the stitched surface


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
    offsets: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    device: str | Device | None = None,
) -> Stitch:
    """Merge the maps of several touches of one object into one larger surface.

    The touches may be in any order. The motions between pairs that share a fifth of their pixels or more are
    estimated as in `mirrorskin.engine.pose.estimate_pose`, with starts from the correlation of their heights.
    The poses are a least-squares fit to all motions, weighted by their covariances (a pose graph: Lu and
    Milios, Autonomous Robots 4, 1997), so that loops of touches close. Heights of all touches are then
    resampled to the pixels of the first, and merged by inverse-variance weighting.

    Parameters
    ----------
    results : sequence of Result, mapping, xarray.Dataset or path
        Two or more, each with heights, the maps for `estimate_pose`, and an overlap with another one.
        Unknown offsets of heights are determined from all overlaps together. Where heights have no standard
        deviations, as those of another program's surface, their noise is estimated, with a warning.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the results.
    offsets : array_like, (2,) or (n - 1, 2), optional
        Position of the centre of each field, mm along x and y, relative to the field before it: one pair for
        all, or one for each field after the first. They may be wrong by a tenth of the field. By default,
        positions are searched.
    names : sequence of str, optional
        Names of the results in messages, by default their paths or numbers.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Fewer than two results, one that does not overlap the others, or maps that `estimate_pose` refuses.

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
    places = None if offsets is None else _each_offset(offsets, len(results))
    opened = open_device(device)
    relative = bool(np.any(touches[0].offset_unknown)) if touches[0].offset_unknown is not None else False
    bare = [touch.height_sigma is None for touch in touches]
    touches = [_comparable(touch, name) for touch, name in zip(touches, names, strict=True)]
    maps = []
    for touch, name in zip(touches, names, strict=True):
        try:
            maps.append(_map_of(touch, pixel_size, opened))
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    graph = PoseGraph(maps, names, opened, places)
    found = graph.solve()
    touches = [
        _with_noise(touch, graph.differences(number)) if is_bare else touch
        for number, (touch, is_bare) in enumerate(zip(touches, bare, strict=True))
    ]
    merged = with_findings(_merged(touches, maps, found, names), *found.findings)
    if relative and merged.offset_unknown is None:
        piece = np.where(np.isfinite(merged.height), 0, -1).astype(np.int32)
        merged = merged.assign(component=piece, offset_unknown=np.ones(1, np.uint8))
    inherited = carried({}, **{str(name): touch.process for name, touch in zip(names, touches, strict=True)})
    merged = merged.assign(process={**merged.process, **inherited})
    return Stitch(merged, found.poses, len(graph.links))


def _each_offset(offsets: ArrayLike, count: int) -> list[tuple[float, float]]:
    """Return the offset of each touch after the first."""
    pairs = np.asarray(as_array("offsets", offsets, "mm"), np.float64)
    if pairs.shape not in ((2,), (1, 2), (count - 1, 2)) or not np.isfinite(pairs).all():
        raise InputError(
            f"offsets {offsets!r:.60}: give x and y in mm, once or {count - 1} times for {count} results"
        )
    return [(float(x), float(y)) for x, y in np.broadcast_to(pairs, (count - 1, 2))]


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
    sigma = np.where(np.isfinite(height), np.float32(noise), np.float32(np.nan))
    if touch.offset_unknown is not None and touch.offset_unknown.size == 1:
        touch = touch.assign(component=None, offset_unknown=None)
    return touch.assign(height_sigma=sigma)


def _with_noise(touch: Result, chi_square: float) -> Result:
    """Return a touch of estimated noise with a warning, and with the noise by which touches differ.

    The second differences of a rough surface are not of noise alone.
    """
    assert touch.height_sigma is not None
    source, sigma = "second differences", touch.height_sigma
    if not _SAME_NOISE[0] < chi_square < _SAME_NOISE[1]:
        source, sigma = "the differences of overlapping results", sigma * np.float32(math.sqrt(chi_square))
    text = (
        f"no standard deviations of heights: a noise of {np.nanmax(sigma):.2g} mm is estimated from {source},"
        " without errors that neighbours share"
    )
    return with_findings(touch.assign(height_sigma=sigma), Finding("no sigma", text))


def _map_of(touch: Result, pixel_size: ArrayLike | None, device: Device) -> PoseMap:
    """Return the map of a touch; a surface on which much would be spikes is rough, and keeps them."""
    clean = PoseMap.of(touch, pixel_size, device)
    rough = PoseMap.of(touch, pixel_size, device, spiky=False)
    return clean if clean.extent.pixels > _MAX_SPIKES * rough.extent.pixels else rough


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
    """A touch at the pixels of the first one that it covers: (h, w), NaN without a height.

    Attributes
    ----------
    rows, columns : slice
        Where it is in the whole.
    height, variance : ndarray, (h, w)
        Heights, and the variance of their own errors.
    lever : ndarray, (h, w, 6), float32
        Change of the heights per change of the pose.
    contact : ndarray, (h, w), bool
    normals, normal_variance : ndarray or None
    """

    rows: slice
    columns: slice
    height: Doubles
    variance: Doubles
    lever: NDArray[np.float32]
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
        level: float,
    ) -> _Moved:
        """Move a touch, and raise it by ``level``."""
        assert touch.height is not None
        x0, y0, step_x, step_y = map_.grid
        height = np.asarray(touch.height, np.float32).copy()
        if touch.filled is not None:
            height[touch.filled != 0] = np.nan
        back = pose.inverse().apply(map_.points)
        rows = _covering(np.sort((y[0] - back[:, 1]) / step_y), len(y))
        columns = _covering(np.sort((back[:, 0] - x[0]) / step_x), len(x))
        across, up = (part.ravel() for part in np.meshgrid(x[columns], y[rows]))
        size = rows.stop - rows.start, columns.stop - columns.start
        motion = Motion(pose.motion.turn, pose.motion.shift - [0.0, 0.0, level * pose.motion.turn[2, 2]])
        above = np.full(across.shape, float(np.nanmedian(back[:, 2])))
        for _ in range(_NEWTON_STEPS):
            place = motion.apply(np.stack([across, up, above], axis=-1))
            points = SamplePoints.at((place[:, 0] - x0) / step_x, (y0 - place[:, 1]) / step_y, height.shape)
            surface = points.interpolate(height).astype(np.float64)
            here = np.nan_to_num(surface - place[:, 2])
            above = above + here / motion.turn[2, 2]
            if np.abs(here).max() < _LAST_STEP:
                break
        down, right = np.gradient(height)
        slopes = right / step_x, -down / step_y
        p, q = (points.interpolate(fill_with_nearest(np.asarray(slope, np.float32))) for slope in slopes)
        p, q = np.nan_to_num(p), np.nan_to_num(q)
        upright = np.stack([-p, -q, np.ones_like(p)], axis=-1)
        steep = upright @ motion.turn[:, 2]  # change of the surface's distance per change of z
        lever = np.concatenate([np.cross(place, upright), upright], axis=-1) / steep[:, np.newaxis]
        variance = points.interpolate(_variance_of(touch).astype(np.float32)).astype(np.float64) / steep**2
        # Without one of the four pixels around, a height is that of a place up to half a pixel away.
        away = 1 - np.einsum("kn,kn->n", points.shares, np.isfinite(height.ravel()[points.pixels]))
        variance += away**2 * ((p * step_x) ** 2 + (q * step_y) ** 2) / steep**2
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
            rows,
            columns,
            np.where(answered, above, np.nan).reshape(size),
            np.where(answered, variance, np.nan).reshape(size),
            lever.astype(np.float32).reshape(*size, 6),
            contact.reshape(size),
            normals,
            square,
        )

    @property
    def window(self) -> tuple[slice, slice]:
        """Where it is in the whole."""
        return self.rows, self.columns

    def shared(self, other: _Moved) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
        """Return the pixels that two touches cover, as slices of each; None without any."""
        mine, theirs = [], []
        for a, b in zip(self.window, other.window, strict=True):
            start, stop = max(a.start, b.start), min(a.stop, b.stop)
            if start >= stop:
                return None
            mine.append(slice(start - a.start, stop - a.start))
            theirs.append(slice(start - b.start, stop - b.start))
        return (mine[0], mine[1]), (theirs[0], theirs[1])


def _covering(places: Doubles, length: int) -> slice:
    """Return the pixels around sorted places, of ``length`` pixels."""
    start = max(int(np.floor(places[0])) - 1, 0)
    return slice(start, max(min(int(np.ceil(places[-1])) + 2, length), start + 1))


def _variance_of(touch: Result) -> Doubles:
    """Return the variance of a touch's heights, (H, W); NaN if unknown."""
    sigma = np.asarray(touch.height_sigma, np.float64)
    return np.where(sigma > 0, np.maximum(sigma**2, SHARPEST), np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class _CommonErrors:
    """Covariances of what is wrong with all heights of a touch: its pose, and its determined offset.

    The offset's error is a linear function of the errors of all poses, ``by_poses``, and of noise.

    Attributes
    ----------
    poses : ndarray, (6 n, 6 n)
    crossed : ndarray, (6 n, n)
        Covariances of poses and offsets.
    offsets : ndarray, (n, n)
    """

    poses: Doubles
    crossed: Doubles
    offsets: Doubles

    def between(self, i: int, lever: Any, k: int, other_lever: Any) -> Doubles:
        """Return the covariances of the heights of touches i and k at the same pixels, (h, w)."""
        mine, theirs = part(i), part(k)
        poses = np.einsum("...a,ab,...b->...", lever, self.poses[mine, theirs], other_lever)
        both = lever @ self.crossed[mine, k] + other_lever @ self.crossed[theirs, i]
        return np.asarray(poses + both + self.offsets[i, k])


def _levels(
    placed: Sequence[_Moved], relative: Sequence[bool], covariance: Doubles
) -> tuple[Doubles, _CommonErrors]:
    """Return offsets, (n,), by which touches of unknown offset agree best with the others, and errors."""
    count = len(placed)
    normal, gradient, by_poses = np.zeros((count, count)), np.zeros(count), np.zeros((count, 6 * count))
    for i, k in itertools.combinations(range(count), 2):
        common = placed[i].shared(placed[k]) if relative[i] or relative[k] else None
        if common is None:
            continue
        mine, theirs = common
        off = placed[k].height[theirs] - placed[i].height[mine]
        both = np.isfinite(off)
        weight = 1 / (placed[i].variance[mine] + placed[k].variance[theirs])[both]
        total, difference = float(weight.sum()), float(weight @ off[both])
        for here, sign in ((i, 1.0), (k, -1.0)):
            normal[here, here] += total
            gradient[here] += sign * difference
            by_poses[here, part(k)] += sign * (weight @ placed[k].lever[theirs][both])
            by_poses[here, part(i)] -= sign * (weight @ placed[i].lever[mine][both])
        normal[i, k] -= total
        normal[k, i] -= total
    free = np.flatnonzero(relative)
    inverse = np.zeros((count, count))
    inverse[np.ix_(free, free)] = np.linalg.pinv(normal[np.ix_(free, free)], hermitian=True)
    by_poses = inverse @ by_poses
    crossed = covariance @ by_poses.T
    return inverse @ gradient, _CommonErrors(covariance, crossed, by_poses @ crossed + inverse)


def _merged(touches: Sequence[Result], maps: Sequence[PoseMap], found: Poses, names: Sequence[str]) -> Result:
    """Resample all touches to the pixels of the first, and merge them by inverse-variance weighting."""
    poses = found.poses
    x, y = _axes(maps, poses)
    shape = len(y), len(x)
    if shape[0] * shape[1] > _LARGEST:
        raise InputError(f"the whole would have {shape[1]} x {shape[0]} pixels: give results that overlap")
    with_normals = all(touch.normals is not None and touch.normals_sigma is not None for touch in touches)
    offsets = [touch.offset_unknown for touch in touches]
    relative = [offset is not None and bool(np.any(offset)) for offset in offsets]
    unknown = relative[0]
    free = [number > 0 and (unknown or is_relative) for number, is_relative in enumerate(relative)]
    levels = np.zeros(len(touches))
    passes = _LEVELLINGS if any(free) else 1
    for number in range(passes):
        with_them = with_normals and number == passes - 1  # levels need heights alone
        placed = [
            _Moved.of(touch, map_, pose, x, y, with_them, float(level))
            for touch, map_, pose, level in zip(touches, maps, poses, levels, strict=True)
        ]
        change, common = _levels(placed, free, found.covariance)
        levels = levels + change
    placed = [replace(moved, height=moved.height + step) for moved, step in zip(placed, change, strict=True)]
    height, sigma, status = _mean_heights(placed, common, shape)
    covered = status != StitchStatus.NO_HEIGHT
    maps_of_result: dict[str, Any] = {}
    if with_normals:
        normals, normals_sigma = _mean_normals(placed, poses, found.covariance, shape)
        maps_of_result = {"normals": normals, "normals_sigma": normals_sigma}
    if unknown:
        maps_of_result["component"] = np.where(covered, 0, -1).astype(np.int32)
        maps_of_result["offset_unknown"] = np.ones(1, np.uint8)
    contact = np.zeros(shape, np.uint8)
    for moved in placed:
        contact[moved.window] |= moved.contact
    several = np.zeros(shape, np.uint8)
    for moved in placed:
        several[moved.window] += np.isfinite(moved.height)
    process: dict[str, ProcessValue] = {**signature(), "method": "stitch", "touches": len(placed)}
    differing = (
        float(np.mean(status[several > 1] == StitchStatus.INCONSISTENT)) if np.any(several > 1) else 0.0
    )
    if differing > _MAX_DIFFERING:
        text = (
            f"results differ by more than {_DISAGREEMENT_Z_SCORE:g} sigmas in {differing:.1%} of the pixels"
            " that several of them show: a motion is wrong (state --offset), the object changed, or errors"
            " exceed their sigmas"
        )
        process |= in_process([Finding("differing results", text)], process)
    for number, (name, pose) in enumerate(zip(names, poses, strict=True)):
        process[f"touch_{number}"] = str(name)
        parts = ", ".join(f"{part:.6g}" for part in (*pose.rotation, *pose.translation))
        process[f"pose_{number}"] = f"{parts} (rad, mm)"
    if np.isfinite(found.loop_chi_square):
        process["loop_chi_square"] = found.loop_chi_square
    return Result(
        height=height.astype(np.float32),
        height_sigma=sigma.astype(np.float32),
        status=status,
        contact=contact,
        x=x,
        y=y,
        process=process,
        declarations={"status": status_of(StitchStatus)},
        **maps_of_result,
    )


def _mean_heights(
    placed: Sequence[_Moved], common: _CommonErrors, shape: tuple[int, int]
) -> tuple[Doubles, Doubles, NDArray[np.uint8]]:
    """Return the means of heights, weighted by their own variances, their sigma, and their status."""
    weight, height = np.zeros(shape), np.zeros(shape)
    for moved in placed:
        finite = np.isfinite(moved.height)
        weight[moved.window] += np.where(finite, 1 / moved.variance, 0.0)
        height[moved.window] += np.where(finite, moved.height / moved.variance, 0.0)
    covered = weight > 0
    weight = np.where(covered, weight, 1.0)
    height = np.where(covered, height / weight, np.nan)
    shares = [
        np.where(np.isfinite(moved.height), 1 / (moved.variance * weight[moved.window]), 0.0)
        for moved in placed
    ]
    with_mean = []  # covariances of each touch's common errors with those of the mean
    shared = np.zeros(shape)  # variances of the mean's common errors
    for i, moved in enumerate(placed):
        covariance = np.zeros(moved.height.shape)
        for k, other in enumerate(placed):
            both = moved.shared(other)
            if both is not None:
                mine, theirs = both
                covariance[mine] += shares[k][theirs] * common.between(
                    i, moved.lever[mine], k, other.lever[theirs]
                )
        with_mean.append(covariance)
        shared[moved.window] += shares[i] * covariance
    own = np.where(covered, 1 / weight, np.nan)
    variance = own + np.maximum(shared, 0.0)
    apart, spread = np.zeros(shape), np.zeros(shape)
    for i, moved in enumerate(placed):
        off = np.nan_to_num(moved.height - height[moved.window]) ** 2
        expected = common.between(i, moved.lever, i, moved.lever) - 2 * with_mean[i] + shared[moved.window]
        expected = np.maximum(expected, 0.0) + moved.variance * (1 - shares[i])
        several = np.isfinite(expected) & (shares[i] < _ALONE)
        ratio = np.where(several, off / np.where(several, expected, 1.0), 0.0)
        apart[moved.window] = np.maximum(apart[moved.window], ratio)
        spread[moved.window] += shares[i] * off
    differs = covered & (apart > _DISAGREEMENT_Z_SCORE**2)
    variance = np.where(differs, np.maximum(variance, spread), variance)
    status = np.where(
        differs,
        StitchStatus.INCONSISTENT,
        np.where(covered, StitchStatus.CONSISTENT, StitchStatus.NO_HEIGHT),
    )
    return height, np.sqrt(variance), status.astype(np.uint8)


def _mean_normals(
    placed: Sequence[_Moved], poses: Sequence[Pose], covariance: Doubles, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the means of normals, weighted by their own variances, and their sigma."""
    weight, normals, common = np.zeros(shape), np.zeros((*shape, 3)), np.zeros(shape)
    each = []
    for moved in placed:
        assert moved.normals is not None
        assert moved.normal_variance is not None
        defined = np.isfinite(moved.normals).all(axis=-1) & (moved.normal_variance > 0)
        each.append(np.where(defined, 1 / np.where(defined, moved.normal_variance, 1.0), 0.0))
        weight[moved.window] += each[-1]
        normals[moved.window] += each[-1][..., np.newaxis] * np.nan_to_num(moved.normals)
    covered = weight > 0
    weight = np.where(covered, weight, np.nan)
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    for i, k in itertools.product(range(len(placed)), repeat=2):
        both = placed[i].shared(placed[k])
        if both is None:
            continue
        # A rotation by d changes a normal n by d x n, whose mean square is tr(C) - n' C n.
        turns = poses[i].motion.turn, poses[k].motion.turn
        turned = turns[0].T @ covariance[part(i), part(k)][:3, :3] @ turns[1]
        (mine, theirs), window = both, placed[i].window
        n = normals[window][mine]
        square = np.trace(turned) - np.einsum("...a,ab,...b->...", n, turned, n)
        product = each[i][mine] * each[k][theirs] * square
        common[window][mine] += np.nan_to_num(product / weight[window][mine] ** 2)
    sigma = np.sqrt(1 / weight + np.maximum(common, 0.0))
    return normals.astype(np.float32), sigma.astype(np.float32)
