"""How sure what was fitted to a map is, where errors of neighbours go together.

Errors of heights that were integrated from slopes are alike over many pixels. A fit then is far less sure
than so many independent pixels would make it. What its residuals have in common tells: they are projected on
a few smooth shapes that the fit leaves free. Errors with the form's own shape cannot be seen, as the fit took
them in; but they are as large as those of the other smooth shapes, if errors have no reason to look like the
form. So the mean square of the projections is the variance of what the fit took in: the long-run variance by
orthonormal series of Y. Sun, "A heteroskedasticity and autocorrelation robust F test using an orthonormal
series variance estimator", The Econometrics Journal 16 (2013). White errors, correlated ones and a form that
does not fit are all seen to by it.

Where errors are so smooth that the form takes most of them in, residuals are smaller than what the heights'
standard deviations claim. The variance that is missing there is counted as taken in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_ROUNDING = 1e-9  # of the squared length of the longest shape: a shorter one is the form's own

_SINGULAR = 1e-14  # the same, of columns that should be independent
_OVERSTATED = 0.1  # of the claimed variance, that may be missing because claims are not exact


def covariance(gram: Doubles, parameters: int, count: int, claimed: float = 0.0) -> Doubles:
    """Estimate the covariance of parameters that minimise a weighted sum of squares.

    Parameters
    ----------
    gram : ndarray, (k + m + 1, k + m + 1), float64
        Weighted sums over all residuals of the products of: the derivatives of a residual by the k
        parameters, m smooth functions of its place, about as smooth as the derivatives, and the residual
        itself, at the minimum. Weights are any multiple of the inverse variances.
    parameters, count : int
        How many parameters and residuals.
    claimed : float
        What the weighted sum of squares is expected to be, from standard deviations; 0 without these.

    Returns
    -------
    ndarray, (k, k), float64
        NaN where there are too few residuals to tell.
    """
    scale = np.sqrt(np.diag(gram))
    lengths = np.where(scale > 0, scale, np.inf)
    gram = gram / np.multiply.outer(lengths, lengths)
    inverse = _inverse(gram[:parameters, :parameters])
    across = gram[:parameters, parameters:]
    # Of shapes and residuals, what the form leaves.
    left = gram[parameters:, parameters:] - across.T @ inverse @ across
    variance = scale[-1] ** 2 * _variance(left, count - parameters)
    # Not by all: errors that are so smooth go more into one parameter than into another.
    taken_in = max((1 - _OVERSTATED) * claimed - scale[-1] ** 2, 0.0) / max(parameters - 1, 1)
    own = lengths[:parameters]
    return np.asarray((variance + taken_in) * inverse / np.multiply.outer(own, own))


def _inverse(normal: Doubles) -> Doubles:
    """Invert normal equations, of columns of length 1; directions that nothing tells of are left out."""
    lengths, directions = np.linalg.eigh(normal)
    real = directions[:, lengths > _SINGULAR] / np.sqrt(lengths[lengths > _SINGULAR])
    return np.asarray(real @ real.T)


def _variance(left: Doubles, freedom: int) -> float:
    """Return the variance of a smooth shape's amplitude, or of a pixel's error if that is larger."""
    lengths, directions = np.linalg.eigh(left[:-1, :-1])
    real = lengths > _ROUNDING
    white = max(float(left[-1, -1]), 0.0)
    free = min(int(np.count_nonzero(real)), freedom)
    if free < 3:
        return np.nan if freedom < 1 else white / freedom
    power = (directions[:, real].T @ left[:-1, -1]) ** 2 / lengths[real]
    # Of so few amplitudes the mean square is uncertain itself: the variance of Student's t.
    smooth = float(np.sum(power)) / (free - 2)
    return max(smooth, white / freedom)
