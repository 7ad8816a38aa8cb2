"""Photometric stereo: normals and albedo of each pixel by its brightness under lamps of known directions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import noise_of_residual, thinned
from mirrorskin.engine.base.functions import optional_phase_function
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import PerFrame, PerPixel, Picture
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.diagnosis.amplitude_blur import add_blur
from mirrorskin.io import InputError, Map, Result
from mirrorskin.io.base.arguments import as_array
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_phase
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io import Source


_FEWEST, _CLEAR, _POWER = 64, 6.0, 0.03  # pixels, standard errors, and change of the power that decide
_BEYOND = 4.0  # standard deviations of a residual that noise does not explain
_PLANES: Mapping[str, Any] = {
    "darks": np.float32,
    "triangle": Planes(11, np.float32),  # least squares of the frames so far, see lambert.cl
    "normals": np.dtype((np.float32, 3)),
    **dict.fromkeys(("albedo", "residual", "normals_sigma", "albedo_sigma"), np.float32),
    "samples": np.int32,
}
_ANSWERS = "normals", "albedo", "residual", "samples", "normals_sigma", "albedo_sigma"


class ResponseLinearity(Step):
    """Warn if the brightness is not proportional to the light."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result; its process has the warning, if another power of the light fits better."""
        operation, samples = cast("PhotometricStereo", context.operation), context.samples
        if samples is None:
            return result
        values, dark = samples.values, np.asarray(0.0 if operation.dark is None else operation.dark)
        level = dark if dark.ndim == 0 else samples.of_map(dark).ravel()
        light = values.reshape(len(values), -1).astype(np.float64) - level
        lamps = operation.lights(0, len(light), context.positions("phase"))
        lit = np.all((light > max(operation.shadow, 0.0)) & (light < operation.saturation - level), axis=0)
        power = _power(light[:, lit], lamps)
        if power == 1:
            return result
        text = (
            f"the brightness is not proportional to the light, but to its power {power:.2g}, as with gamma"
            " (or gloss), so normals are wrong by more than their sigma: use a camera with a linear response"
        )
        return with_findings(result, Finding("response", text))


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
    checks = (ResponseLinearity,)
    for_device = True

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
        shown_default="the greatest value of an integer type",
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
        add_blur(self._maps, "normals_sigma", ["normals"], "albedo")
        maps = dict(zip(_ANSWERS, self._maps.take(*_ANSWERS), strict=True))
        return maps if noise.ndim or np.isnan(noise) else maps | {"noise": float(noise)}


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


def _power(light: Doubles, lamps: Doubles) -> float:
    """Return the power of the light to which brightness is proportional; 1 if that is not contradicted.

    With the light x = albedo (normal . lamp), x^g is x + (g - 1) x log x to first order. ``light``, (T, n),
    is brightness less dark, ``lamps`` are vectors, (T, 3).
    """
    if light.shape[1] < _FEWEST or len(lamps) < 5:
        return 1.0
    axes = np.linalg.qr(lamps)[0]
    fitted = axes @ (axes.T @ light)
    light, fitted = (part[:, np.all(fitted > 0, axis=0)] for part in (light, fitted))
    if light.shape[1] < _FEWEST:
        return 1.0
    bent = fitted * np.log(fitted / np.mean(fitted, axis=0))
    bent -= axes @ (axes.T @ bent)
    residual = light - axes @ (axes.T @ light)
    size, pull = np.sum(bent**2, axis=0), np.sum(bent * residual, axis=0)
    excess = float(np.sum(pull) / np.sum(size))
    error = float(np.sqrt(np.sum((pull - excess * size) ** 2)) / np.sum(size))
    return 1 + excess if abs(excess) > max(_CLEAR * error, _POWER) else 1.0


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
