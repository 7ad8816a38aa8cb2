"""Least squares over the phases of a rotation: ``correlation.cl`` in plain NumPy.

Samples E_k at the phases alpha_k are fitted by a + b cos alpha_k + c sin alpha_k, which minimises SS = sum_k
w_k (E_k - a - b cos alpha_k - c sin alpha_k)^2. With X the matrix of rows (1, cos alpha, sin alpha) and W the
weights, four sums over the samples suffice: Z'E, where Z is W X up to rounding, and E'W E.

Integer counts of frames with weight 1 are summed as integers, with the cosines and sines of Z rounded to
multiples of a unit. The sums are therefore exact for any length and any division of a stack. The rounding of
Z is harmless: (Z'X)^-1 Z'E is an instrumental-variable estimate (Reiersol, Econometrica 9, 1941), exact for
samples that satisfy the model, and SS is then E'W E - beta' X'W X beta. For other samples the difference from
least squares is the noise times the rounding, less than 1e-5 of the noise.

Other samples are summed as pairs of floats, which are as accurate as float64, after subtracting the first
sample; Z is then rounded to float32.

``fit`` is a table, (28,) float32, that converts the sums s = Z'(E - r) of a pixel's samples minus its
reference r. With L'L = X'W X, L upper triangular ::

    u = L (Z'X)^-1 s        (a - r, b, c) = L^-1 u        SS = sum_k w_k (E_k - r)^2 - u'u

It contains the matrix L (Z'X)^-1, row by row, as two floats each, all the high ones first; L^-1; and the
inverse of the degrees of freedom, N - 3, or NaN if there are none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.int64]
Array = NDArray[Any]
Floats = NDArray[np.float64]
Answers = tuple[Floats, Floats, Floats, Floats]

WINDOW = 64
"""Maximum number of frames that can be summed at once, and in a sliding window."""


def correlation_window(frames: Array, place: Array, basis: Array, used: int, cosines: int, sines: int,
                       fit: Array) -> Answers:  # fmt: skip
    """Return mean, cosine, sine and residual, counts, of at most `WINDOW` frames of weight 1.

    It combines ``correlation_add`` and ``correlation_solve_counts``; the kernel's sums are int32 for uint8.
    """
    total, cosine, sine, square = sums = np.zeros((4, frames.shape[1]), np.int64)
    correlation_add(frames, place, basis, 0, *sums)
    return correlation_solve_counts(used, cosines, sines, total, cosine, sine, square, fit)


def correlation_add(frames: Array, place: Array, basis: Array, first: int, total: Counts, cosine: Counts,
                    sine: Counts, square: Counts) -> None:  # fmt: skip
    """Add frames of weight 1 to sums, or start new sums if ``first`` is 0.

    Parameters
    ----------
    frames : (n, P), uint8 or uint16
    place : (m,), which of them
    basis : (m, 3), 1, and cosine and sine in whole units
    total, cosine, sine, square : (P,), sums of the samples, of their products with cosine and sine, in units,
        and of their squares
    """
    if first == 0:
        for array in (total, cosine, sine, square):
            array[:] = 0
    for number, (_, along, across) in zip(place, basis.astype(np.int64), strict=True):
        sample = frames[number].astype(np.int64)
        total += sample
        cosine += along * sample
        sine += across * sample
        square += sample**2


def correlation_solve_counts(used: int, cosines: int, sines: int, total: Counts, cosine: Counts,
                             sine: Counts, square: Counts, fit: Array) -> Answers:  # fmt: skip
    """Return mean, cosine, sine and residual, counts, from integer sums over ``used`` frames.

    ``cosines`` and ``sines`` are the sums over the frames, units; for ``fit`` see the module.
    """
    return _solve(_centre(used, cosines, sines, total, cosine, sine, square), fit)


def correlation_convert(used: int, cosines: int, sines: int, unit: float, total: Counts, cosine: Counts,
                        sine: Counts,
                        square: Counts) -> tuple[Floats, Floats, Floats, Floats, Floats]:  # fmt: skip
    """Return the reference and the sums for ``correlation_sum``; the kernel works in place.

    ``unit`` is the unit of the rounded cosines and sines.
    """
    reference, *sums = _centre(used, cosines, sines, total, cosine, sine, square)
    return reference, sums[0], unit * sums[1], unit * sums[2], sums[3]


def correlation_sum(frames: Array, place: Array, basis: Array, first: int, reference: Array, total: Floats,
                    cosine: Floats, sine: Floats, square: Floats) -> None:  # fmt: skip
    """Add frames of any weights to sums.

    If ``first`` is 0, new sums start with the first sample as the reference, which is subtracted from all
    samples.
    ``basis``, (m, 3), contains for each frame its weight, and the weight times cosine and sine of its phase.
    The kernel stores each sum as a pair of floats.
    """
    if first == 0:
        reference[:] = frames[place[0]]
        for array in (total, cosine, sine, square):
            array[:] = 0
    for number, (weight, along, across) in zip(place, basis.astype(np.float64), strict=True):
        sample = (frames[number].astype(np.float32) - reference.astype(np.float32)).astype(np.float64)
        total += weight * sample
        cosine += along * sample
        sine += across * sample
        square += weight * sample**2


def correlation_solve_pairs(
    reference: Array, total: Floats, cosine: Floats, sine: Floats, square: Floats, fit: Array
) -> Answers:
    """Return mean, cosine, sine and residual, counts, from the sums of ``correlation_sum``."""
    return _solve(np.stack([reference.astype(np.float64), total, cosine, sine, square]), fit)


def correlation_window_pairs(frames: Array, place: Array, basis: Array, fit: Array) -> Answers:
    """Return mean, cosine, sine and residual, counts, of frames of any weights, without keeping sums."""
    reference, total, cosine, sine, square = sums = np.zeros((5, frames.shape[1]))
    correlation_sum(frames, place, basis, 0, *sums)
    return correlation_solve_pairs(reference, total, cosine, sine, square, fit)


def _centre(
    frames: int, cosines: int, sines: int, total: Counts, cosine: Counts, sine: Counts, square: Counts
) -> Floats:
    """Subtract an integer near the mean from all samples: return it and the exact sums, (5, P)."""
    reference = np.floor(total / frames + 0.5).astype(np.int64)
    rest = total - reference * frames
    spread = square - reference * (total + rest)
    parts = reference, rest, cosine - reference * cosines, sine - reference * sines, spread
    return np.stack(parts).astype(np.float64)


def _solve(sums: Floats, fit: Array) -> Answers:
    """Return mean, cosine, sine and residual from sums, (5, P), the reference first."""
    table = fit.astype(np.float64)
    parts = (table[:9] + table[9:18]).reshape(3, 3) @ sums[1:4]
    mean, cosine, sine = table[18:27].reshape(3, 3) @ parts
    residual_square = sums[4] - np.sum(parts**2, axis=0)
    return (
        sums[0] + mean,
        cosine,
        sine,
        np.sqrt(np.where(residual_square < 0, 0, residual_square) * table[27]),
    )
