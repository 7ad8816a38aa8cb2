"""Filling of undefined pixels with the value of the nearest defined one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def fill_with_nearest(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map, (H, W), with NaN replaced by the nearest number; distances are accurate to 2 %."""
    import cv2

    known = np.isfinite(values)
    if known.all():
        return values
    gaps = (~known).view(np.uint8)
    _, label = cv2.distanceTransformWithLabels(gaps, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    numbers = np.full(label.max() + 1, np.nan, values.dtype)
    numbers[label[known]] = values[known]
    return np.asarray(numbers[label])
