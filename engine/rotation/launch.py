"""The normals' kernel over a band of pixels: what it is told, and the maps that it leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.frames import thinning
from mirrorskin.engine.rotation.fit_noise import CountNoise, noise_of_fit
from mirrorskin.engine.rotation.fits import TurnFit
from mirrorskin.engine.rotation.phases import Doubles
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.rotation.scale import Scale
from mirrorskin.engine.rotation.tilt import estimate_tilt
from mirrorskin.engine.rotation.turns import LONGEST
from mirrorskin.engine.tiling import Band, Planes
from mirrorskin.io import InputError
from mirrorskin.kernels.array import Operand
from mirrorskin.kernels.device import C_TYPES, Device
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
        Of its frames; see ``mirrorskin.engine.rotation.fits``.
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
        noise = noise_of_fit(steep if steep.shape[1] >= _ENOUGH else samples, phase, weights)
    if tilt is None:
        if isinstance(scale, Response):
            raise InputError(
                "a calibrated response does not tell the tilt: calibrate that, or give it, such as 2.5deg"
            )
        tilt = estimate_tilt(samples, phase, weights, matrix, scale.thinned(step), noise)
    return noise, tilt
