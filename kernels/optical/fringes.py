"""Phase of fringes from their cosine and sine: ``fringes.cl`` in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def fringes_phase(cosine_part: Array, sine_part: Array, residual: Array, noise: Array, residual_noise: float,
                  misfit: float, cosine_variance: float, covariance: float,
                  sine_variance: float) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return phase and its standard deviation, radians, and the modulation.

    Without modulation, or with a large residual, the phase is NaN, and its standard deviation infinite.

    Parameters
    ----------
    cosine_part, sine_part, residual : (P,), counts
    noise : (P,) or (1,), standard deviation of a sample, counts; in the kernel value ``noise_step * p``
    residual_noise : noise estimated from the residuals, counts; NaN if unknown
    misfit : largest residual in units of the larger of both noises
    cosine_variance, covariance, sine_variance : covariance of cosine and sine for samples of variance 1
    """
    c, s = cosine_part.astype(np.float64), sine_part.astype(np.float64)
    square = c * c + s * s
    variance = (cosine_variance * s - 2 * covariance * c) * s + sine_variance * c * c
    undefined = (residual > misfit * np.fmax(noise, residual_noise)) | (square == 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = noise * np.sqrt(variance) / square
    phase = np.where(undefined, np.nan, np.arctan2(s, c))
    return phase, np.where(undefined, np.inf, sigma), np.sqrt(square)
