"""What is checked and found out of frames before any are summed: type, size, noise, dark and bright."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.io import FRAME_DTYPES, InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

SAMPLES = 65536
_CLIP = 4.0
_MEDIAN = 0.6745  # of the magnitude of a normal variate
QUANTUM = 1 / math.sqrt(12)
"""The least noise of whole counts: that of their rounding."""


def thinning(shape: tuple[int, ...]) -> int:
    """Return which so-manieth pixel of a frame to take for evenly spread samples."""
    return max(1, math.prod(shape) // SAMPLES)


def thin_out(frame: NDArray[Any]) -> NDArray[np.float64]:
    """Take evenly spread samples of a frame, enough to know its noise within half a per cent."""
    return frame.reshape(-1)[:: thinning(frame.shape)].astype(np.float64)


def estimate_noise(first: NDArray[np.float64], second: NDArray[np.float64], integer: bool) -> float:
    """Estimate the standard deviation of a sample from two looks at the same pixels.

    Clipping at four sigma, until it settles, leaves out the pixels that changed in between, as long as they
    are fewer than half.

    Parameters
    ----------
    first, second : ndarray, (n,), float64
        Counts of the same pixels in two frames.
    integer : bool
        Whether counts are whole numbers; their rounding is then the least noise there is.

    Returns
    -------
    float
        Counts.
    """
    usable = np.isfinite(first) & np.isfinite(second)
    difference = second[usable] - first[usable]
    if difference.size == 0:
        return QUANTUM if integer else 0.0
    spread = max(np.median(np.abs(difference)) / _MEDIAN, 1.0 if integer else 0.0)
    for _ in range(10):
        kept = difference[np.abs(difference) <= _CLIP * spread]
        if spread == (spread := float(np.sqrt(np.mean(kept**2)))):
            break
    noise = spread / np.sqrt(2)
    return float(max(noise, QUANTUM) if integer else noise)


class Noise:
    """The standard deviation of a sample: given, or told from the first two frames that are seen.

    Parameters
    ----------
    given : float, optional
        Counts.
    integer : bool
        Whether counts are whole numbers.
    """

    def __init__(self, given: float | None, integer: bool) -> None:
        if given is not None and not 0 <= given < np.inf:
            raise InputError(f"noise {given}: a standard deviation in counts is needed, such as 1.5")
        self._given = given
        self._integer = integer
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._seen: list[NDArray[np.float64]] = []
        self.value = self._given

    def look(self, frames: NDArray[Any]) -> None:
        """See the next frames, (n, H, W); only the first two of all count."""
        if self.value is not None:
            return
        self._seen += [thin_out(frame) for frame in frames[: 2 - len(self._seen)]]
        if len(self._seen) == 2:
            self.value = estimate_noise(self._seen[0], self._seen[1], self._integer)


def check_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return the type of samples if kernels take it, else raise InputError."""
    found = np.dtype(dtype)
    if found not in FRAME_DTYPES:
        raise InputError(f"frames of type {found}: uint8, uint16 or float32 are needed")
    return found


def check_frames(frames: NDArray[Any], dtype: np.dtype[Any], shape: tuple[int, int]) -> None:
    """Raise InputError unless frames are one or more of a type and size, (n, *shape)."""
    if frames.dtype != dtype or frames.shape[1:] != shape or len(frames) == 0:
        raise InputError(f"frames of {frames.dtype} {frames.shape}: expected {dtype} (n, *{shape})")


def travel_pairs(device: Device, travel: ArrayLike) -> Array:
    """Hand travel, (T,), mm, to a device as (T, 2) floats, whose sums are as good as float64."""
    exact = np.asarray(travel, np.float64)
    pairs = device.array("travel", (len(exact), 2), np.float32)
    pairs.host[:, 0] = exact
    pairs.host[:, 1] = exact - pairs.host[:, 0]
    pairs.upload()
    return pairs


Floats = NDArray[np.float64]


def check_threshold(threshold: float) -> float:
    """Return the threshold if it is a share between dark and bright, else raise InputError."""
    if not 0 <= threshold <= 1:
        raise InputError(f"threshold {threshold}: a share from 0 (dark) to 1 (bright) is needed, such as 0.5")
    return threshold


def reference_maps(
    dark: ArrayLike | None, bright: ArrayLike | None, shape: tuple[int, int], dtype: np.dtype[Any]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Check the references and fill in what is missing from the range of the frames' type.

    Parameters
    ----------
    dark, bright : array_like, scalar or (H, W), or None
        Counts without and with full light.
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        Type of a sample.

    Returns
    -------
    dark, bright : ndarray, scalar or (H, W), float32

    Raises
    ------
    InputError
        A shape that does not fit, float frames without references, or a bright that is not above dark
        at half or more of the pixels where both are known, or none known at all.
    """
    if dtype.kind == "f" and (dark is None or bright is None):
        raise InputError("float frames have no natural range: give dark and bright, as counts or as maps")
    top = 0 if dtype.kind == "f" else np.iinfo(dtype).max
    low = _as_map("dark", 0 if dark is None else dark, shape)
    high = _as_map("bright", top if bright is None else bright, shape)
    both = np.isfinite(low) & np.isfinite(high)
    known, usable = np.count_nonzero(both), np.count_nonzero(both & _above(high, low))
    if known == 0:
        raise InputError("no pixel has a dark and a bright that are numbers: take the references again")
    if 2 * usable <= known:
        share = 100 * (1 - usable / known)
        raise InputError(f"bright is not above dark at {share:.3g} % of the pixels: are they swapped?")
    return low, high


def reference_pair(
    dark: ArrayLike | None, bright: ArrayLike | None, shape: tuple[int, int], dtype: np.dtype[Any]
) -> tuple[Floats, Floats]:
    """Do as ``reference_maps``, and return maps (H, W), float64, for all pixels.

    Both are NaN where bright is not above dark: such a pixel, dead or hot, can answer nothing.
    """
    low, high = reference_maps(dark, bright, shape, dtype)
    usable = np.isfinite(low) & np.isfinite(high) & _above(high, low)
    dark_map, bright_map = (
        np.broadcast_to(np.where(usable, part.astype(np.float64), np.nan), shape) for part in (low, high)
    )
    return dark_map, bright_map


def _above(bright: NDArray[np.float32], dark: NDArray[np.float32]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        above: NDArray[np.bool_] = bright > dark
    return above


def _as_map(name: str, values: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    array = np.asarray(values, np.float32)
    if array.shape not in ((), shape):
        raise InputError(
            f"{name} reference has shape {array.shape}, the frames are {shape[0]} x {shape[1]}: "
            "give one number or a map of the frames' size"
        )
    return array
