"""Conversion of counts to zeniths, for a sensor whose brightness is linear in the zenith."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.tilt import STEEP
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Linear brightness E = offset + gain zenith, within limits of the zenith.

    The planes, (4,) or (4, H, W), are the counts at zenith 0, radians per count, and the lowest and the
    highest zenith of the linear range. They are NaN without a scale.
    """

    planes: Doubles

    @property
    def per_pixel(self) -> bool:
        """Whether the scale is a map."""
        return self.planes.ndim == 3

    def thinned(self, step: int) -> Doubles:
        """Return the scale of every ``step``-th pixel, (4,) or (4, n)."""
        return self.planes.reshape(4, -1)[:, ::step] if self.per_pixel else self.planes

    def clear_pixels(self, wave: Doubles, step: int) -> NDArray[np.bool_]:
        """Return which of every ``step``-th pixel are steep enough for one wave per turn to be a good fit.

        ``wave``, (3, n), is the mean, cosine and sine of the samples, counts.
        """
        offset, per_count = np.broadcast_to(self.thinned(step).reshape(4, -1)[:2], (2, wave.shape[1]))
        return np.asarray((wave[0] - offset) * per_count > STEEP * np.hypot(*wave[1:]) * np.abs(per_count))


def make_scale(
    gain: ArrayLike | None,
    offset: ArrayLike | None,
    dark: ArrayLike | None,
    bright: ArrayLike | None,
    shape: tuple[int, int],
) -> Scale:
    """Return a scale, or raise InputError; see `mirrorskin.engine.estimate_normals`.

    With a gain below 0, steeper surfaces are darker; a pixel with a gain of 0 or NaN has no scale.
    """
    if gain is None:
        raise InputError("a zenith gain is needed: counts per radian, such as 206, or a calibration")
    offset = 0.0 if offset is None else offset
    options = {"zenith gain": gain, "zenith offset": offset, "dark": dark, "bright": bright}
    levels = {name: _as_map(name, value, shape) for name, value in options.items() if value is not None}
    rate, zero = levels["zenith gain"], levels["zenith offset"]
    check_gain(rate)
    if not np.isfinite(zero).any():
        raise InputError("the zenith offset is not a number: give the counts at zenith 0, such as 10")
    for name in ("dark", "bright"):
        if name in levels and not np.isfinite(levels[name]).any():
            raise InputError(
                f"{name} is not a number: give the counts at which brightness ends, or leave it out"
            )
    if "dark" in levels and "bright" in levels and not np.any(levels["dark"] < levels["bright"]):
        raise InputError("dark is not below bright at any pixel: are they swapped?")
    with np.errstate(divide="ignore", invalid="ignore"):
        sound = np.isfinite(rate) & (rate != 0) & np.isfinite(zero)
        per_count = np.where(sound, 1 / rate, np.nan)
        ends = [
            (levels.get(name, np.asarray(end)) - zero) * per_count
            for name, end in (("dark", -np.inf), ("bright", np.inf))
        ]
    planes = np.stack(np.broadcast_arrays(zero, per_count, np.fmin(*ends), np.fmax(*ends)))
    first = planes.reshape(4, -1)[:, 0]
    is_uniform = np.array_equal(planes, np.broadcast_to(first, planes.T.shape).T)
    return Scale((first if is_uniform else planes).astype(np.float64))  # a kernel need not read uniform maps


def check_gain(gain: ArrayLike) -> None:
    """Raise InputError if a zenith gain is 0 or not a number at every pixel."""
    rate = np.asarray(gain, np.float64)
    if not np.any(np.isfinite(rate) & (rate != 0)):
        what = f"zenith_gain {rate}" if rate.ndim == 0 else "zenith_gain is 0 or not a number at every pixel"
        raise InputError(f"{what}: counts per radian other than 0 are needed; calibrate, or leave it out")


def _as_map(name: str, values: ArrayLike, shape: tuple[int, int]) -> Doubles:
    array = np.asarray(values, np.float64)
    if array.shape not in ((), shape):
        raise InputError(
            f"{name} has shape {array.shape}, the frames are {shape[0]} x {shape[1]}:"
            " give one number or a map of the frames' size"
        )
    return array
