"""How the sheet lies in one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """The mirror in one frame, in the body's frame, at the points that the pixels see.

    Attributes
    ----------
    height : ndarray, (H, W), float64
        Millimetres above the rest plane, 0 or more.
    dz_dx, dz_dy : ndarray, (H, W), float64
        Its slopes along the body's x and y.
    contact : ndarray, (H, W), bool
        Whether sheet and object touch there.
    """

    height: Floats
    dz_dx: Floats
    dz_dy: Floats
    contact: NDArray[np.bool_]
