"""Normals, or slopes, from frames at given poses of the body; and the function for stacks in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.functions import ABOUT_WEIGHTS, function_of
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.diagnosis.normals_uncertainty import NuisanceUncertainty, PhaseUncertainty
from mirrorskin.engine.rotation.normals import Normals, NormalsOperation, normals_result
from mirrorskin.engine.rotation.normals_kernel import MAPS, SLOPE_MAPS, NormalKernel, TurnModel
from mirrorskin.engine.rotation.poses import PoseFit, check_poses, even_windows, pose_fit, rocks
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.types import body_axes
from mirrorskin.io.model.maps import TABLE, PoseStatus, status_of
from mirrorskin.io.storage.layout import as_series
from mirrorskin.kernels.array_types import Doubles

P = ParamSpec("P")

_MIN_FRAMES = 4  # minimum number of frames of a preview: one more than for a slope, to estimate the noise
_WARMING = 8  # number of frames that run all kernels


class MovingNormals(NormalsOperation):
    """Normals from frames at any given poses, or the slope along one direction if the body only rocks.

    The frames are fitted in windows of `longest` frames; later windows that determine less than the first are
    omitted. If the travel varies, only frames in which a pixel is in contact are used, and ``contact`` is 1
    where the pixel is in contact in all frames of at least one window.

    If all axes lie in one plane, ``slope`` is the rise per millimetre along ``slope_direction`` in
    ``process``, radians from x towards y, and there are no normals.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> run = engine.Run(engine.rotation.MovingNormals(zenith_gain=300, noise=1.0))
    >>> for lean in 0.05 * np.sin(0.8 * np.arange(16)):
    ...     axis = [[np.sin(lean), 0.0, np.cos(lean)]]
    ...     run.push(np.full((1, 2, 3), 150 - 300 * lean, np.float32), pose=axis)
    >>> rocked = run.result()
    >>> int(rocked.status[0, 0]), round(float(rocked.slope[0, 0]), 2)
    (4, -0.55)
    """

    checks = PhaseUncertainty, NuisanceUncertainty

    status = status_of(PoseStatus)
    slope = TABLE["slope"]
    slope_sigma = TABLE["slope"].deviation("slope")
    optional_maps = ("normals", "azimuth", "normals_sigma", "slope", "slope_sigma")  # depending on the poses

    _kernel_maps = (*MAPS, *SLOPE_MAPS)
    _width = 4

    def _make_kernel(self, shape: tuple[int, int]) -> NormalKernel:
        return NormalKernel(self, shape, poses=True)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        super().start(shape, dtype)
        self._direction: float | None = None

    def push(self, frames: NDArray[Any], *, pose: ArrayLike, frame_weights: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), the axis in each, (n, 3), with travel (n, 4), and weights.

        Axes are unit vectors towards the camera; travel is in mm.
        """
        where = np.asarray(pose, np.float64)
        travel = where[:, 3] if where.shape[1:] == (4,) else None
        poses = check_poses(len(frames), axis=where[..., :3], travel=travel)
        self._push(frames, poses, frame_weights)

    def preview(self, seconds: float) -> Result:
        """Return the maps of the frames so far; none before they determine a slope and its noise."""
        return Result() if self.count < _MIN_FRAMES else self.result()

    def precompile(self) -> None:
        """Push frames of a rocking plane."""
        tilts = np.linspace(-0.05, 0.05, _WARMING)
        level = np.random.default_rng(0).normal(100, 1, (_WARMING, *self.shape))
        frames = (level + 500 * tilts[:, np.newaxis, np.newaxis]).astype(self.dtype)
        self.push(frames, pose=body_axes(np.zeros(_WARMING), tilts))
        self.count = _WARMING
        self.preview(0.0)

    def _turns_in(self, where: Doubles) -> list[slice]:
        starts = range(0, len(where), self._longest)
        return [slice(start, min(start + self._longest, len(where))) for start in starts]

    def _fit_of(self, where: Doubles, weights: Doubles, first: bool) -> PoseFit | None:
        try:
            fit = pose_fit(where, weights, None if first else self._direction)
        except InputError:
            return None
        self._direction = fit.direction if first else self._direction
        return fit if fit.direction == self._direction else None

    def _explain(self, where: Doubles, weights: Doubles) -> None:
        pose_fit(where[weights > 0], weights[weights > 0])

    def _as_result(self, maps: list[NDArray[Any]], model: TurnModel) -> Result:
        slope, sigma, zenith = maps[-3:]
        result = normals_result(maps[:-3], model, self._turns, self._frames)
        status = {"status": self.status}
        if self._direction is None:
            codes = np.where(np.isfinite(result.normals_sigma), PoseStatus.NORMAL, PoseStatus.NONE)
            return result.assign(status=codes.astype(np.uint8), declarations=status)
        codes = np.where(np.isfinite(sigma), PoseStatus.SLOPE_ONLY, PoseStatus.NONE)
        return result.assign(
            normals=None,
            azimuth=None,
            normals_sigma=None,
            zenith=zenith,
            status=codes.astype(np.uint8),
            slope=slope,
            slope_sigma=sigma,
            declarations=status,
        ).with_fitted(slope_direction=self._direction)


