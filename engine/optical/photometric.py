"""Photometric stereo: normals and albedo of each pixel by its brightness under lamps of known directions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import noise_of_residual, thinned
from mirrorskin.engine.base.functions import optional_phase_function
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import PerFrame, PerPixel, Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.diagnosis.amplitude_blur import LEAST, add_blur
from mirrorskin.engine.optical.lamp_errors import CELLS, LampErrors, LampFit, find_lamp_errors
from mirrorskin.io import InputError, Map
from mirrorskin.io.base.arguments import as_array
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_phase
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io import Source


_FEWEST, _PILED = 64, 3  # samples at the end of the scale, and times those just below it
_NEAR_END = 0.005  # from there to the end, share of it
_BEYOND = 4.0  # standard deviations of a residual that noise does not explain
_PLANES: Mapping[str, Any] = {
    "darks": np.float32,
    "triangle": Planes(11, np.float32),  # least squares of the frames so far, see lambert.cl
    "normals": np.dtype((np.float32, 3)),
    **dict.fromkeys(("albedo", "residual", "normals_sigma", "albedo_sigma"), np.float32),
    "samples": np.int32,
}
_ANSWERS = "normals", "albedo", "residual", "samples", "normals_sigma", "albedo_sigma"


class PhotometricStereo(Operation):
    """Normals and albedo of a matt surface under one distant lamp after the other (Woodham 1980).

    E = dark + albedo (normal . light) is fitted to the brightness of each pixel. The phase of a frame is the
    azimuth of a lamp of brightness 1 that revolves at a constant zenith; other positions of lamps are
    specified by the option ``light``.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> azimuth = np.arange(4) * np.pi / 2
    >>> frames = np.full((4, 1, 2), 50 + 30 * np.cos(azimuth)[:, None, None])
    >>> stereo = engine.optical.PhotometricStereo(zenith=np.pi / 4)
    >>> round(float(engine.run(frames, stereo, phase=azimuth).normals[0, 0, 0]), 4)
    0.5145
    """

    dtypes = FRAME_DTYPES
    checks = (LampErrors,)
    for_device = True

    lamp_fit: LampFit | None = None
    """Errors of light and response of the last result, if samples of the frames show them."""
    _samples: FrameSamples | None = None

    light: ArrayLike | None = option(
        default=None,
        help="vectors towards the lamp of each frame, (T, 3): x to the right, y up, z to the camera, as long"
        " as the lamp is bright",
        shown_default="a lamp at `zenith` whose azimuth is the phase of the frame",
        python_only=True,
    )
    zenith: float | None = option(
        default=None,
        unit="rad",
        within=(0, np.pi / 2),
        help="angle between the direction of the lamp and that of the camera; needed without `light`",
    )
    dark: ArrayLike | None = option(
        default=None,
        unit="counts",
        help="brightness without a lamp, a number or a map (H, W)",
        shown_default="that of the recording or calibration; of arrays, 0",
    )
    bright: float | None = option(
        default=None,
        unit="counts",
        above=0,
        help="brightness from which on a sample is saturated, and left out",
        shown_default="the greatest value of an integer type, or that at which samples pile up",
    )
    shadow: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="brightness above dark up to which a sample is in shadow, and left out: 4 times the noise",
    )
    noise: ArrayLike | None = option(
        default=None,
        unit="counts",
        within=(0, None),
        help="standard deviation of a sample, a number or a map (H, W)",
        shown_default="estimated from the median residual, which needs four frames or more",
    )

    normals = TABLE["normals"]
    normals_sigma = TABLE["normals_sigma"]
    albedo = Map("brightness under a lamp of length 1 that the surface faces", "counts")
    residual = TABLE["residual"]
    samples = Map(
        "number of frames in which the pixel was neither in shadow nor saturated",
        dtype="int32",
        overview=False,
    )

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.positions = {} if self.light is not None else {"phase": True}  # type: ignore[misc]

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's dark level, if none is specified."""
        return self if self.dark is not None else self.with_options(dark=source.header.dark)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare the maps."""
        self._noise = None if self.noise is None else _map("noise", self.noise, shape)
        if self._noise is not None and not np.all(self._noise >= 0):
            raise InputError("noise: standard deviations of a sample are needed, counts from 0 on")
        self._lights = None if self.light is None else _vectors(self.light)
        top = np.inf if dtype.kind == "f" else float(np.iinfo(dtype).max)
        self.saturation = top if self.bright is None else self.bright
        self._maps = Picture(self, "lambert", _PLANES)
        self._maps.fill("darks", _map("dark", 0.0 if self.dark is None else self.dark, shape))

    def push(self, frames: NDArray[Any], *, phase: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), and the azimuth of each lamp, (n,) radians."""
        lights = PerFrame(self.lights(self.count, len(frames), phase))
        self._maps.scan("lambert_add", frames, lights=lights, shadow=self.shadow, bright=self.saturation)

    def after_last_frame(self, samples: FrameSamples) -> Self | None:
        """Return the operation that leaves out samples at the end of the scale, if it is not the type's."""
        self._samples, values = samples, samples.values
        finite = values[np.isfinite(values)]
        top = float(finite.max()) if finite.size else np.inf
        if self.bright is not None or top >= self.saturation:
            return None
        at_top = np.count_nonzero(values == top, axis=(1, 2))
        below = np.count_nonzero((values < top) & (values > top - _NEAR_END * abs(top)))
        cut_off = at_top.sum() >= max(_FEWEST, _PILED * below) and np.count_nonzero(at_top) > 1
        if not cut_off:
            return None
        better = self.with_options(bright=top)
        better._samples = samples
        return better

    def lights(self, first: int, count: int, phase: ArrayLike | None) -> Doubles:
        """Return the vectors towards the lamps of some frames, (n, 3), by their azimuths if needed."""
        if self._lights is not None:
            self._check_lights(first + count, len(self._lights) >= first + count)
            return np.asarray(self._lights[first : first + count])
        if self.zenith is None:
            raise InputError("phases are azimuths only: specify the zenith of the lamps, radians, or light")
        assert phase is not None
        azimuth = check_phase(phase, count, "phase")
        up, out = np.full(count, np.cos(self.zenith)), np.sin(self.zenith)
        return np.stack([out * np.cos(azimuth), out * np.sin(azimuth), up], axis=1)

    def _check_lights(self, frames: int, right: bool) -> None:
        if not right:
            count = 0 if self._lights is None else len(self._lights)
            raise InputError(f"light has {count} vectors: one is needed for each of {frames} frames")

    def result(self) -> dict[str, Any]:
        """Return normals and albedo of the frames so far; in the end there must be one for each lamp."""
        if self.ended and self._lights is not None:
            self._check_lights(self.count, len(self._lights) == self.count)
        self._maps.run("lambert_normals")
        noise = self._noise
        if noise is None:
            residual, samples = thinned(self._maps.view("residual"), self._maps.view("samples"))
            noise = np.asarray(noise_of_residual(residual, samples - 3), np.float32)
        self._maps.run(
            "lambert_scale", noise=PerPixel(noise), noise_step=noise.ndim // 2, limits=_limits(self.count)
        )
        self.lamp_fit = self._find_lamp_errors()
        if self.lamp_fit is not None and self.lamp_fit.significant:
            usual = float(noise) if noise.ndim == 0 else self.lamp_fit.noise
            self._maps.run(
                "lambert_widen",
                tables=self.lamp_fit.tables(self.shadow),
                cells=CELLS,
                noise=self.lamp_fit.noise,
                usual=usual,
            )
        add_blur(self._maps, "normals_sigma", ["normals"], "albedo", LEAST)
        maps = dict(zip(_ANSWERS, self._maps.take(*_ANSWERS), strict=True))
        return maps if noise.ndim or np.isnan(noise) else maps | {"noise": float(noise)}

    def _find_lamp_errors(self) -> LampFit | None:
        """Return the errors of light and response that samples of all frames show."""
        samples = self._samples
        if samples is None:
            return None
        values, dark = samples.values, np.asarray(0.0 if self.dark is None else self.dark)
        level = dark if dark.ndim == 0 else samples.of_map(dark).ravel()
        light = values.reshape(len(values), -1).astype(np.float64) - level
        limits = max(self.shadow, 0.0), self.saturation - level
        usable = (light > limits[0]) & (light < limits[1])
        lamps = self.lights(0, len(light), self.positions_so_far("phase"))
        return find_lamp_errors(light, usable, lamps, limits)


