"""Maps without gaps: each pixel without a number takes that of the nearest one with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def fill_with_nearest(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map, (H, W), whose NaN are replaced by the nearest number."""
    from scipy import ndimage

    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(values), return_distances=False, return_indices=True
    )
    return np.asarray(values[tuple(nearest)])
