"""The kernel that estimates normals: its options, checked once, its launch, and the maps that it leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Required, TypedDict, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import check_dtype, thinning
from mirrorskin.engine.rotation.design_matrix import LONGEST, Doubles, TurnFit
from mirrorskin.engine.rotation.residual_noise import CountNoise, residual_noise
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.rotation.scale import Scale, make_scale
from mirrorskin.engine.rotation.tilt import check_tilt, estimate_tilt
from mirrorskin.engine.tiling import Band, Planes
from mirrorskin.io import Header, InputError
from mirrorskin.kernels.array import Operand
from mirrorskin.kernels.device import C_TYPES, Device, open_device
from mirrorskin.kernels.normals import MORE, contact_limits
from mirrorskin.kernels.normals_wall import STEPS

NormalMethod = Literal["exact", "paper"]
NORMAL_METHODS: tuple[NormalMethod, ...] = get_args(NormalMethod)
MAPS = "vectors", "sigma", "contact", "mean", "cosine", "sine", "residual"
"""What the kernel leaves, by name."""

_LANES = 8  # pixels that are best worked on side by side, where a word has room for as many
_TOGETHER = 64  # turns whose tables the device has at once
_TABLE_BYTES = 4 * 6 * LONGEST
_ENOUGH = 500  # pixels to tell the noise from
_MAP_BYTES = 33  # of a pixel, in all of them


@dataclass(frozen=True, slots=True)
class Samples:
    """Where the samples of a turn lie on the device.

    Attributes
    ----------
    stack : Array or BorrowedBuffer
    start : int
        Frame of the turn's first one.
    count : int
        Frames of the turn.
    ring : bool
        Whether it is a ring of ``count`` frames as long as a band's stride, in which the turn goes round;
        otherwise its frames follow each other, each as long as the band has pixels.
    """

    stack: Operand
    start: int
    count: int
    ring: bool = False


class NormalLaunch:
    """Fits turns on a device.

    Parameters
    ----------
    device : Device
    dtype : dtype
        Of a sample.
    scale : Scale or Response
    method : {"exact", "paper"}

    Raises
    ------
    mirrorskin.io.InputError
        The paper's equations, with a response.

    Attributes
    ----------
    together : int
        Turns whose tables the device has at once, at most.
    """

    def __init__(
        self, device: Device, dtype: np.dtype[Any], scale: Scale | Response, method: NormalMethod
    ) -> None:
        self._device, self._dtype, self._scale, self._method = device, dtype, scale, method
        if not scale.per_pixel:
            self._one_scale = device.given("scale", scale.planes)
        if isinstance(scale, Response):
            if method != "exact":
                raise InputError(
                    f"method {method!r} takes brightness for linear in the zenith, not as it was calibrated:"
                    " take exact, or leave the calibration out"
                )
            self._wall = device.given("wall", scale.table)
        self.together = max(1, min(_TOGETHER, device.max_allocation // _TABLE_BYTES))
        self._tables = device.array("turns", (self.together, 6, LONGEST), np.float32)
        self._places: dict[TurnFit, int] = {}

    @property
    def planes(self) -> dict[str, Planes]:
        """The maps that a band needs."""
        per_pixel = {"scale": Planes(len(self._scale.planes), np.float32)}
        scale = per_pixel if self._scale.per_pixel else {}
        maps = {
            name: Planes(3 if name == "vectors" else 1, np.uint8 if name == "contact" else np.float32)
            for name in MAPS
        }
        return maps | scale

    def write_scale(self, band: Band) -> None:
        """Tell a band the scale of its pixels, where each has its own."""
        if self._scale.per_pixel:
            for plane, values in enumerate(self._scale.planes):
                band.write("scale", values[band.rows], plane=plane)

    def write_tables(self, fits: Sequence[TurnFit]) -> None:
        """Hand the tables of some turns to the device; unless it has them, that waits for all before."""
        if all(fit in self._places for fit in fits):
            return
        self._places = {fit: place for place, fit in enumerate(dict.fromkeys(fits))}
        self._tables.claim()
        for fit, place in self._places.items():
            self._tables.host[place, :, : fit.table.shape[1]] = fit.table
        self._tables.upload()

    def run(
        self,
        band: Band,
        samples: Samples,
        fit: TurnFit,
        noise: CountNoise,
        tilt: float,
        turns: int,
        bare: bool = False,
    ) -> None:
        """Fit a band's samples of one turn.

        Parameters
        ----------
        band : Band
            Which is resident.
        samples : Samples
        fit : TurnFit
            One of those whose tables were written last.
        noise : CountNoise
        tilt : float
        turns : int
            Of which the maps are to be the mean, this one included.
        bare : bool
            Whether to leave out the maps of the wave: mean, cosine, sine and residual.
        """
        shape, count = self._device.layout, samples.count
        lanes = min(_LANES, shape.lanes)
        integer = self._dtype.kind == "u"
        kernel = self._device.kernel(
            "normals",
            "normals_wall" if isinstance(self._scale, Response) else f"normals_{self._method}",
            FRAME=C_TYPES[self._dtype.name],
            COUNTED=int(integer),
            TOP=int(np.iinfo(self._dtype).max) if integer else 0,
            LANES=lanes,
            COUNT=count,
            WEIGHTED=int(fit.weighted),
            ROOM=LONGEST,
            MAPS=int(self._scale.per_pixel),
            ENDS=int(self._scale.ends),
            MORE=MORE,
            RING=int(samples.ring),
            BARE=int(bare),
            **self._wall_macros,
        )
        limits = contact_limits(count - 3, tilt)
        apart = tilt if self._method == "exact" else 0.0  # what is told is how much more it is, or all
        whole = np.array([self._places[fit], samples.start, band.pixels, band.stride], np.int32)
        reals = (
            math.cos(tilt),
            math.sin(tilt),
            *(noise.base, noise.slope, noise.least),
            limits.noise,
            limits.model,
            limits.still - apart,
            limits.most - apart,
            limits.rest,
        )
        scale = band.maps["scale"] if self._scale.per_pixel else self._one_scale
        arguments: list[Operand | np.generic] = [samples.stack, self._tables, scale]
        arguments += [self._wall] if isinstance(self._scale, Response) else []
        arguments += [*whole, np.int32(turns)]
        arguments += [*np.array(reals, np.float32), *(band.maps[name] for name in MAPS)]
        if self._method == "paper":
            (mean, *_), (_, cosine, both), (*_, sine) = fit.covariance
            arguments += [*np.array([mean, cosine, both, sine], np.float32)]
        planes = 4 * len(self._scale.planes) * self._scale.per_pixel
        moved = band.pixels * (count * self._dtype.itemsize + _MAP_BYTES + planes)
        kernel(-(-band.pixels // (lanes * shape.words)), *arguments, moved=moved)

    @property
    def _wall_macros(self) -> dict[str, int]:
        """What a kernel under a wall is compiled with besides; nothing without one."""
        if not isinstance(self._scale, Response):
            return {}
        wall = self._scale.wall
        sizes = {"CURVE": len(wall.curve), "INVERSE": len(wall.inverse)}
        return {"WALL": 1, "STEPS": STEPS, "FOLLOWS": int(wall.follows), **sizes}


def settle(
    samples: NDArray[Any],
    shape: tuple[int, int],
    phase: Doubles,
    weights: Doubles,
    matrix: Doubles,
    scale: Scale | Response,
    noise: CountNoise | None,
    tilt: float | None,
) -> tuple[CountNoise, float]:
    """Tell from a turn what was not given: the noise, and the tilt.

    Parameters
    ----------
    samples : ndarray, (N, n)
        Of each so-manieth pixel of a frame; see ``mirrorskin.engine.frames.thinning``.
    shape : (int, int)
        Rows and columns of a frame.
    phase, weights, matrix
        Of its frames; see ``mirrorskin.engine.rotation.design_matrix``.
    scale : Scale or Response
    noise : CountNoise or None
    tilt : float or None
        Radians.

    Raises
    ------
    mirrorskin.io.InputError
        The turn does not tell it.
    """
    step = thinning(shape)
    if noise is None:
        with np.errstate(invalid="ignore"):
            wave = matrix @ samples
            clear = scale.telling(wave, step)
        steep = samples[:, clear]
        noise = residual_noise(steep if steep.shape[1] >= _ENOUGH else samples, phase, weights)
    if tilt is None:
        if isinstance(scale, Response):
            raise InputError(
                "a calibrated response does not tell the tilt: calibrate that, or give it, such as 2.5deg"
            )
        tilt = estimate_tilt(samples, phase, weights, matrix, scale.thinned(step), noise)
    return noise, tilt


class NormalOptions(TypedDict, total=False):
    """Options of ``mirrorskin.engine.estimate_normals``, which says what they are; the tilt is needed."""

    tilt: Required[float | None]
    gain: ArrayLike | None
    offset: ArrayLike
    method: NormalMethod
    noise: float | None
    low: ArrayLike | None
    high: ArrayLike | None
    response: Response | None
    device: str | Device | None


def options_from(
    header: Header,
    method: NormalMethod,
    noise: float | None,
    response: Response | None,
    device: str | Device | None,
) -> NormalOptions:
    """Return the options that a header tells, with others."""
    return {
        "tilt": header.tilt,
        "gain": header.zenith_gain,
        "offset": 0.0 if header.zenith_offset is None else header.zenith_offset,
        "low": header.dark,
        "high": header.bright,
        "method": method,
        "noise": noise,
        "response": response,
        "device": device,
    }


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What is made of the options.

    Attributes
    ----------
    tilt : float or None
        Radians; None where it is to be estimated.
    noise : CountNoise or None
        None where the samples are to tell it.
    scale : Scale or Response
    device : Device
    launch : NormalLaunch
    """

    tilt: float | None
    noise: CountNoise | None
    scale: Scale | Response
    device: Device
    launch: NormalLaunch