photometric_stereo = optional_phase_function(
    PhotometricStereo,
    "photometric_stereo",
    """Fit normals and albedo of a matt surface to frames under distant lamps of known directions.

    Least squares of E_k = dark + albedo (normal . light_k) over the frames in which the pixel is lit
    (Woodham 1980). With C = (L'L)^-1 noise^2, where the rows of L are light_k, and P = I - n n' the
    projection along the normal, the variance of the normal is trace(P C) / albedo^2 and the variance of the
    albedo n'C n: the Cramer-Rao bounds.

    Returns
    -------
    Result
        ``normals``, ``albedo`` and their standard deviations are undefined where fewer than three lamps light
        the pixel, or these are coplanar; ``residual`` is undefined for three or fewer. Standard deviations
        are increased where noise does not explain the residual. ``process`` contains the ``noise``, counts,
        if it is one number.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, lamps or parameters that cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> azimuth = np.arange(6) * np.pi / 3
    >>> frames = (70 + 20 * np.cos(azimuth - 1))[:, None, None] * np.ones((2, 3), np.float32)
    >>> found = engine.optical.photometric_stereo(frames.astype(np.float32), azimuth, zenith=0.6, noise=1)
    >>> [round(float(part), 3) for part in found.normals[0, 0]], round(float(found.normals_sigma[0, 0]), 4)
    ([0.208, 0.324, 0.923], 0.0153)
    """,
    "Azimuths of a lamp of brightness 1, radians, counter-clockwise from x; needed without ``light``.",
)


def _limits(frames: int) -> NDArray[np.float32]:
    """Return the largest residual that noise of 1 explains, unlike gloss, by the degrees of freedom."""
    # The cube root of chi^2 / n is nearly normal (Wilson and Hilferty, PNAS 17, 1931).
    spread = 2 / (9 * np.maximum(np.arange(frames + 1), 1))
    limits = ((1 - spread + _BEYOND * np.sqrt(spread)) ** 1.5).astype(np.float32)
    limits[0] = np.inf
    return limits


def _vectors(light: ArrayLike) -> Doubles:
    """Return the vectors towards the lamps, (T, 3)."""
    vectors = np.asarray(as_array("light", light), np.float64)
    if vectors.ndim != 2 or vectors.shape[1:] != (3,):
        raise InputError(f"light has shape {vectors.shape}: (T, 3) is needed, a vector for each frame")
    length = np.linalg.norm(vectors, axis=1)
    if not np.all((length > 1e-6) & (length < 1e6)):
        raise InputError(f"light has lengths {length.min():.3g} to {length.max():.3g}: 1 or so is needed")
    return vectors


def _map(name: str, values: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return counts, a number or a map."""
    array = np.asarray(as_array(name, values), np.float32)
    if array.shape not in ((), shape):
        raise InputError(f"{name} has shape {array.shape}: one number or a map {shape} is needed")
    return array
