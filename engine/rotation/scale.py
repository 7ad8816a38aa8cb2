"""From counts to zeniths: the scale of a sensor whose brightness is linear in the zenith."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.rotation.design_matrix import Doubles
from mirrorskin.engine.rotation.tilt import one_wave
from mirrorskin.io import InputError

_OPEN = {"low": -np.inf, "high": np.inf}


@dataclass(frozen=True)
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

    @cached_property
    def ends(self) -> bool:
        """Whether brightness is linear between some zeniths only."""
        return bool(np.isfinite(self.planes[2:]).any())

    def thinned(self, step: int) -> Doubles:
        """Return the scale of each so-manieth pixel, (4,) or (4, n)."""
        return self.planes.reshape(4, -1)[:, ::step] if self.per_pixel else self.planes

    def telling(self, wave: Doubles, step: int) -> NDArray[np.bool_]:
        """Tell which of so many pixels show little but one wave a turn; see ``one_wave``."""
        return one_wave(wave, self.thinned(step))


def make_scale(
    gain: ArrayLike | None,
    offset: ArrayLike,
    low: ArrayLike | None,
    high: ArrayLike | None,
    shape: tuple[int, int],
) -> Scale:
    """Check a scale and bring it into the kernels' form.

    Parameters
    ----------
    gain : array_like, scalar or (H, W)
        Counts per radian of zenith; below 0 where steeper is darker. A pixel with 0 or NaN has no answer.
    offset : array_like, scalar or (H, W)
        Counts at zenith 0.
    low, high : array_like, scalar or (H, W), or None
        Counts between which brightness is linear, where the pattern or the light ends.
    shape : (int, int)
        Rows and columns of a frame.

    Raises
    ------
    InputError
        A shape that does not fit, no gain but 0 or NaN, no offset that is a number, or a low above its high.
    """
    if gain is None:
        raise InputError("a zenith gain is needed: counts per radian, such as 206, or a calibration")
    given = {"zenith gain": gain, "zenith offset": offset, "low": low, "high": high}
    known = {name: _as_map(name, value, shape) for name, value in given.items() if value is not None}
    rate, zero = known["zenith gain"], known["zenith offset"]
    if not np.any(np.isfinite(rate) & (rate != 0)):
        told = f"zenith gain {rate}" if rate.ndim == 0 else "the zenith gain of every pixel is 0 or no number"
        raise InputError(f"{told}: counts per radian other than 0 are needed; calibrate, or leave it out")
    if not np.isfinite(zero).any():
        raise InputError("the zenith offset is no number: give the counts at zenith 0, such as 10")
    for name in ("low", "high"):
        if name in known and not np.isfinite(known[name]).any():
            raise InputError(
                f"{name} is no number: give the counts at which brightness ends, or leave it out"
            )
    with np.errstate(divide="ignore", invalid="ignore"):
        per_count = np.where(np.isfinite(rate) & np.isfinite(zero) & (rate != 0), 1 / rate, np.nan)
        ends = [(known.get(name, np.asarray(end)) - zero) * per_count for name, end in _OPEN.items()]
    if "low" in known and "high" in known and not np.any(known["low"] < known["high"]):
        raise InputError("low is not below high at any pixel: are they swapped?")
    lowest, highest = np.fmin(*ends), np.fmax(*ends)
    return Scale(np.stack(np.broadcast_arrays(zero, per_count, lowest, highest)).astype(np.float64))


def _as_map(name: str, values: ArrayLike, shape: tuple[int, int]) -> Doubles:
    array = np.asarray(values, np.float64)
    if array.shape not in ((), shape):
        raise InputError(
            f"{name} has shape {array.shape}, the frames are {shape[0]} x {shape[1]}:"
            " give one number or a map of the frames' size"
        )
    return array
