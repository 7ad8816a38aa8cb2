"""Maps with holes, made whole roughly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage


def with_nearest(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map, (H, W), in which what is no number is that of the nearest pixel that has one."""
    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(values), return_distances=False, return_indices=True
    )
    return np.asarray(values[tuple(nearest)])
