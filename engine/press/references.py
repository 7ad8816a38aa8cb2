"""From dark and bright references to the counts at which each pixel turns light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError

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
