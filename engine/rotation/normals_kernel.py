"""The kernels that estimate normals: checked options, launches, and output maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import thinning
from mirrorskin.engine.options import Configured, option
from mirrorskin.engine.rotation.design_matrix import LONGEST, TurnFit
from mirrorskin.engine.rotation.poses import PoseFit
from mirrorskin.engine.rotation.residual_noise import CountNoise, residual_noise
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.rotation.scale import make_scale
from mirrorskin.engine.rotation.tilt import estimate_tilt
from mirrorskin.engine.tiling import Band, Planes
from mirrorskin.io import InputError
from mirrorskin.kernels.array import Operand
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.embedded import vector_width
from mirrorskin.kernels.normals import contact_limits

NormalMethod = Literal["exact", "paper"]
MAPS = "vectors", "sigma", "contact", "mean", "cosine", "sine", "residual"
"""Names of the output maps."""
SLOPE_MAPS = "slopes", "slope_errors", "zeniths"
"""Names of the additional maps of a body that rocks."""

_TABLES = 64  # maximum number of turns whose tables are on the device
_TURN_PLANES, _POSE_PLANES = 6, 13  # rows of a table
_ENOUGH = 500  # minimum number of clear pixels for an estimate of the noise
_MOST_NOISE = 1e12  # counts
_MAP_BYTES = 33  # bytes per pixel of all output maps


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


@dataclass(frozen=True, slots=True)
class Samples:
    """The samples of a turn on the device: ``count`` frames of a stack, starting with frame ``start``.

    A ring buffer has ``count`` frames with a band's stride; other stacks have frames without padding.
    """

    stack: Operand
    start: int
    count: int
    ring: bool = False


class NormalKernel:
    """Fits turns on a device; with ``poses``, windows of frames with individual poses."""

    def __init__(
        self,
        options: SensorOptions,
        devices: Sequence[Device],
        shape: tuple[int, int],
        dtype: np.dtype[Any],
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
        self._dtype, self._method, self._step = dtype, method, thinning(shape)
        levels = options.zenith_gain, options.zenith_offset, options.dark, options.bright
        self._scale = response or make_scale(*levels, shape)
        self.devices: Sequence[Device] = devices
        scale = None if self._scale.per_pixel else self._scale.planes
        wall = None if response is None else response.table
        self._one_scale = {one: one.from_host("scale", scale) for one in devices if scale is not None}
        self._wall = {one: one.from_host("wall", wall) for one in devices if wall is not None}
        planes = _POSE_PLANES if poses else _TURN_PLANES
        self._poses = poses
        largest = min(one.max_allocation for one in devices)
        self.tables_at_once: int = max(1, min(_TABLES, largest // (4 * planes * LONGEST)))
        tables = self.tables_at_once, planes, LONGEST
        self._tables = {one: one.array("turns", tables, np.float32) for one in devices}
        self._places: dict[TurnFit | PoseFit, int] = {}

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
            noise = residual_noise(steep if steep.shape[1] >= _ENOUGH else samples, fit.phase, fit.weights)
        if tilt is None:
            if self._wall:
                raise InputError(
                    "the tilt cannot be estimated with a calibrated response: calibrate it, or give it,"
                    " such as 2.5deg"
                )
            tilt = estimate_tilt(samples, fit, self._scale.thinned(self._step), noise)
        return TurnModel(tilt, noise)

    @property
    def planes(self) -> dict[str, Planes]:
        """The maps of a band."""
        kinds: dict[str, Planes] = {name: Planes(1, np.float32) for name in MAPS}
        kinds |= {"vectors": Planes(3, np.float32), "contact": Planes(1, np.uint8)}
        if self._scale.per_pixel:
            kinds["scale"] = Planes(len(self._scale.planes), np.float32)
        if self._poses:
            kinds |= {name: Planes(1, np.float32) for name in SLOPE_MAPS}
        return kinds

    def write_scale(self, band: Band) -> None:
        """Write the scale of a band's pixels, if it is a map."""
        if self._scale.per_pixel:
            for plane, values in enumerate(self._scale.planes):
                band.write("scale", values[band.rows], plane=plane)

    def write_tables(self, fits: Sequence[TurnFit | PoseFit]) -> None:
        """Copy the tables of turns to the devices, after earlier turns, unless they are already there."""
        if all(fit in self._places for fit in fits):
            return
        self._places = {fit: place for place, fit in enumerate(dict.fromkeys(fits))}
        shape = self._tables[self.devices[0]].shape
        tables = np.zeros((len(self._places), *shape[1:]), np.float32)
        for fit, place in self._places.items():
            tables[place, :, : fit.table.shape[1]] = fit.table
        for array in self._tables.values():
            array.write(tables)

    def run(
        self,
        band: Band,
        samples: Samples,
        fit: TurnFit | PoseFit,
        model: TurnModel,
        turns: int,
        bare: bool = False,
    ) -> None:
        """Fit a resident band's samples of one turn, whose table was written by the last `write_tables`.

        The maps become the mean of ``turns`` turns, including this one. ``bare`` omits mean, cosine, sine and
        residual.
        """
        device, count, noise = band.device, samples.count, model.noise
        tilt = fit.tilt if isinstance(fit, PoseFit) else model.tilt
        lanes, per_pixel = vector_lanes(device), self._scale.per_pixel
        file = "normals_wall" if self._wall else "normals"
        name = "normals_wall" if self._wall else f"normals_{self._method}"
        if isinstance(fit, PoseFit):
            file, name = "normals_pose", "normals_pose" if fit.direction is None else "normals_rock"
        kernel = device.kernel(file, name, FRAME=C_TYPES[self._dtype.name], LANES=lanes)
        limits = contact_limits(count - 3, tilt)
        fitted = tilt if self._method == "exact" else 0.0  # the exact method fits the excess over this tilt
        further: dict[str, Any] = {}
        if isinstance(fit, PoseFit):
            further = {"presses": int(fit.presses)}
            if fit.direction is not None:
                further |= {name: band.maps[name] for name in SLOPE_MAPS}
        elif isinstance(self._scale, Response):
            wall = self._scale.wall
            sizes = {"curve_length": len(wall.curve), "inverse_length": len(wall.inverse)}
            further = {"wall_numbers": self._wall[device], "follows": int(wall.follows), **sizes}
        elif self._method == "paper":
            (mean, *_), (_, cosine, both), (*_, sine) = fit.covariance
            further = {"of_mean": mean, "of_cosine": cosine, "of_both": both, "of_sine": sine}
        planes = 4 * len(self._scale.planes) * per_pixel
        maps: dict[str, Any] = {name: band.maps[name] for name in MAPS}
        kernel(
            -(-band.pixels // (lanes * device.layout.words)),
            stack=samples.stack,
            tables=self._tables[device],
            scale=band.maps["scale"] if per_pixel else self._one_scale[device],
            table=self._places[fit],
            start=samples.start,
            count=count,
            slots=count if samples.ring else samples.start + count,
            each=band.stride if samples.ring else band.pixels,
            pixels=band.pixels,
            stride=band.stride,
            turns=turns,
            per_pixel=int(per_pixel),
            bare=int(bare),
            cos_tilt=math.cos(tilt),
            sin_tilt=math.sin(tilt),
            noise_base=noise.base,
            noise_slope=noise.slope,
            noise_least=noise.least,
            noise_limit=limits.noise,
            limit=limits.model,
            still_below=limits.still - fitted,
            wild_above=limits.most - fitted,
            rest_below=limits.rest,
            cosines=maps.pop("cosine"),
            sines=maps.pop("sine"),
            **maps,
            **further,
            moved=band.pixels * (count * self._dtype.itemsize + _MAP_BYTES + planes),
        )


def vector_lanes(device: Device) -> int:
    """Return the number of pixels per vector in `normals.cl`: 1 on a GPU, the width of registers on a CPU."""
    if device.layout.tile == 1:
        return 1
    return 16 if vector_width(device.queue.device) >= 16 else 8


def zenith_of(normals: ArrayLike) -> NDArray[np.float32]:
    """Return the angle to the body's axis in the mean pose, (H, W), radians."""
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    return np.asarray(np.arctan2(np.hypot(x, y), z))


def azimuth_of(normals: ArrayLike) -> NDArray[np.float32]:
    """Return the direction in which the surface faces, (H, W), radians from x towards y; NaN where level."""
    x, y, _ = np.moveaxis(np.asarray(normals), -1, 0)
    return np.where((x == 0) & (y == 0), np.float32(np.nan), np.arctan2(y, x))
