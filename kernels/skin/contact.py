"""Contact of a rigid surface with an elastic half-space near an earlier one: ``contact.cl`` in float64.

The displacement of a window's pixels by the strain on them is a convolution with an even kernel. It is
computed wave by wave along rows, and from row to row::

    u[i, j] = sum over k of B[j, k] sum over l of W[|i - l|, k] sum over m of B[m, k] e[l, m]

B are cosines and sines of a period of two windows, so that no pixel is as far from another as from its next
image, and W the transform of the kernel along rows. The approximate inverse, which preconditions the
conjugate gradients, has the same form. The stage adds ``lift`` times the sum of the strain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.conjugate_gradients import Face, Solution, conjugate_gradients

Array = NDArray[Any]

NOTHING = -1e30
"""Height of a pixel without a surface."""
WORK = 10
"""Maps of a window in the memory for work, for each part and work-group."""
PLANES, NUMBERS, LOADS = 8, 25, 12
"""Maps of the window and numbers that `contact_follow` finds, and maps that it sums with."""
MARGIN, SHARE = 2, 16
"""Blocks around a contact, and the fraction of its length, in which other maps are averaged."""
LANES = 8
"""Columns of a window are a multiple of it."""
MOST_CHANGES, MOST_STEPS = 40, 300
"""Largest number of changes of a contact, and of conjugate-gradient steps between two of them."""


def contact_follow(
    binning: int,
    top: int,
    left: int,
    travel: float,
    bend: float,
    loose: float,
    least: float,
    lift: float,
    own: float,
    height: Array,
    sigma: Array | None,
    displacement: Array | None,
    displacement_sigma: Array | None,
    basis: Array,
    weights: Array,
    inverse: Array,
    loads: Array,
    found: Array,
) -> None:
    """Average maps over blocks, and find the contact with their surface, the strain in it, and sums of both.

    Conjugate gradients solve for the strain with which the sheet follows the surface in the current contact;
    then blocks that are pulled are removed, and overlapping ones are added, until the contact does not
    change. Gaps in contact, and overlaps elsewhere, are at most a tolerance, mm: ``loose`` times the greatest
    height, or ``least`` if that is more. A block remains in contact if a pull that displaces it by less would
    be needed.

    Parameters
    ----------
    binning : int
        Pixels on a side of a block. The mean is that of the defined pixels, or undefined if most are.
    top, left : int
        First block of the window. The window may extend beyond the maps.
    travel, bend : float
        Added to the heights, mm; factor of second differences between blocks, which the heights are reduced
        by, because means are lower than the centre on a dome.
    loose, least : float
    lift, own : float
        Displacement by unit strain on one block: of the sheet against the stage, and of the block itself, mm.
    height : (H, W)
        Above the rest plane at travel 0, mm; NaN or infinite where there is none.
    sigma : (H, W), optional
    displacement : (H, W, 2), optional
    displacement_sigma : (H, W) or (H, W, 2), optional
    basis : (columns, 2 columns)
    weights, inverse : (1, rows or more, 2 columns)
        Of each distance in rows; see above. Waves are cosines, and from the middle on the last cosine and
        sines.
    loads : (`LOADS`, rows, columns)
        Strains by which gaps are weighted, three maps; weights of heights, three; weights of displacements
        along x and along y, two for each sum; and two earlier contacts.
    found : (blocks + `PLANES` rows columns + `NUMBERS`,)
        Strain and contact of an initial guess. Afterwards heights of all blocks at their centres, mm, NaN
        where there is none; maps of the window; and numbers.

        The maps are gap in contact, mm, 0 elsewhere, or NaN if the contact did not converge; strain; contact,
        0 or 1; and near the contact, else 0: variance, the mean square of ``sigma``; two displacements; and
        the mean squares of their standard deviations.

        The numbers, defined if there is a contact, are sums over the window: strain above 0, times 1, x, y,
        x^2 and y^2, in blocks from the middle along columns and rows; contact; contact at its border; where
        it differs from the first and from the second earlier contact; the second one; blocks without a
        height; inverse standard deviations of heights in contact; three of weighted gaps; covariances xx, xy,
        xz, yy, yz and zz of three sums of heights; two sums of displacements; and their variances. Errors
        are independent.
    """
    high, wide = (size // binning for size in height.shape)
    columns = len(basis)
    rows = (found.size - high * wide - NUMBERS) // (PLANES * columns)
    surface, sheet = found[: high * wide].reshape(high, wide), found[high * wide : -NUMBERS]
    sheet = sheet.reshape(PLANES, rows, columns)
    means = _means(height, binning)
    surface[:] = means + travel
    for values, centres in ((means, surface), (means.T, surface.T)):
        second = values[2:] - 2 * values[1:-1] + values[:-2]
        centres[1:-1] -= bend * np.where(np.isfinite(second), second, 0.0)
    tolerance = max(loose * np.nanmax(surface, initial=NOTHING), least)
    inside = slice(top, top + rows), slice(left, left + columns)
    height_there = np.full((rows, columns), NOTHING)
    there = slice(0, min(rows, high - top)), slice(0, min(columns, wide - left))
    height_there[there] = np.where(np.isfinite(surface[inside]), surface[inside], NOTHING)
    contact = (sheet[2:3] > 0) & (height_there > 0)
    sheet[:3] = _follow(
        tolerance, tolerance / own, lift, basis, weights, inverse, height_there, sheet[1:2], contact
    )
    sheet[3:] = 0
    if np.isnan(sheet[0, 0, 0]) or not sheet[2].any():
        return
    row, column = np.nonzero(sheet[2])
    width = -(-(np.ptp(column) + 1) // LANES) * LANES
    first = min(column.min(), columns - width)
    more = MARGIN + max(np.ptp(row) + 1, width) // SHARE
    near = np.zeros((rows, columns), bool)
    near[max(row.min() - more, 0) : row.max() + 1 + more, max(first - more, 0) : first + width + more] = True
    for plane, part, power in ((3, sigma, 2), (4, displacement, 1), (6, displacement_sigma, 2)):
        if part is not None:
            for number, kind in enumerate(np.moveaxis(np.atleast_3d(part), -1, 0)):
                sheet[plane + number][there] = np.where(
                    near[there], _means(kind**power, binning)[inside], 0.0
                )
    if displacement_sigma is not None and displacement_sigma.ndim == 2:
        sheet[7] = sheet[6]
    lost = int(np.count_nonzero(~np.isfinite(surface[inside])))
    found[-NUMBERS:] = _sums(sheet, loads, lost)


def _sums(sheet: Array, loads: Array, lost: int) -> Doubles:
    """Return the numbers of `contact_follow`."""
    gap, strain, contact, variance = sheet[:4]
    y, x = (places - (size - 1) / 2 for places, size in zip(np.indices(gap.shape), gap.shape, strict=True))
    pressure, touches = np.maximum(strain, 0), contact > 0
    whole = np.pad(touches, 1)
    inside = whole[:-2, 1:-1] & whole[2:, 1:-1] & whole[1:-1, :-2] & whole[1:-1, 2:]
    moments = np.einsum("nij,ij->n", np.stack([np.ones_like(x), x, y, x * x, y * y]), pressure)
    counts = [touches.sum(), (touches & ~inside).sum(), *((contact - loads[10:]) ** 2).sum(axis=(1, 2))]
    counts += [loads[11].sum(), lost, (1 / np.sqrt(np.maximum(variance[touches], 1e-30))).sum()]
    covariance = np.einsum("nij,mij,ij->nm", loads[3:6], loads[3:6], variance)[np.triu_indices(3)]
    weights = loads[6:10].reshape(2, 2, *gap.shape)
    forces = np.einsum("klij,lij->k", weights, sheet[4:6])
    variances = np.einsum("klij,lij->k", weights**2, sheet[6:8])
    lacking = np.einsum("nij,ij->n", loads[:3], gap)
    return np.concatenate([moments, counts, lacking, covariance, forces, variances])


def _follow(
    tolerance: float,
    pull: float,
    lift: float,
    basis: Array,
    weights: Array,
    inverse: Array,
    surface: Array,
    strain: Array,
    contact: NDArray[np.bool_],
) -> Array:
    """Return gap, strain and contact, (3, rows, columns), with a surface, from initial strain and contact."""
    for _ in range(MOST_CHANGES):
        start = np.where(contact, strain, 0.0)
        solution = _solve(tolerance, lift, basis, weights, inverse, surface[np.newaxis], contact, start)
        gap, strain = solution.product - surface, solution.x
        changed = np.where(contact, strain > -pull, gap < -tolerance)
        if solution.converged and np.array_equal(changed, contact):
            return np.concatenate([np.where(contact, gap, 0.0), strain, contact])
        contact = changed
    return np.concatenate([np.full_like(strain, np.nan), strain, contact])


def _means(values: Array, binning: int) -> Doubles:
    """Return the means of the finite pixels of blocks, NaN where most are not."""
    high, wide = (size // binning for size in values.shape)
    blocks = values[: high * binning, : wide * binning].reshape(high, binning, wide, binning)
    finite = np.isfinite(blocks)
    count = finite.sum(axis=(1, 3))
    total = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
    return np.where(2 * count >= binning**2, total / np.maximum(count, 1), np.nan)


def contact_load(
    parts: int,
    tolerance: float,
    lift: float,
    basis: Array,
    weights: Array,
    inverse: Array,
    contact: Array,
    forms: Array,
    strains: Array,
) -> None:
    """Find the strains that move a contact by given forms.

    Parameters
    ----------
    parts : int
        1 for pressures; 2 for tractions along x and along rows, which also move the sheet along the other.
    tolerance, lift : float
        As of `contact_follow`.
    basis : (columns, 2 columns)
    weights, inverse : (1 or 3, rows or more, 2 columns)
        As of `contact_follow`; of tractions from x to x, from rows to rows, and between them. The last one is
        odd along both axes.
    contact : (rows, columns)
        0 or 1.
    forms : (count, parts, rows, columns)
        Displacements of the contact, mm.
    strains : (count, parts, rows, columns)
        An initial guess; afterwards those found, or NaN.
    """
    for form, strain in zip(forms, strains, strict=True):
        start = np.where(contact > 0, strain, 0.0)
        solution = _solve(tolerance, lift, basis, weights, inverse, form, contact > 0, start)
        strain[:] = solution.x if solution.converged else np.nan


def _solve(
    tolerance: float,
    lift: float,
    basis: Array,
    weights: Array,
    inverse: Array,
    target: Array,
    contact: NDArray[np.bool_],
    start: Array,
) -> Solution:
    """Return the strain, (parts, H, W), in contact with which the sheet follows a target."""
    displaced, pressed = _convolution(basis, weights), _convolution(basis, inverse)
    return conjugate_gradients(
        lambda strain: displaced(strain) + lift * strain.sum(),
        target,
        Face.of(contact, pressed),
        converged=lambda residual: bool(np.abs(residual).max() <= tolerance),
        steps=MOST_STEPS,
        start=start,
    )


def _convolution(basis: Array, weights: Array) -> Callable[[Array], Array]:
    """Return the convolution of maps, (parts, H, W), with a kernel of some weights."""
    columns = len(basis)

    def convolved(values: Array) -> Doubles:
        row = np.arange(values.shape[1])
        distance = row[:, np.newaxis] - row
        tables = weights[:, np.abs(distance)]
        waves = values @ basis
        along = np.einsum("pilk,plk->pik", tables[: len(values)], waves)
        if len(values) > 1:
            others = np.roll(waves[::-1], columns, axis=-1)  # sines in place of cosines
            along += np.einsum("ilk,il,plk->pik", tables[2], np.where(distance < 0, -1, 1), others)
        return np.asarray(along @ basis.T)

    return convolved
