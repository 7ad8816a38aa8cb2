"""A surface: heights, how sure they are, and what hangs together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

IntegrationMethod = Literal["direct", "multigrid", "robust"]


@dataclass(frozen=True, slots=True)
class Surface:
    """Heights from slopes, known heights, or both.

    Attributes
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN where there is no answer.
    sigma : ndarray, (H, W), float32, or None
        Standard deviation to be expected of the height, mm: about the mean of its component where that has no
        known height. NaN where there is no answer, and where nothing tells how noisy the slopes are.
    component : ndarray, (H, W), int32
        Which of the connected pieces a pixel belongs to, numbered in reading order of their first pixels;
        -1 where there is no answer.
    offset_unknown : ndarray, (components,), bool
        Whether a piece has no known height: its mean is 0.
    filled : ndarray, (H, W), uint8
        1 where a height was not measured but filled in.
    edges : ndarray, (H, W), uint8, or None
        1 on either side of a discontinuity that was found; None where none was looked for.
    iterations : int
        Of the solver, in all.
    residual : float
        How far the heights are from the solution, over the heights themselves, both as the sum that is made
        least weighs them; 0 of the direct solver, where it is not reckoned.
    converged : bool
        Whether that is as little as was asked for; where nothing was, whether it is below 0.3.
    method : {"direct", "multigrid", "robust"}
        Which solver it was.
    invalid : int
        Pixels that were wanted but whose slopes are no numbers.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32] | None
    component: NDArray[np.int32]
    offset_unknown: NDArray[np.bool_]
    filled: NDArray[np.uint8]
    edges: NDArray[np.uint8] | None
    iterations: int
    residual: float
    converged: bool
    method: IntegrationMethod
    invalid: int
