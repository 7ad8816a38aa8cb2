"""The kernels that estimate normals: checked options, launches, and output maps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import thinning
from mirrorskin.engine.base.options import Configured, option
from mirrorskin.engine.base.picture import Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.correlation.design_matrix import LONGEST, TurnFit
from mirrorskin.engine.diagnosis.residual_noise import CountNoise, residual_noise
from mirrorskin.engine.rotation.poses import PoseFit
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.rotation.scale import make_scale
from mirrorskin.engine.rotation.tilt import estimate_tilt
from mirrorskin.io import InputError
from mirrorskin.kernels.rotation.normals import contact_limits

if TYPE_CHECKING:
    from mirrorskin.engine.base.device_arrays import AnyArray
    from mirrorskin.engine.base.operation import Operation

NormalMethod = Literal["exact", "paper"]
MAPS = "vectors", "sigma", "contact", "mean", "cosines", "sines", "residual"
"""Names of the output maps."""
SLOPE_MAPS = "slopes", "slope_errors", "zeniths"
"""Names of the additional maps of a body that rocks."""

_AGAIN = 2  # see normals.clh
_MIN_CLEAR_PIXELS = 500  # minimum number of clear pixels for an estimate of the noise
_MOST_NOISE = 1e12  # counts


class SensorOptions(Configured):
    """Options of operations that estimate normals: the parameters of the sensor."""

    zenith_gain: ArrayLike | None = option(
        default=None,
        unit="counts/rad",
        help="brightness per zenith angle, a number or a map (H, W); negative if steeper is darker",
        shown_default="that of the recording or calibration",
    )
    zenith_offset: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="brightness at zenith 0, a number or a map (H, W)",
        shown_default="that of the recording or calibration, otherwise 0",
    )
    dark: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="lowest brightness that is linear in the zenith, a number or a map (H, W); samples that are"
        " expected to be darker are left out",
        shown_default="that of the recording or calibration, otherwise none",
    )
    bright: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="highest brightness that is linear in the zenith, a number or a map (H, W); samples that are"
        " expected to be brighter are left out",
        shown_default="that of the recording or calibration, otherwise none",
    )
    noise: float | None = option(
        default=None,
        unit="counts",
        above=0,
        help="standard deviation of a sample",
        shown_default="estimated from the residuals of the first turn, as read noise and shot noise",
    )


@dataclass(frozen=True, slots=True)
class TurnModel:
    """The model of a turn's samples: the tilt, radians, and the noise."""

    tilt: float
    noise: CountNoise


