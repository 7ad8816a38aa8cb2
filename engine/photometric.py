"""Photometric stereo: normals and albedo of each pixel by its brightness under lamps of known directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_dtype, check_frames, noise_of_residual
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError
from mirrorskin.io.arguments import as_array, checked
from mirrorskin.io.positions import check_phase
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import C_TYPES, Device, open_device

Doubles = NDArray[np.float64]

_FLATTEST = 1e-3  # least pivot of the lamps' directions, of their size: below it they lie in a plane


@dataclass(frozen=True, slots=True, repr=False)
class Lambertian(Shown):
    """The fit E = dark + albedo (normal . light) of each pixel; NaN where fewer than three lamps lit it.

    Attributes
    ----------
    normals : ndarray, (H, W, 3), float32
        Unit vectors along x, y and z.
    normals_sigma : ndarray, (H, W), float32
        Radians: the RMS angle to the true normal that is expected.
    albedo, albedo_sigma : ndarray, (H, W), float32
        Counts under a lamp of length 1 that faces the surface, and the standard error.
    residual : ndarray, (H, W), float32
        Counts: sqrt(SS / (n - 3)), the standard deviation of a sample; NaN where n is 3.
    samples : ndarray, (H, W), int32
        In how many frames n the pixel was neither dark nor saturated.
    noise : float or ndarray, (H, W)
        Counts: the standard deviation of a sample that the standard errors go by; NaN if it is not given and
        no pixel has more than three samples.
    """

    normals: NDArray[np.float32]
    normals_sigma: NDArray[np.float32]
    albedo: NDArray[np.float32]
    albedo_sigma: NDArray[np.float32]
    residual: NDArray[np.float32]
    samples: NDArray[np.int32]
    noise: float | NDArray[Any]


class PhotometricStereo(ThreadSafe):
    """An `Estimator` for frames under one lamp after the other; see `photometric_stereo`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    zenith, dark, bright, shadow, noise, device
        As for `photometric_stereo`.

    Examples
    --------
    >>> stereo = PhotometricStereo((1, 2), "float32", zenith=np.pi / 4)
    >>> for azimuth in np.arange(4) * np.pi / 2:
    ...     stereo.push(np.full((1, 1, 2), 50 + 30 * np.cos(azimuth), np.float32), phase=[azimuth])
    >>> round(float(stereo.result().normals[0, 0, 0]), 4)
    0.5145
    """

    device: Device

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        zenith: float | None = None,
        dark: ArrayLike = 0.0,
        bright: float | None = None,
        shadow: float = 0.0,
        noise: ArrayLike | None = None,
        device: str | Device | None = None,
    ) -> None:
        self._shape, self._dtype, self.device = shape, check_dtype(dtype), open_device(device)
        self._zenith, self._noise = zenith, None if noise is None else _map("noise", noise, shape)
        if noise is not None and not np.all(np.asarray(noise) >= 0):
            raise InputError("noise: standard deviations of a sample are needed, counts from 0 on")
        if zenith is not None and not 0 < zenith < np.pi / 2:
            raise InputError(f"zenith {zenith}: an angle between 0 and pi/2 is needed, radians")
        top = np.inf if self._dtype.kind == "f" else float(np.iinfo(self._dtype).max)
        self._bright, self._shadow = top if bright is None else bright, shadow
        if not (shadow >= 0 and self._bright > 0):
            raise InputError(f"shadow {shadow} and bright {self._bright}: counts from 0 on are needed")
        darks = _map("dark", dark, shape)
        self._darks, self._dark_step = self.device.given("darks", darks.ravel()), int(darks.ndim > 0)
        self._add = self.device.kernel("lambert", "lambert_add", FRAME=C_TYPES[self._dtype.name])
        self._triangle = self.device.array("triangle", (11, *shape), np.float32)
        self._fresh = True

    def push(
        self, frames: NDArray[Any], *, phase: ArrayLike | None = None, light: ArrayLike | None = None
    ) -> None:
        """Take in the next frames, (n, H, W), and each lamp's azimuth, radians, or vector, (n, 3)."""
        check_frames(frames, self._dtype, self._shape)
        if (phase is None) == (light is None):
            raise InputError("the lamps' phase (azimuths) or light (vectors) is needed, and not both")
        lights = _lights(phase if light is None else light, len(frames), self._zenith)
        pixels = self._shape[0] * self._shape[1]
        self._add(
            -(-pixels // self.device.layout.tile), frames=self.device.seen("frames", frames),
            count=len(frames), pixels=pixels, lights=self.device.given("lights", lights),
            fresh=self._fresh, darks=self._darks, dark_step=self._dark_step, shadow=self._shadow,
            bright=self._bright, triangle=self._triangle, moved=frames.nbytes,
        )  # fmt: skip
        self.device.finish()
        self._fresh = False

    def result(self) -> Lambertian:
        """Return normals and albedo of the frames so far."""
        if self._fresh:
            raise InputError("no frame was pushed: at least three are needed")
        triangle = self._triangle.download().astype(np.float64)
        r00, r01, r02, r03, r11, r12, r13, r22, r23, rest, used = triangle
        freedom = used - 3
        size = np.sqrt(r00**2 + r01**2 + r02**2 + r11**2 + r12**2 + r22**2)
        solid = np.minimum(np.minimum(r00, r11), r22) > _FLATTEST * size
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            residual = np.sqrt(rest / np.where(freedom > 0, freedom, np.nan))
            # The triangle's inverse, whose product with its transpose is the covariance for noise 1.
            a, d, f = 1 / r00, 1 / r11, 1 / r22
            b, e = -r01 * a * d, -r12 * d * f
            c = -(r01 * e + r02 * f) * a
            vector = np.stack([a * r03 + b * r13 + c * r23, d * r13 + e * r23, f * r23], axis=-1)
            albedo = np.linalg.norm(vector, axis=-1)
            normals = vector / albedo[..., None]
            x, y, z = np.moveaxis(normals, -1, 0)
            radial = (a * x) ** 2 + (b * x + d * y) ** 2 + (c * x + e * y + f * z) ** 2
            whole = a**2 + b**2 + c**2 + d**2 + e**2 + f**2
            noise = noise_of_residual(residual, freedom) if self._noise is None else self._noise
            normals_sigma, albedo_sigma = noise * np.sqrt(whole - radial) / albedo, noise * np.sqrt(radial)
        known = solid & np.isfinite(albedo) & (albedo > 0)
        normals[~known] = normals_sigma[~known] = albedo[~known] = albedo_sigma[~known] = np.nan
        shown, spread, gain, gain_spread, left = (
            one.astype(np.float32) for one in (normals, normals_sigma, albedo, albedo_sigma, residual)
        )
        kept = noise if np.ndim(noise) else float(noise)
        return Lambertian(shown, spread, gain, gain_spread, left, used.astype(np.int32), kept)

    def reset(self) -> None:
        """Forget the frames so far."""
        self._fresh = True


@checked
def photometric_stereo(
    frames: NDArray[Any],
    light: ArrayLike,
    *,
    zenith: float | None = None,
    dark: ArrayLike = 0.0,
    bright: float | None = None,
    shadow: float = 0.0,
    noise: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Lambertian:
    """Fit normals and albedo of a matt surface to frames under distant lamps of known directions.

    Least squares of E_k = dark + albedo (normal . light_k) over the frames in which the pixel is lit
    (Woodham 1980). With C = (L'L)^-1 noise^2, rows light_k in L, and P = I - n n' the projection along the
    normal, the normal's squared error is trace(P C) / albedo^2 and the albedo's n'C n: the Cramer-Rao bound.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Counts, linear in the light.
    light : array_like, (T, 3) or (T,)
        Vectors towards the lamps, x to the right, y up, z to the camera, as long as a lamp is bright; or the
        azimuths, radians, of a lamp of brightness 1 that goes round at one zenith.
    zenith : float, optional
        Radians between the lamps' directions and the camera's; needed with azimuths.
    dark : float or array_like, (H, W)
        Counts without a lamp.
    bright : float, optional
        Counts from which on a sample is saturated, and left out; by default the greatest of an integer type.
    shadow : float
        Counts above dark up to which a sample is in shadow, and left out: 0 without noise, else 4 times it.
    noise : float or array_like, (H, W), optional
        Counts: standard deviation of a sample. By default from the median residual, which needs four frames
        or more.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Lambertian

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
    >>> found = engine.photometric_stereo(frames.astype(np.float32), azimuth, zenith=0.6, noise=1)
    >>> [round(float(part), 3) for part in found.normals[0, 0]], round(float(found.normals_sigma[0, 0]), 4)
    ([0.208, 0.324, 0.923], 0.0153)
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    rows, columns = frames.shape[1:]
    stereo = PhotometricStereo(
        (rows, columns), frames.dtype, zenith=zenith, dark=dark, bright=bright, shadow=shadow, noise=noise,
        device=device,
    )  # fmt: skip
    stereo.push(frames, light=light)
    return stereo.result()


def _lights(light: ArrayLike | None, count: int, zenith: float | None) -> Doubles:
    """Return the vectors towards the lamps of so many frames, (n, 3)."""
    given = np.asarray(as_array("light", light), np.float64)
    if given.shape == (count, 3):
        length = np.linalg.norm(given, axis=1)
        if not np.all((length > 1e-6) & (length < 1e6)):
            raise InputError(f"light has lengths {length.min():.3g} to {length.max():.3g}: 1 or so is needed")
        return given
    if given.shape != (count,):
        raise InputError(f"light has shape {given.shape}: ({count}, 3) or ({count},) is needed")
    if zenith is None:
        raise InputError("azimuths alone do not tell where the lamps are: give their zenith, radians, too")
    azimuth, out = check_phase(given, count, "light"), np.sin(zenith)
    return np.stack([out * np.cos(azimuth), out * np.sin(azimuth), np.full(count, np.cos(zenith))], axis=1)


def _map(name: str, values: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return counts, a number or a map."""
    found = np.asarray(as_array(name, values), np.float32)
    if found.shape not in ((), shape):
        raise InputError(f"{name} has shape {found.shape}: one number or a map {shape} is needed")
    return found
