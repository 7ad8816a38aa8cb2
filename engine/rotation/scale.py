"""From counts to zeniths: the scale of a sensor whose brightness is linear in the zenith."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.design_matrix import Doubles
from mirrorskin.engine.rotation.tilt import one_wave
from mirrorskin.io import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """How brightness goes with the zenith: E = offset + gain zenith, between two zeniths.

    Attributes
    ----------
    planes : ndarray, (4,) or (4, H, W), float64
        Counts at zenith 0; radians per count; the lowest and the highest zenith to which that holds. NaN
        where a pixel has no scale.
    """

    planes: Doubles

    @property
    def per_pixel(self) -> bool:
        """Whether each pixel has a scale of its own."""
        return self.planes.ndim == 3

    @property
    def ends(self) -> bool:
        """Whether brightness is linear between some zeniths only."""
        return bool(np.isfinite(self.planes[2:]).any())

    def thinned(self, step: int) -> Doubles:
        """Return the scale of every ``step``-th pixel, (4,) or (4, n)."""
        return self.planes.reshape(4, -1)[:, ::step] if self.per_pixel else self.planes

    def clear_pixels(self, wave: Doubles, step: int) -> NDArray[np.bool_]:
        """Return which of every ``step``-th pixel show little but one wave a turn; see `one_wave`."""
        return one_wave(wave, self.thinned(step))


def make_scale(
    gain: ArrayLike | None,
    offset: ArrayLike | None,
    dark: ArrayLike | None,
    bright: ArrayLike | None,
    shape: tuple[int, int],
) -> Scale:
    """Return a scale in the kernels' form, if it is one; see `mirrorskin.engine.estimate_normals`.

    A gain below 0 is that of a sensor to which steeper is darker; a pixel with 0 or NaN has no answer.
    """
    if gain is None:
        raise InputError("a zenith gain is needed: counts per radian, such as 206, or a calibration")
    given = {
        "zenith gain": gain,
        "zenith offset": 0.0 if offset is None else offset,
        "dark": dark,
        "bright": bright,
    }
    known = {name: _as_map(name, value, shape) for name, value in given.items() if value is not None}
    rate, zero = known["zenith gain"], known["zenith offset"]
    check_gain(rate)
    if not np.isfinite(zero).any():
        raise InputError("the zenith offset is not a number: give the counts at zenith 0, such as 10")
    for name in ("dark", "bright"):
        if name in known and not np.isfinite(known[name]).any():
            raise InputError(
                f"{name} is not a number: give the counts at which brightness ends, or leave it out"
            )
    if "dark" in known and "bright" in known and not np.any(known["dark"] < known["bright"]):
        raise InputError("dark is not below bright at any pixel: are they swapped?")
    with np.errstate(divide="ignore", invalid="ignore"):
        sound = np.isfinite(rate) & (rate != 0) & np.isfinite(zero)
        per_count = np.where(sound, 1 / rate, np.nan)
        ends = [
            (known.get(name, np.asarray(end)) - zero) * per_count
            for name, end in (("dark", -np.inf), ("bright", np.inf))
        ]
    planes = zero, per_count, np.fmin(*ends), np.fmax(*ends)
    return Scale(np.stack(np.broadcast_arrays(*planes)).astype(np.float64))


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
