"""From dark and bright references to the counts at which each pixel turns light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError

Floats = NDArray[np.float64]

_ROUNDING = 1e-12


def check_threshold(threshold: float) -> float:
    """Return the threshold if it is a share between dark and bright, else raise InputError."""
    if not 0 <= threshold <= 1:
        raise InputError(f"threshold {threshold}: a share from 0 (dark) to 1 (bright) is needed, such as 0.5")
    return threshold


def reference_pair(
    dark: ArrayLike | None, bright: ArrayLike | None, shape: tuple[int, int], dtype: np.dtype[Any]
) -> tuple[Floats, Floats]:
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
    dark, bright : ndarray, (H, W), float64
        NaN where bright is not above dark: such a pixel, dead or hot, can answer nothing.

    Raises
    ------
    InputError
        A shape that does not fit, float frames without references, or a bright that is not above dark
        at half of the pixels or more.
    """
    if dtype.kind == "f" and (dark is None or bright is None):
        raise InputError("float frames have no natural range: give dark and bright, as counts or as maps")
    top = 0 if dtype.kind == "f" else np.iinfo(dtype).max
    low = _as_map("dark", 0 if dark is None else dark, shape)
    high = _as_map("bright", top if bright is None else bright, shape)
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(low) & np.isfinite(high) & (high > low)
    if 2 * np.count_nonzero(usable) <= usable.size:
        share = 100 * (1 - np.count_nonzero(usable) / usable.size)
        raise InputError(f"bright is not above dark at {share:.3g} % of the pixels: are they swapped?")
    return np.where(usable, low, np.nan), np.where(usable, high, np.nan)


def light_levels(
    dark: Floats, bright: Floats, threshold: float, dtype: np.dtype[Any]
) -> tuple[NDArray[np.float32], NDArray[Any]]:
    """Turn a share of the way from dark to bright into counts, once, before the first frame.

    Parameters
    ----------
    dark, bright : ndarray, (H, W), float64
        Counts; NaN where a pixel has no references.
    threshold : float
        Share of the way at which a pixel counts as light.
    dtype : dtype
        Type of a sample.

    Returns
    -------
    level : ndarray, (H, W), float32
        Counts, the smallest float32 that reaches the threshold; NaN without references.
    light : ndarray, (H, W), dtype
        Smallest sample that is light. A saturated sample is always light.
    """
    # A threshold such as 0.55 is not exact in binary: counts that reach it but for rounding are light.
    exact = dark + (threshold - _ROUNDING) * (bright - dark)
    level = exact.astype(np.float32)
    level = np.where(level < exact, np.nextafter(level, np.float32(np.inf)), level)
    if dtype.kind == "f":
        return level, level.astype(dtype)
    top = np.iinfo(dtype).max
    return level, np.ceil(np.nan_to_num(level, nan=top)).clip(0, top).astype(dtype)


def _as_map(name: str, values: ArrayLike, shape: tuple[int, int]) -> Floats:
    array = np.asarray(values, np.float64)
    if array.shape not in ((), shape):
        raise InputError(
            f"{name} reference has shape {array.shape}, the frames are {shape[0]} x {shape[1]}: "
            "give one number or a map of the frames' size"
        )
    return np.broadcast_to(array, shape)
