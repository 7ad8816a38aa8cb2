"""Differences of height maps, with their standard deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.inputs import Maps, as_result, spacing
from mirrorskin.engine.metrology.patch import heights_of, noise_length
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.findings import carried
from mirrorskin.io.model.maps import IN_PIXELS
from mirrorskin.io.model.result import in_pixels

_SAME_SIZE = 1e-3  # largest relative difference of pixel sizes


def subtract(result: Maps, reference: Maps) -> Result:
    """Subtract the heights of a reference, such as a flat or an earlier state, from those of a result.

    Parameters
    ----------
    result, reference : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Both of the same size and pixel size.

    Returns
    -------
    Result
        ``height``, NaN where one of both has none; ``height_sigma``, the root sum of squares, if both have
        one; ``filled`` where one of both was filled; and components of both, with an unknown offset if that
        of one is unknown. Pixel size, calibration and process are those of the result. Errors are correlated
        over the length of those that are larger. Normals, contact and other maps are left out.

    Raises
    ------
    InputError
        A result has no heights, or they differ in size or pixel size.

    Examples
    --------
    >>> wear = subtract(np.full((2, 3), 0.5), np.full((2, 3), 0.25))
    >>> wear.height.tolist()
    [[0.25, 0.25, 0.25], [0.25, 0.25, 0.25]]
    """
    first, second = as_result(result, "result"), as_result(reference, "reference")
    upper, lower = heights_of(first), heights_of(second)
    if upper.shape != lower.shape:
        raise InputError(
            f"the reference has {lower.shape[1]} x {lower.shape[0]} pixels, and the result"
            f" {upper.shape[1]} x {upper.shape[0]}: take one of the same picture"
        )
    if first.x is not None and first.y is not None and second.x is not None and second.y is not None:
        sizes = spacing(first.x, first.y), spacing(second.x, second.y)
        if not np.allclose(*sizes, rtol=_SAME_SIZE):
            shown = (" x ".join(f"{value:.4g}" for value in size) for size in sizes)
            raise InputError(
                "the pixel size of the result is {} mm, and of the reference {} mm".format(*shown)
            )
    if in_pixels(first) != in_pixels(second):
        raise InputError(
            "heights of the result and of the reference are in px and mm: the pixel size of one is unknown"
        )
    difference = (upper.astype(np.float64) - lower).astype(np.float32)
    known = np.isfinite(difference)
    sigma = None
    length = max(noise_length(first), noise_length(second))
    if first.height_sigma is not None and second.height_sigma is not None:
        errors = first.height_sigma, second.height_sigma
        sigma = np.where(known, np.hypot(*errors), np.float32(np.nan)).astype(np.float32)
        typical = [
            float(np.nan_to_num(np.nanmedian(error[known]))) if known.any() else 0.0 for error in errors
        ]
        length = noise_length(first if typical[0] >= typical[1] else second)
    filled = None
    if first.filled is not None or second.filled is not None:
        filled = np.zeros(known.shape, np.uint8)
        for maps in (first, second):
            if maps.filled is not None:
                filled |= (known & (maps.filled != 0)).astype(np.uint8)
    component, unknown = _components(first, second, known)
    return Result(
        height=difference,
        height_sigma=sigma,
        filled=filled,
        component=component,
        offset_unknown=unknown,
        x=first.x if first.x is not None else second.x,
        y=first.y if first.y is not None else second.y,
        process={**first.process, **carried(first.process, reference=second.process)},
        calibration=first.calibration,
        declarations=IN_PIXELS if in_pixels(first) else None,
    ).with_fitted(height_correlation=length)


def _components(
    first: Result, second: Result, known: NDArray[np.bool_]
) -> tuple[NDArray[np.int32] | None, NDArray[np.uint8] | None]:
    """Return components within one of each result, and whether the offset of either is unknown."""
    labels = np.zeros(known.shape, np.int64)
    relative = np.zeros(known.shape, bool)
    for maps in (first, second):
        if maps.component is not None and maps.offset_unknown is not None:
            own = maps.component.astype(np.int64) + 1  # 0 for pixels without one, which are absolute
            labels = labels * (int(own.max()) + 1) + own
            relative |= np.concatenate([[False], maps.offset_unknown != 0])[own]
    if not relative.any():
        return None, None
    numbers, component = np.unique(labels[known], return_inverse=True)
    whole = np.full(known.shape, -1, np.int32)
    whole[known] = component.reshape(-1)
    unknown = np.zeros(numbers.size, np.uint8)
    unknown[whole[known & relative]] = 1
    return whole, unknown
