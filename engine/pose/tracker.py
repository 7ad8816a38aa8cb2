"""The motion of an object along a stream of results."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.pose.fit import BlockEquations, Equations, Followed, PairFit, complement
from mirrorskin.engine.pose.maps import PoseMap, Workspace
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.engine.pose.pose import IDENTITY, Pose, pose_after
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.findings import findings_of
from mirrorskin.io.base.threads import ThreadSafe, locked
from mirrorskin.io.model.result import shape_of
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.skin.pose import NO_LIMIT

MOST_KEYS = 64
"""Largest number of earlier keys that are remembered."""

_MIN_COMMON = 0.6  # share of the key's pixels below which another result becomes the key
_LEAVING = 0.1  # loss of shared pixels, as a share, after which earlier keys are compared
# Mean square error of the pose by an earlier key over that by the present one, for it to be taken again:
# while the present one is still shared, and else.
_BETTER, _GOOD_ENOUGH = 0.8, 2.0
_SIDE, _LEAST_SIDE = 100, 60  # least pixels along the shorter side of averaged maps; of smooth ones
_AS_GOOD = 1.1  # chi square, and mean square error, relative to those of finer maps, that smooth ones reach
_SEARCHED = "its motion was too large to follow, and was searched for"


class PoseTracker(ThreadSafe):
    """Estimates the motion of an object from the first result of a stream to each later one.

    Each result is compared with a key: the first result, or a later one if too few pixels overlap with the
    previous key. Errors therefore increase with the number of keys, not of results; an earlier key by which
    the pose is more certain is taken again, so they do not increase along a path that returns. The start is
    extrapolated from the last two results, and refined on every fourth row and column, then on all pixels,
    without outliers. Maps are averaged to 100 to 200 pixels along their shorter side, or to half as many if
    the surface is smooth, which hardly costs accuracy. Directions that the key does not determine are
    identified with the first result after it, and are kept fixed. If the next result shares too few pixels
    with the first one but has more, as when contact grows, it takes the place of the first. A step too large
    for this is searched as `estimate_pose` does, and noted.

    Parameters
    ----------
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the results.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Attributes
    ----------
    keys : int
        Number of results that became keys.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine, io
    >>> def waves(at):
    ...     x, y = np.meshgrid(np.arange(-30, 31) * 0.1, np.arange(20, -21, -1) * 0.1)
    ...     p, q = 0.2 * np.cos(x - at) * np.cos(y), -0.2 * np.sin(x - at) * np.sin(y)
    ...     normals = np.dstack([-p, -q, np.ones_like(p)]) / np.sqrt(1 + p * p + q * q)[..., None]
    ...     sigma = np.full(x.shape, 0.01)
    ...     height = 0.2 * np.sin(x - at) * np.cos(y)
    ...     return io.Result(height=height, height_sigma=0.1 * sigma, normals=normals, normals_sigma=sigma)
    >>> tracker = engine.pose.PoseTracker(pixel_size=0.1)
    >>> [float(tracker.push(waves(0.05 * number)).translation[0].round(2)) for number in range(3)]
    [0.0, 0.05, 0.1]
    """

    def __init__(self, pixel_size: ArrayLike | None = None, *, device: str | Device | None = None) -> None:
        self.keys: int = 0
        self._pixel_size, self._device = pixel_size, open_device(device).with_new_queue()
        self._key: _Key | None = None
        self._earlier: list[_Key] = []
        self._workspace = Workspace(self._device)  # of results that are not keys
        self._results = 0
        self._notes: tuple[str, ...] = ()  # of the last result
        self._back, self._last = STILL, STILL  # from the last result to the key, and to the one before

    def precompile(self, shape: tuple[int, int], dtype: object = None) -> None:
        """Compile what maps of a shape need, with another tracker, so that the first ones are not delayed."""
        trial = PoseTracker(1.0 if self._pixel_size is None else self._pixel_size, device=self._device)
        row, column = np.indices(shape, np.float32)
        for shift in (0.0, 0.0, 0.1):
            slopes = np.stack([np.cos(0.1 * (column - shift)), np.sin(0.07 * row)], axis=-1)
            normals = np.dstack([0.1 * slopes, np.ones(shape, np.float32)])
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
            sigma = np.full(shape, 0.01, np.float32)
            height = np.cos(0.07 * row) - np.sin(0.1 * (column - shift))
            with suppress(InputError):
                trial.push(Result(height=height, height_sigma=sigma, normals=normals, normals_sigma=sigma))

    def push(self, maps: Maps) -> Pose:
        """Return the motion from the first result to the next one, a result or maps as for `estimate_pose`.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that `estimate_pose` refuses, or too few pixels shared with earlier results. The result is
            ignored.
        """
        return self.submit(maps)()

    def submit(self, maps: Maps) -> Callable[[], Pose]:
        """Start the work on the next result, and return a function that waits for the pose of `push`.

        Call it before the next result is pushed or submitted. Arguments and errors are those of `push`.
        """
        result = as_result(maps, "result")
        self._notes = tuple(
            finding.text for finding in findings_of(f"result {self._results}", result.process)
        )
        key, started = self._key, None
        if key is not None and key.fit is not None:
            map_ = self._map(result, key.size)
            started = map_, key.submit(map_, self._last.then(self._back))
        return partial(self._answer, result, started)

    @locked
    def _answer(self, result: Result, started: tuple[PoseMap, PairFit] | None) -> Pose:
        """Return the pose of a result, whose comparison with the key may have been started."""
        pose = self._find(result, started)
        self._results += 1
        return self._noted(pose)

    def _find(self, result: Result, started: tuple[PoseMap, PairFit] | None) -> Pose:
        """Return the motion from the first result; its notes are those of the keys."""
        key = self._key
        if key is None:
            self._take_key(result, IDENTITY)
            return IDENTITY
        if started is None:
            return self._first_after_key(key, result, self._last.then(self._back))
        map_, fit = started
        maps, now = {key.size: map_}, key.answer(fit)
        if now is None:
            return self._search(key, result)
        pose = self._moved_to(now.motion, key.pose_of(fit, now.motion, now))
        share = key.share(now)
        if key.has_left(share) or share < _MIN_COMMON:
            limit = _BETTER if share > _MIN_COMMON else _GOOD_ENOUGH
            pose = self._return_to_key(result, maps, now.motion, pose, limit)
        if share < _MIN_COMMON and self._key is key:
            self._take_key(result, pose)
        return pose

    def _first_after_key(self, key: _Key, result: Result, expected: Motion) -> Pose:
        """Return the pose of the first result after a key, and determine the undetermined directions."""
        fit = PairFit(self._map(result), key.map, self._device)
        try:
            motion, now, free = fit.solve(expected, near=True)
        except InputError:  # poses start from the first result that shares enough, as when contact grows
            if self.keys == 1 and fit.first.extent.compared > key.map.extent.compared:
                self._key, self.keys = None, 0
                self._take_key(result, IDENTITY)
            raise
        key.start(fit, now, free)
        smooth = _smooth(fit, motion, now, free)
        if smooth is not None:
            key.start(*smooth, free)
            key.size *= 2
        return self._moved_to(motion, key.pose_of(fit, motion, now))

    def _search(self, key: _Key, result: Result) -> Pose:
        """Return the pose of a result that is far from the expected pose."""
        fit = PairFit(self._map(result), key.map, self._device)
        motion, now, free = fit.solve()
        pose = self._moved_to(motion, pose_after(key.pose, fit, motion, now, free))
        return replace(pose, notes=(*pose.notes, f"result {self._results}: {_SEARCHED}"))

    def _return_to_key(
        self, result: Result, maps: dict[int, PoseMap], motion: Motion, pose: Pose, limit: float
    ) -> Pose:
        """Take the earlier key again with which the pose is most certain, and return the best pose.

        ``maps`` are those of the result by the size of their pixels.
        """
        assert self._key is not None
        present, best = self._key, limit * self._key.spread(pose)
        first_to_map = present.pose.motion.then(motion.inverse())
        for key in self._earlier:
            if key.size not in maps:
                maps[key.size] = self._map(result, key.size)
            fit = key.submit(maps[key.size], first_to_map.inverse().then(key.pose.motion))
            now = key.answer(fit)
            if now is None or (share := key.share(now)) < _MIN_COMMON + _LEAVING:
                continue
            other = key.pose_of(fit, now.motion, now)
            if key.spread(other) < best:
                pose, best, key.peak = other, key.spread(other), share
                self._key, self._back = key, now.motion
        if self._key is not present:
            self._earlier = [key for key in self._earlier if key is not self._key] + [present]
        return pose

    def _moved_to(self, motion: Motion, pose: Pose) -> Pose:
        """Store the motion back to the key, and return the pose."""
        self._last = motion.then(self._back.inverse())
        self._back = motion
        return pose

    def _take_key(self, result: Result, pose: Pose) -> None:
        map_ = self._map(result)
        if self._key is not None:
            self._earlier = [*self._earlier, self._key][-MOST_KEYS:]
        self._key, self._back = _Key(map_, self._noted(pose), self._size(result)), STILL
        self.keys += 1

    def _noted(self, pose: Pose) -> Pose:
        """Return a pose with the notes of the last result."""
        if not self._notes:
            return pose
        return replace(pose, notes=tuple(dict.fromkeys((*pose.notes, *self._notes))))

    def _size(self, result: Result) -> int:
        """Return the pixels of a result along a side of one of the averaged maps."""
        name = result.name_of("height")
        return 1 if name is None else max(1, min(shape_of(result, name)) // _SIDE)

    def _map(self, result: Result, size: int = 0) -> PoseMap:
        """Return a map of a result; without a size, with second derivatives, as a key needs them."""
        if size:
            return PoseMap.of(
                result, self._pixel_size, self._device, curved=False, size=size, workspace=self._workspace
            )
        map_ = PoseMap.of(result, self._pixel_size, self._device, size=self._size(result))
        _ = map_.extent  # InputError for one without contents
        return map_


def _smooth(
    fit: PairFit, motion: Motion, now: Equations, free: Doubles
) -> tuple[PairFit, BlockEquations] | None:
    """Return the fit of maps at half the resolution, and its equations, if it is about as good."""
    if min(*fit.first.shape, *fit.second.shape) < 2 * _LEAST_SIDE:
        return None
    coarse = fit.halved()
    found = coarse.refine(motion, free)
    if found is None:
        return None
    there, directions = coarse.equations(found, unbiased=True), complement(free)
    errors = (
        float(np.trace(np.linalg.inv(directions.T @ equations.unbiased @ directions)))
        for equations in (now, there)
    )
    fine_error, coarse_error = errors
    is_as_good = 0 < coarse_error < _AS_GOOD * fine_error and there.chi_square < _AS_GOOD * max(
        now.chi_square, 1.0
    )
    return (coarse, there) if is_as_good else None


@dataclass(slots=True)
class _Key:
    """A result with which others are compared."""

    map: PoseMap
    pose: Pose  # from the first result
    size: int  # pixels of a result along a side of one of the averaged maps with which it is compared
    fit: PairFit | None = None  # of the first result after it
    free: Doubles = field(default_factory=lambda: np.zeros((6, 0)))  # directions that are not determined
    pixels: float = 0.0  # that the first result after it shares
    peak: float = 1.0  # largest share of them lately
    typical: float = 1.0  # chi square
    bend: float = NO_LIMIT  # of the last motion found
    constants: Array | None = None  # of the fit to `layout`
    layout: tuple[object, ...] = ()

    def start(self, fit: PairFit, now: BlockEquations, free: Doubles) -> None:
        """Keep what the first result after this key shows."""
        self.fit, self.free = fit, free
        self.pixels, self.typical = now.pixels, max(now.chi_square, now.typical, 1.0)

    def share(self, now: Followed) -> float:
        """Return the share of the pixels that another result shares."""
        return now.pixels / self.pixels

    def has_left(self, share: float) -> bool:
        """Return whether results have moved away from this key by a step since this was last true."""
        self.peak = max(self.peak, share)
        if share > self.peak - _LEAVING:
            return False
        self.peak = share
        return True

    def spread(self, pose: Pose) -> float:
        """Return the mean square error of the points of this key after a motion, mm²."""
        variances = np.diag(pose.covariance)
        return float(variances[3:].sum() + self.map.extent.size**2 * variances[:3].sum())

    def submit(self, map_: PoseMap, motion: Motion) -> PairFit:
        """Start the search for the motion from a map to this key near an expected motion."""
        assert self.fit is not None
        fit, layout = self.fit.after(map_), (map_.grid, map_.flat_limit)
        if self.constants is None or layout != self.layout:
            self.layout, self.constants = layout, fit.constants(self.typical, complement(self.free))
        fit.submit(motion, self.constants, self.bend)
        return fit

    def answer(self, fit: PairFit) -> Followed | None:
        """Wait for the search, and return the motion, or None."""
        found = fit.answer()
        if found is not None:
            self.bend = found.bend
        return found

    def pose_of(self, fit: PairFit, motion: Motion, now: Equations | Followed) -> Pose:
        """Return the motion from the first result to the one from which a motion to this key was found."""
        return pose_after(self.pose, fit, motion, now, self.free)
