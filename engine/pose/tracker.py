"""The motion of an object along a stream of results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.engine.pose.fit import FEWEST_SHARED, PairFit, complement
from mirrorskin.engine.pose.maps import PoseMap
from mirrorskin.engine.pose.motion import STILL, Motion
from mirrorskin.engine.pose.pose import IDENTITY, Pose, pose_of
from mirrorskin.io import Result
from mirrorskin.io.base.findings import findings_of
from mirrorskin.io.base.threads import ThreadSafe
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, open_device

_MIN_COMMON = 0.6  # share of the key's pixels below which the next result becomes the key
_COARSE_STRIDE = 4  # pixel step of the coarse fit
_MAX_STEPS, _LAST_STEP = 8, 0.3  # maximum number of steps; size of the step that ends them, sigmas
_LOST = 3.0  # times the key's first chi square, above which the motion is searched again


class PoseTracker(ThreadSafe):
    """Estimates the motion of an object from the first result of a stream to each later one.

    Each result is compared with a key: the first result, or a later one if too few pixels overlap with the
    previous key. Errors therefore increase with the number of keys, not of results. The start is extrapolated
    from the last two results, and refined on every fourth row and column, then on all pixels. Directions that
    the key does not determine are identified with the first result after it, and are kept fixed.

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
        self._pixel_size, self._device = pixel_size, open_device(device)
        self._key: PoseMap | None = None
        self._key_pose = IDENTITY
        self._free: Doubles | None = None
        self._fewest, self._worst = 0.0, np.inf  # pixels, and chi square
        self._results = 0
        self._notes: tuple[str, ...] = ()  # of the last result
        self._back, self._last = STILL, STILL  # from the last result to the key, and to the one before

    def push(self, maps: Maps) -> Pose:
        """Return the motion from the first result to the next one, a result or maps as for `estimate_pose`.

        Raises
        ------
        mirrorskin.io.InputError
            Maps that `estimate_pose` refuses, or too few pixels shared with earlier results. The result is
            ignored.
        """
        result = as_result(maps, "result")
        self._notes = tuple(
            finding.text for finding in findings_of(f"result {self._results}", result.process)
        )
        pose = self._find(result)
        self._results += 1
        return self._noted(pose)

    def _find(self, result: Result) -> Pose:
        """Return the motion from the first result; its notes are those of the keys."""
        if self._key is None:
            self._take_key(result, self._key_pose)
            return self._key_pose
        if self._free is None:
            return self._first_after_key(result)
        fit = PairFit(self._map(result, curved=False), self._key, self._device)
        directions, motion = complement(self._free), self._last.then(self._back)
        for step in (_COARSE_STRIDE, 1):
            for _ in range(_MAX_STEPS):
                now = fit.equations(motion, step=step)
                if now.pixels < FEWEST_SHARED:
                    return self._search(result)
                motion, moved = fit.step(motion, now, directions)
                if moved < _LAST_STEP:
                    break
        if now.chi_square > self._worst:
            return self._search(result)
        pose = self._moved_to(motion, pose_of(fit, motion, now, self._free))
        if now.pixels < self._fewest:
            self._take_key(result, pose)
        return pose

    def _first_after_key(self, result: Result) -> Pose:
        """Return the pose of the first result after a key, and determine the undetermined directions."""
        assert self._key is not None
        fit = PairFit(self._map(result), self._key, self._device)
        motion, now, self._free = fit.solve(self._last.then(self._back), near=True)
        self._fewest, self._worst = _MIN_COMMON * now.pixels, _LOST * max(now.chi_square, 1.0)
        return self._moved_to(motion, pose_of(fit, motion, now, self._free))

    def _search(self, result: Result) -> Pose:
        """Return the pose of a result that is far from the expected pose."""
        assert self._key is not None
        fit = PairFit(self._map(result), self._key, self._device)
        motion, now, free = fit.solve()
        return self._moved_to(motion, pose_of(fit, motion, now, free))

    def _moved_to(self, motion: Motion, to_key: Pose) -> Pose:
        """Store the motion back to the key, and return the pose."""
        self._last = motion.then(self._back.inverse())
        self._back = motion
        return self._key_pose.then(to_key.inverse())

    def _take_key(self, result: Result, pose: Pose) -> None:
        self._key, self._key_pose, self._free = self._map(result), self._noted(pose), None
        self._back = STILL
        self.keys += 1

    def _noted(self, pose: Pose) -> Pose:
        """Return a pose with the notes of the last result."""
        return replace(pose, notes=tuple(dict.fromkeys((*pose.notes, *self._notes))))

    def _map(self, result: Result, curved: bool = True) -> PoseMap:
        return PoseMap.of(result, self._pixel_size, self._device, curved)
