"""Least squares of brightness over the directions of the light: ``lambert.cl`` in NumPy.

The samples E_k of a pixel that are neither dark nor saturated, and the lamps' vectors l_k, are the rows (l_k,
E_k) of a matrix. The triangle R of its QR decomposition (Golub and Van Loan, Matrix Computations, section
5.3) is sufficient for least squares, loses nothing by cancellation, and is updated with further rows by
rotations. It is stored as squares of the diagonal and rows divided by the diagonal, whose rotations need no
roots (Gentleman, J. Inst. Maths Applics 12, 1973).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LEAST_PIVOT = 1e-3
"""Relative pivot of the lamps' directions below which they count as coplanar."""

_DIAGONAL: Any = np.diag_indices(4)
_ABOVE: Any = np.array([0, 0, 1, 0, 1, 2]), np.array([1, 2, 2, 3, 3, 3])


def lambert_add(
    frames: Array, lights: Array, darks: Array, first: int, shadow: float, bright: float, triangle: Array
) -> None:
    """Add frames; the triangle is updated in place.

    Parameters
    ----------
    frames : (n, P), uint8, uint16 or float32
    lights : (n, 3)
    darks : (P,), counts without light, which are subtracted
    first : number of the first of the frames; before frame 0, the triangle is undefined
    shadow : lower limit of usable samples (exclusive), counts above dark
    bright : upper limit of usable samples (exclusive), counts
    triangle : (11, P). Planes 0 to 2 are the squares of the diagonal of R; 3 to 5 its elements
        above the diagonal, each divided by that of its row, and 6 to 8 the last column of these rows. Then
        the residual sum of squares, and the number of usable samples
    """
    if first == 0:
        triangle[:] = 0
    light = frames.astype(np.float32) - darks
    usable = (light > shadow) & (frames < bright)
    rows = np.concatenate([np.broadcast_to(lights[:, None], (*usable.shape, 3)), light[..., None]], axis=2)
    before = np.zeros((frames.shape[1], 4, 4))
    before[(slice(None), *_DIAGONAL)] = np.sqrt(triangle[[0, 1, 2, 9]].T)
    before[(slice(None), *_ABOVE)] = triangle[3:9].T * before[:, _ABOVE[0], _ABOVE[0]]
    lit = np.where(usable.T[..., None], rows.swapaxes(0, 1), 0)
    after: Array = np.linalg.qr(np.concatenate([before, lit], axis=1)).R
    pivots = after[:, _ABOVE[0], _ABOVE[0]]
    triangle[[0, 1, 2, 9]] = after[(slice(None), *_DIAGONAL)].T ** 2
    triangle[3:9] = np.divide(
        after[(slice(None), *_ABOVE)], pivots, out=np.zeros_like(pivots), where=pivots != 0
    ).T
    triangle[10] += usable.sum(axis=0)


def lambert_normals(triangle: Array, normals: Array, normals_sigma: Array, albedo: Array,
                    albedo_sigma: Array, residual: Array, samples: Array) -> None:  # fmt: skip
    """Solve the fits represented by triangles, (11, P).

    Parameters
    ----------
    triangle : as of `lambert_add`
    normals : (P, 3), unit vectors; ``normals`` and ``albedo`` are NaN if the lamps of the usable samples are
        coplanar
    normals_sigma, albedo_sigma : (P,), standard deviations for noise of standard deviation 1
    albedo : (P,)
    residual : (P,), standard deviation of a sample; NaN unless more than three samples are usable
    samples : (P,), number of usable samples
    """
    *squares, r01, r02, r12, r03, r13, r23, rest, used = triangle.astype(np.float64)
    r00, r11, r22 = np.sqrt(squares)
    r01, r02, r12, r03, r13, r23 = r00 * r01, r00 * r02, r11 * r12, r00 * r03, r11 * r13, r22 * r23
    size = np.sqrt(r00**2 + r01**2 + r02**2 + r11**2 + r12**2 + r22**2)
    freedom = used - 3
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        residual[:] = np.sqrt(rest / np.where(freedom > 0, freedom, np.nan))
        a, d, f = 1 / r00, 1 / r11, 1 / r22
        b, e = -r01 * a * d, -r12 * d * f
        c = -(r01 * e + r02 * f) * a
        vector = np.stack([a * r03 + b * r13 + c * r23, d * r13 + e * r23, f * r23], axis=-1)
        length = np.linalg.norm(vector, axis=-1)
        answered = np.minimum(np.minimum(r00, r11), r22) > LEAST_PIVOT * size
        answered &= (length > 0) & np.isfinite(length)
        normals[:] = np.where(answered[:, np.newaxis], vector / length[:, np.newaxis], np.nan)
        x, y, z = normals.T
        radial = (a * x) ** 2 + (b * x + d * y) ** 2 + (c * x + e * y + f * z) ** 2
        whole = a**2 + b**2 + c**2 + d**2 + e**2 + f**2
        normals_sigma[:] = np.sqrt(whole - radial) / length
        albedo_sigma[:] = np.sqrt(radial)
    albedo[:] = np.where(answered, length, np.nan)
    samples[:] = used


def lambert_scale(residual: Array, samples: Array, noise: Array, limits: Array, normals_sigma: Array,
                  albedo_sigma: Array) -> None:  # fmt: skip
    """Multiply standard deviations, in place, by the noise, or by the residual that noise does not explain.

    Parameters
    ----------
    residual, samples, normals_sigma, albedo_sigma : as of `lambert_normals`
    noise : (P,) or (1,), standard deviation of a sample; in the kernel value ``noise_step * p``
    limits : (n,), largest residual that noise of 1 explains, by the degrees of freedom
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = residual / noise
        scale = noise * np.where(ratio > limits[np.maximum(samples - 3, 0)], ratio, 1)
    normals_sigma *= scale
    albedo_sigma *= scale


def lambert_widen(normals: Array, albedo: Array, tables: Array, cells: int, noise: float, usual: float,
                  normals_sigma: Array, albedo_sigma: Array) -> None:  # fmt: skip
    """Add the variance of errors of the light, which depends on normal and albedo, to standard deviations.

    Parameters
    ----------
    normals, albedo, normals_sigma, albedo_sigma : as of `lambert_normals`
    tables : (7, (cells + 1)^2), by the normal's x and y from -1 to 1. With the albedo r, a + b / r + c / r^2
        is the variance of the normal for planes 0 to 2, and that of the albedo over r^2 for planes 3 to 5;
        plane 6 is the variance of what the light does not explain, counts^2
    noise : standard deviation of a sample without errors of the light
    usual : standard deviation of a sample that is in the standard deviations
    """
    known = albedo > 0
    x, y, _ = normals[known].T
    row, column = (((part + 1) * (0.5 * cells) + 0.5).astype(int).clip(0, cells) for part in (x, y))
    *parts, misfit = tables.reshape(7, cells + 1, cells + 1)[:, row, column]
    factor, length = np.maximum((noise**2 + misfit) / usual**2, 1), albedo[known]
    normal, radial = (np.maximum(a + (b + c / length) / length, 0) for a, b, c in (parts[:3], parts[3:]))
    normals_sigma[known] = np.sqrt(normals_sigma[known] ** 2 * factor + normal)
    albedo_sigma[known] = np.sqrt(albedo_sigma[known] ** 2 * factor + radial * length**2)