class NormalKernel:
    """Fits turns to frames of a picture; with ``poses``, windows of frames with individual poses."""

    def __init__(
        self,
        options: SensorOptions,
        shape: tuple[int, int],
        *,
        tilt: float | Literal["estimate"] = "estimate",
        method: NormalMethod = "exact",
        response: Response | None = None,
        poses: bool = False,
    ) -> None:
        if response is not None and method != "exact":
            raise InputError(
                f"method {method!r} assumes brightness that is linear in the zenith, not the calibrated one:"
                " use exact, or leave the calibration out"
            )
        self._tilt = None if isinstance(tilt, str) else tilt
        noise = options.noise
        if noise is not None and noise > _MOST_NOISE:
            raise InputError(
                f"noise {noise:g}: a standard deviation of at most {_MOST_NOISE:g} counts is needed"
            )
        self._noise = None if noise is None else CountNoise(noise**2, 0.0, noise**2)
        self._method, self._step, self._poses = method, thinning(shape), poses
        levels = options.zenith_gain, options.zenith_offset, options.dark, options.bright
        self._scale = response or make_scale(*levels, shape)

    @property
    def model(self) -> TurnModel | None:
        """The given tilt and noise; None if one of them is to be estimated."""
        if self._tilt is None or self._noise is None:
            return None
        return TurnModel(self._tilt, self._noise)

    def estimate_model(self, samples: NDArray[Any], fit: TurnFit | PoseFit) -> TurnModel:
        """Return noise and tilt, estimated from samples (N, n) of every n-th pixel if they are not given."""
        noise, tilt = self._noise, self._tilt
        if isinstance(fit, PoseFit):
            deep = fit.deep if fit.presses else np.full(len(samples), True)
            none = np.zeros(np.count_nonzero(deep))
            noise = noise or residual_noise(samples[deep], none, fit.weights[deep], fit.waves[deep])
            return TurnModel(fit.tilt, noise)
        if noise is None:
            with np.errstate(invalid="ignore"):
                clear = self._scale.clear_pixels(fit.matrix @ samples.astype(np.float64), self._step)
            steep = samples.compress(clear, axis=1)
            noise = residual_noise(
                steep if steep.shape[1] >= _MIN_CLEAR_PIXELS else samples, fit.phase, fit.weights
            )
        if tilt is None:
            if isinstance(self._scale, Response):
                raise InputError(
                    "the tilt cannot be estimated with a calibrated response: calibrate it, or give it,"
                    " such as 2.5deg"
                )
            tilt = estimate_tilt(samples, fit, self._scale.thinned(self._step), noise)
        return TurnModel(tilt, noise)

    def picture(self, operation: Operation, whole: int, **others: Planes) -> Picture:
        """Return the maps of an operation, and others; kernels need so many frames in one piece."""
        kinds: dict[str, Planes] = {name: Planes(1, np.float32) for name in MAPS}
        kinds |= {"vectors": Planes(1, ("f4", 3)), "contact": Planes(1, np.uint8)}
        scale, constants = self._scale, dict[str, NDArray[Any]]()
        if isinstance(scale, Response):
            constants["wall_numbers"] = scale.table
        if scale.per_pixel:
            kinds["scale"] = Planes(len(scale.planes), np.float32)
        else:
            constants["scale"] = scale.planes
        if self._poses:
            kinds |= {name: Planes(1, np.float32) for name in SLOPE_MAPS}
        picture = Picture(operation, "normals", kinds | others, constants=constants, whole=whole)
        for plane, values in enumerate(scale.planes if scale.per_pixel else ()):
            picture.fill("scale", values, plane)
        return picture

    def run(
        self,
        picture: Picture,
        frames: AnyArray | None,
        fit: TurnFit | PoseFit,
        model: TurnModel,
        turns: int,
        *,
        start: int = 0,
        bare: bool = False,
        again: bool = False,
    ) -> None:
        """Fit the frames of one turn, or those of the picture's map ``frames``, a ring buffer.

        The maps become the mean of ``turns`` turns, including this one. ``start`` is the number of the oldest
        frame of a ring buffer. ``bare`` omits mean, cosine, sine and residual. ``again``: the maps have the
        normals of an earlier estimate.
        """
        count, noise, scale = len(fit.weights), model.noise, self._scale
        tilt = fit.tilt if isinstance(fit, PoseFit) else model.tilt
        file, name = "normals", f"normals_{self._method}"
        limits = contact_limits(count - 3, tilt)
        fitted = tilt if self._method == "exact" else 0.0  # the exact method fits the excess over this tilt
        further = dict[str, Any]()
        if isinstance(fit, PoseFit):
            file, name = "normals_pose", "normals_pose" if fit.direction is None else "normals_rock"
            further["presses"] = int(fit.presses)
        elif isinstance(scale, Response):
            file = name = "normals_wall"
            wall = scale.wall
            sizes = {"curve_length": len(wall.curve), "inverse_length": len(wall.inverse)}
            further |= {"follows": int(wall.follows), **sizes}
        elif self._method == "paper":
            (mean, *_), (_, cosine, both), (*_, sine) = fit.covariance
            further |= {"of_mean": mean, "of_cosine": cosine, "of_both": both, "of_sine": sine}
        further |= {
            "table": np.pad(fit.table, ((0, 0), (0, LONGEST - fit.table.shape[1]))),
            "start": start,
            "turns": turns,
            "per_pixel": int(scale.per_pixel),
            "bare": _AGAIN if bare and again else int(bare),
            "cos_tilt": math.cos(tilt),
            "sin_tilt": math.sin(tilt),
            "noise_base": noise.base,
            "noise_slope": noise.slope,
            "noise_floor": noise.floor,
            "noise_limit": limits.noise,
            "limit": limits.model,
            "lowest_tilt": limits.lowest_tilt - fitted,
            "highest_tilt": limits.highest_tilt - fitted,
            "rest_below": limits.rest,
        }
        if frames is None:
            picture.run(name, source=file, count=count, **further)
        else:
            picture.scan(name, frames, source=file, whole=True, **further)
