"""Normals, or slopes, from frames at any known poses of the body."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_frames
from mirrorskin.engine.rotation.design_matrix import LONGEST, Doubles
from mirrorskin.engine.rotation.normals import NormalEstimator, Normals
from mirrorskin.engine.rotation.normals_kernel import MAPS, SLOPE_MAPS
from mirrorskin.engine.rotation.poses import PoseFit, check_poses, pose_fit
from mirrorskin.io import InputError
from mirrorskin.io.maps import PoseStatus


@dataclass(frozen=True)
class PoseNormals(Normals):
    """What frames at any known poses tell of each pixel.

    Attributes
    ----------
    status : ndarray, (H, W), uint8
        1 normal, 2 none (too few samples in contact), 4 only the slope along one direction, as of a body that
        rocks about one axis: vectors, sigma and azimuth are NaN then.
    slope, slope_sigma : ndarray, (H, W), float32, or None
        Millimetres that the surface rises for each along ``direction``, and the standard deviation; None
        where whole normals were estimated.
    direction : float or None
        Radians from x towards y.
    """

    status: NDArray[np.uint8]
    slope: NDArray[np.float32] | None = None
    slope_sigma: NDArray[np.float32] | None = None
    direction: float | None = None
    inclination: NDArray[np.float32] | None = None

    @cached_property
    def zenith(self) -> NDArray[np.float32]:
        """Angle to the vertical, (H, W) float32, radians; of rocking it is known where the slope is."""
        return super().zenith if self.inclination is None else self.inclination


class PoseEstimator(NormalEstimator):
    """Estimate normals from frames at any known poses, as they come; see `NormalEstimator`.

    The frames are estimated in windows of ``longest``; a later window that determines less than the first is
    left out. Where travel differs from frame to frame, those count in which a pixel is in contact, and
    ``contact`` is 1 where it is in those of some window.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    longest : int
        Frames of a window at most, up to 64.
    **options
        gain, offset, noise, dark, bright, device, per_turn and memory_limit as for `NormalEstimator`.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> estimator = engine.PoseEstimator((2, 3), "float32", gain=300, noise=1.0)
    >>> for lean in 0.05 * np.sin(0.8 * np.arange(16)):
    ...     axis = [[np.sin(lean), 0.0, np.cos(lean)]]
    ...     estimator.push(np.full((1, 2, 3), 150 - 300 * lean, np.float32), pose=axis)
    >>> rocked = estimator.result()
    >>> int(rocked.status[0, 0]), round(float(rocked.slope[0, 0]), 2)
    (4, -0.55)
    """

    position = "pose"
    _maps = (*MAPS, *SLOPE_MAPS)
    _width = 4

    def __init__(
        self, shape: tuple[int, int], dtype: DTypeLike, *, longest: int = LONGEST, **options: Any
    ) -> None:
        if options.get("response") is not None:
            raise InputError("a calibrated response needs whole turns of one tilt: give gain and offset")
        super().__init__(shape, dtype, longest=longest, **(options | {"tilt": "estimate"}))

    def reset(self) -> None:
        """Forget the frames so far, and what was estimated from them."""
        super().reset()
        self._direction: float | None = None

    def push(  # type: ignore[override]
        self,
        frames: NDArray[Any],
        *,
        pose: ArrayLike,
        frame_weights: ArrayLike | None = None,
        lent: bool = False,
    ) -> None:
        """Take in the next frames, (n, H, W), and poses: the body's axis, (n, 3), and travel as a fourth.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another type or size, or poses that cannot be.
        """
        check_frames(frames, self._dtype, self._shape)
        where = np.asarray(pose, np.float64)
        travel = where[:, 3] if where.shape[1:] == (4,) else None
        self._push(frames, check_poses(len(frames), axis=where[..., :3], travel=travel), frame_weights)

    def _turns_in(self, where: Doubles) -> list[slice]:
        starts = range(0, len(where), self._longest)
        return [slice(start, min(start + self._longest, len(where))) for start in starts]

    def _fit_of(self, where: Doubles, weights: Doubles, first: bool) -> PoseFit | None:
        try:
            fit = pose_fit(where, weights)
        except InputError:
            return None
        self._direction = fit.direction if first else self._direction
        return fit if fit.direction == self._direction else None

    def _explain(self, where: Doubles, weights: Doubles) -> None:
        pose_fit(where[weights > 0], weights[weights > 0])

    def _found(self, maps: list[NDArray[Any]]) -> PoseNormals:
        normals, (slope, sigma, zenith) = super()._found(maps[:-3]), maps[-3:]
        known = {one.name: getattr(normals, one.name) for one in fields(normals)}
        if self._direction is None:
            status = np.where(np.isfinite(normals.sigma), PoseStatus.NORMAL, PoseStatus.NONE)
            return PoseNormals(**known, status=status.astype(np.uint8))
        status = np.where(np.isfinite(sigma), PoseStatus.SLOPE_ONLY, PoseStatus.NONE).astype(np.uint8)
        return PoseNormals(
            **known,
            status=status,
            slope=slope,
            slope_sigma=sigma,
            direction=self._direction,
            inclination=zenith,
        )