class NormalsFunction(Protocol[P]):
    """A function of frames, (T, H, W), the pose of the body in each, and options."""

    def __call__(
        self,
        frames: ArrayLike,
        phase: ArrayLike | None = None,
        frame_weights: ArrayLike | None = None,
        axis: ArrayLike | None = None,
        travel: ArrayLike | None = None,
        *args: P.args,
        **options: P.kwargs,
    ) -> Result:
        """Return the maps."""


def _choose(positions: dict[str, Any], options: dict[str, Any]) -> tuple[Operation, dict[str, Any]]:
    """Return the operation for the given positions, turns of one tilt, or poses; and its positions."""
    series = {name: None if values is None else as_series(name, values) for name, values in positions.items()}
    phase, axis, travel, weights = (series[name] for name in ("phase", "axis", "travel", "frame_weights"))
    tilt = options.pop("tilt", None)
    angle = None if tilt is None or isinstance(tilt, str) else as_series("tilt", tilt).astype(np.float64)
    varies = angle is not None and (angle.ndim > 0 or rocks(phase))
    if axis is None and travel is None and not varies:
        return Normals(tilt=tilt, **options), {"phase": phase, "frame_weights": weights}
    count = next((len(values) for values in (phase, axis) if values is not None and np.ndim(values)), 0)
    pose = check_poses(count, phase, angle, axis, travel)
    for name in (Normals.options.keys() - MovingNormals.options) & options.keys():
        if options.pop(name) != Normals.options[name].default:
            raise InputError(f"{name} needs whole turns of one tilt, but frames have poses. Remove {name}")
    options.setdefault("longest", even_windows(count) if count else None)
    if axis is not None:
        return MovingNormals(**options), {"pose": pose, "frame_weights": weights}
    return MovingNormals(**options), {
        "phase": phase,
        "tilt": np.broadcast_to(cast(Any, angle), count),
        "travel": pose[:, 3],
        "frame_weights": weights,
    }


_FUNCTION = function_of(
    Normals,
    name="estimate_normals",
    text="""Estimate the normals from a stack that fits in memory; see `Normals` and `MovingNormals`.

    With a phase and one tilt, the frames are turns of a precession. With a tilt of each frame, two phases
    half a turn apart, an axis or a travel, they are at given poses.

    Returns
    -------
    Result
        ``normals``, (H, W, 3), unit vectors in the mean pose; ``normals_sigma``, the predicted RMS angle to
        the true normal; ``contact``, 1 where sheet and object touched in every frame; ``zenith`` and
        ``azimuth``; ``mean``, ``cosine``, ``sine``, ``modulation`` and ``residual`` of the brightness. Maps
        are NaN where undefined. With poses also ``status``, and ``slope`` if the body only rocks.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases, tilt, axes, scale or parameters that cannot be used.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.

    Examples
    --------
    A plane that is inclined by 0.3 rad towards x, seen by a body that leans by 0.05 rad:

    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> phase = np.arange(8) * np.pi / 4
    >>> cosine = np.cos(0.3) * np.cos(0.05) - np.sin(0.3) * np.sin(0.05) * np.cos(phase)
    >>> frames = (500 * np.arccos(cosine)[:, None, None] * np.ones((2, 3))).astype(np.float32)
    >>> result = engine.estimate_normals(frames, phase, tilt=0.05, zenith_gain=500, noise=1.0)
    >>> round(float(result.zenith[0, 0]), 4)
    0.3
    """,
    optional={
        "phase": "Radians, at least three different phases in each turn. `tilt` may then be an array (T,).",
        "frame_weights": ABOUT_WEIGHTS,
        "axis": "The body's axis in each frame, (T, 3), instead of phase and tilt: unit vectors towards the"
        " camera.",
        "travel": "Millimetres, if the body presses as well.",
    },
    choose=_choose,
)


def _typed(operation: Callable[P, Normals]) -> NormalsFunction[P]:
    return cast(NormalsFunction[P], _FUNCTION)


estimate_normals = _typed(Normals)
