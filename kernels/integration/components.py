"""Heights of a surface's connected components: ``components.cl`` in NumPy with float64.

A solver returns the relief: heights above a plane, up to an offset of each component.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.integration.links import KNOWN, Flags, Triple

Array = NDArray[Any]
Labels = NDArray[np.int32]


def components_sum(flags: Flags, labels: Labels, relief: Array, plane: Triple, heights: Array | None,
                   height_weights: Array | None, components: int) -> tuple[Doubles, Doubles]:  # fmt: skip
    """Return a sum of heights for each component, and its divisor for the mean; (components,) each.

    If heights are known, it is the weighted sum of the excess of the computed heights over these. ``labels``
    are the component numbers of pixels, -1 without a result; ``plane`` is the rise of the plane per column
    and per row, and its height in the top left pixel, mm. Each of the kernel's items sums over a strip of
    rows.
    """
    height, weight = relief + _level(plane, flags.shape), (labels >= 0).astype(np.float64)
    if heights is not None:
        is_known = flags & KNOWN != 0
        weight = is_known * np.where(is_known, 1.0 if height_weights is None else height_weights, 0.0)
        height = height - np.where(is_known, heights, 0.0)
    inside = weight > 0
    where, some = labels[inside], weight[inside]
    sums, totals = (np.bincount(where, part, components) for part in (some * height[inside], some))
    return np.asarray(sums, np.float64), np.asarray(totals, np.float64)


def components_offsets(
    sums: Array, totals: Array, unknown: Array, of_unknown: int, mean: float, offsets: Array
) -> None:
    """Write the offsets that set the mean of the selected components; other offsets are unchanged.

    Components without a known height are selected if ``of_unknown`` is 1, otherwise those with one.
    ``sums`` and ``totals``, (strips, components), are results of `components_sum`; ``unknown`` is 1 for a
    component without a known height.
    """
    sum_, total = (part.sum(axis=0, dtype=np.float64) for part in (sums, totals))
    means = np.divide(sum_, total, out=np.zeros(len(sum_)), where=total > 0)
    offsets[unknown == of_unknown] = (mean - means)[unknown == of_unknown]


def components_add_offsets(
    flags: Flags, labels: Labels, relief: Array, plane: Triple, offsets: Array
) -> Doubles:
    """Return heights: relief, plane, and the offset of the component, mm; NaN without a result."""
    height = relief + _level(plane, flags.shape) + np.asarray(offsets, np.float64)[labels]
    return np.where(labels >= 0, height, np.nan)


def _level(plane: Triple, shape: tuple[int, ...]) -> Doubles:
    row, column = np.indices(shape)
    return np.asarray(plane[2] + plane[0] * column + plane[1] * row)
