"""What is looked at: shapes that are as quickly made as they are measured."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.slopes import blob_mask

_MOST = 500  # rows of a mask that is made pixel by pixel


def make_mask(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a mask with holes and islands; that of a large picture is made small and drawn large."""
    coarser = -(-shape[0] // _MOST)
    small = blob_mask((-(-shape[0] // coarser), -(-shape[1] // coarser)))
    if coarser == 1:
        return small
    return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