def set_up(
    shape: tuple[int, int],
    dtype: np.dtype[Any],
    *,
    tilt: float | None,
    gain: ArrayLike | None = None,
    offset: ArrayLike = 0.0,
    method: NormalMethod = "exact",
    noise: float | None = None,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    response: Response | None = None,
    device: str | Device | None = None,
) -> Setup:
    """Check options for frames of a shape, rows and columns, and a type, and open the device.

    Raises
    ------
    mirrorskin.io.InputError
        Options that cannot be used.
    """
    check_dtype(dtype)
    if method not in NORMAL_METHODS:
        raise InputError(f"unknown method {method!r}; known are {', '.join(NORMAL_METHODS)}")
    given_tilt = None if tilt is None else check_tilt(tilt)
    scale = response or make_scale(gain, offset, low, high, shape)
    given_noise = None if noise is None else _even_noise(noise)
    opened = open_device(device)
    return Setup(given_tilt, given_noise, scale, opened, NormalLaunch(opened, dtype, scale, method))


def _even_noise(noise: float) -> CountNoise:
    """Return the noise of samples that all have the same, of a standard deviation in counts."""
    if not 0 < noise < np.inf:
        raise InputError(f"noise {noise}: a standard deviation in counts is needed, such as 1.5")
    return CountNoise(noise**2, 0.0, noise**2)
