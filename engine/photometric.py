"""Photometric stereo: normals and albedo of each pixel by its brightness under lamps of known directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import noise_of_residual
from mirrorskin.engine.operation import Operation, optional_phase_function
from mirrorskin.engine.options import option
from mirrorskin.io import InputError, Map, Result
from mirrorskin.io.arguments import as_array
from mirrorskin.io.maps import TABLE
from mirrorskin.io.positions import check_phase
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.array import fetch
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import C_TYPES

if TYPE_CHECKING:
    from mirrorskin.io import Source


_BEYOND = 4.0  # standard deviations of a residual that noise does not explain


class PhotometricStereo(Operation):
    """Normals and albedo of a matt surface under one distant lamp after the other (Woodham 1980).

    E = dark + albedo (normal . light) is fitted to the brightness of each pixel. The phase of each frame is
    the azimuth of a lamp of brightness 1 that goes round at one zenith; lamps at any other places are
    specified by the option ``light``.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> stereo = engine.photometric.PhotometricStereo(zenith=np.pi / 4)
    >>> for azimuth in np.arange(4) * np.pi / 2:
    ...     stereo.push(np.full((1, 1, 2), 50 + 30 * np.cos(azimuth), np.float32), phase=[azimuth])
    >>> round(float(stereo.result().normals[0, 0, 0]), 4)
    0.5145
    """

    takes_device_arrays = True
    dtypes = FRAME_DTYPES
    on_device = True

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
        map=True,
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
        map=True,
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
        """Prepare the kernel and its maps."""
        self._noise = None if self.noise is None else _map("noise", self.noise, shape)
        if self._noise is not None and not np.all(self._noise >= 0):
            raise InputError("noise: standard deviations of a sample are needed, counts from 0 on")
        self._lights = None if self.light is None else _vectors(self.light)
        top = np.inf if dtype.kind == "f" else float(np.iinfo(dtype).max)
        self._saturation = top if self.bright is None else self.bright
        darks = _map("dark", 0.0 if self.dark is None else self.dark, shape)
        self._darks, self._dark_step = self.device.from_host("darks", darks.ravel()), int(darks.ndim > 0)
        self._add = self.device.kernel("lambert", "lambert_add", FRAME=C_TYPES[dtype.name])
        self._solve = self.device.kernel("lambert", "lambert_normals", FRAME=C_TYPES[dtype.name])
        self._triangle = self.device.array("triangle", (11, *shape), np.float32, zeroed=False)

    def clear(self) -> None:
        """Do nothing: the first frame overwrites the sums."""

    def push(self, frames: NDArray[Any], *, phase: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), and the azimuth of each lamp, (n,) radians."""
        lights = self._lights_of(len(frames), phase)
        pixels = self.shape[0] * self.shape[1]
        self._add(
            -(-pixels // self.device.layout.tile), frames=self.device.share("frames", frames),
            count=len(frames), pixels=pixels, lights=self.device.from_host("lights", lights),
            fresh=self.count == 0, darks=self._darks, dark_step=self._dark_step, shadow=self.shadow,
            bright=self._saturation, triangle=self._triangle, moved=frames.nbytes,
        )  # fmt: skip
        self.device.finish()

    def _lights_of(self, count: int, phase: ArrayLike | None) -> Doubles:
        """Return the vectors towards the lamps of the next frames, (n, 3)."""
        if self._lights is not None:
            stop = self.count + count
            if stop > len(self._lights):
                raise InputError(
                    f"light has {len(self._lights)} vectors: one is needed for each of {stop} frames"
                )
            return self._lights[self.count : stop]
        if self.zenith is None:
            raise InputError("phases are azimuths only: specify the zenith of the lamps, radians, or light")
        azimuth, out = check_phase(phase, count, "phase"), np.sin(self.zenith)
        return np.stack(
            [out * np.cos(azimuth), out * np.sin(azimuth), np.full(count, np.cos(self.zenith))], axis=1
        )

    def result(self) -> dict[str, Any]:
        """Return normals and albedo of the frames so far."""
        names = ("normals_spread", "albedo", "albedo_spread", "residual")
        arrays: dict[str, Any] = {
            name: self.device.array(name, self.shape, np.float32, zeroed=False) for name in names
        }
        arrays["normals"] = self.device.array("normals", (*self.shape, 3), np.float32, zeroed=False)
        arrays["samples"] = self.device.array("samples", self.shape, np.int32, zeroed=False)
        pixels, moved = self.shape[0] * self.shape[1], sum(array.nbytes for array in arrays.values())
        self._solve(
            -(-pixels // self.device.layout.tile), pixels=pixels, triangle=self._triangle, **arrays,
            moved=moved + self._triangle.nbytes,
        )  # fmt: skip
        found = fetch([(array, slice(None)) for array in arrays.values()])
        maps = dict(zip(arrays, found, strict=True))
        residual, samples = maps["residual"], maps["samples"]
        noise = noise_of_residual(residual, samples - 3) if self._noise is None else self._noise
        scale = np.asarray(noise, np.float32) * _misfit(residual, samples - 3, noise)
        for name in ("normals", "albedo"):
            maps[f"{name}_sigma"] = maps.pop(f"{name}_spread") * scale
        return maps if np.ndim(noise) or np.isnan(noise) else maps | {"noise": float(noise)}

    def finish(self) -> Result:
        """Return normals and albedo of all frames; their number must be that of the lamps."""
        if self._lights is not None and len(self._lights) != self.count:
            raise InputError(
                f"light has {len(self._lights)} vectors: one is needed for each of {self.count} frames"
            )
        return super().finish()


photometric_stereo = optional_phase_function(
    PhotometricStereo,
    "photometric_stereo",
    """Fit normals and albedo of a matt surface to frames under distant lamps of known directions.

    Least squares of E_k = dark + albedo (normal . light_k) over the frames in which the pixel is lit
    (Woodham 1980). With C = (L'L)^-1 noise^2, rows light_k in L, and P = I - n n' the projection along the
    normal, the normal's squared error is trace(P C) / albedo^2 and the albedo's n'C n: the Cramer-Rao bound.

    Returns
    -------
    Result
        ``normals``, ``albedo`` and their standard deviations are undefined where fewer than three lamps lit
        the pixel, or those that did are coplanar; ``residual`` where it was not more than three. Standard
        deviations are larger where noise does not explain the residual. ``process`` contains the ``noise``,
        counts, if it is one number.

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
    >>> found = engine.photometric.photometric_stereo(frames.astype(np.float32), azimuth, zenith=0.6, noise=1)
    >>> [round(float(part), 3) for part in found.normals[0, 0]], round(float(found.normals_sigma[0, 0]), 4)
    ([0.208, 0.324, 0.923], 0.0153)
    """,
    "Azimuths of a lamp of brightness 1, radians, counter-clockwise from x; needed without ``light``.",
)


def _misfit(residual: NDArray[Any], freedom: NDArray[Any], noise: Any) -> NDArray[Any]:
    """Return the residual over the noise where no noise explains it, as of gloss or a hot sample; else 1."""
    freedom = np.maximum(freedom, 0)
    # The cube root of chi^2 / n is nearly normal (Wilson and Hilferty, PNAS 17, 1931).
    spread = 2 / (9 * np.maximum(np.arange(freedom.max() + 1), 1))
    limit = ((1 - spread + _BEYOND * np.sqrt(spread)) ** 1.5).astype(np.float32)
    limit[0] = np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = residual / np.asarray(noise, np.float32)
        return np.where(ratio > limit[freedom], ratio, np.float32(1))


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
    found = np.asarray(as_array(name, values), np.float32)
    if found.shape not in ((), shape):
        raise InputError(f"{name} has shape {found.shape}: one number or a map {shape} is needed")
    return found
