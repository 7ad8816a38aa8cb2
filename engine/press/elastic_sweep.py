"""A press gone through once more with a surface that is being looked for: what it would have shown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mirrorskin.engine.press.halfspace import HalfSpace, Pressed, press

Doubles = NDArray[np.float64]
Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LEAST = 1e-9  # a slope that has a direction
_FIRM = 0.05  # of the greatest pressure; what presses less may as well not touch
_PRECISION, _STEPS = 2e-2, 60
_SIZES = 4  # cells by which windows grow
_TINY = np.float32(1e-30)


class Watched(NamedTuple):
    """Cells that are looked at.

    Attributes
    ----------
    onset : ndarray, (H, W), float64
        Travel at which a cell turned light, mm; NaN where it did not.
    dark : ndarray, (H, W), bool
        Cells that never did.
    slope : ndarray, (H, W), float64
        Of the sheet, at which a cell turns light.
    """

    onset: Doubles
    dark: Mask
    slope: Doubles


class Seen(NamedTuple):
    """How steep the sheet was where and when cells turned light, beside what turns them light.

    Attributes
    ----------
    missing : ndarray, (n,), float64
        Slope that turns the cell light, less the sheet's.
    by_surface : ndarray, (n, m), float64
        Derivatives of the sheet's slope by the factors of the surface, 1/mm.
    by_travel : ndarray, (n,), float64
        By the travel, 1/mm.
    load : ndarray, (n,), float64
        Force over Young's modulus, mm^2: by the compliance the slope falls with load times ``by_travel``.
    cell : ndarray, (n,), int
        Which cell, counted row by row.
    contact : ndarray, (H, W), bool
        What touches at the greatest travel.
    """

    missing: Doubles
    by_surface: Doubles
    by_travel: Doubles
    load: Doubles
    cell: NDArray[np.intp]
    contact: Mask


def sweep(
    space: HalfSpace,
    surface: Doubles,
    basis: sparse.csr_matrix,
    travel: Doubles,
    watched: Watched,
    compliance: float,
) -> Seen:
    """Press a surface, and look at each cell when it turned light in truth.

    Between two travels slopes are taken for linear. A cell that never turned light in truth is looked at at
    the greatest travel, if it is light then.

    Parameters
    ----------
    space : HalfSpace
    surface : ndarray, (H, W), float64
        Heights of the object, mm; NaN where there is none.
    basis : csr_matrix, (H W, m), float64
        What the surface is made of.
    travel : ndarray, (T,), float64
        Rising, from the first onset, or before it, to the deepest.
    watched : Watched
    compliance : float
        1/mm.
    """
    state: Pressed | None = None
    before: tuple[float, Doubles] | None = None
    parts: list[tuple[NDArray[np.generic], ...]] = []
    interval = np.clip(np.searchsorted(travel, watched.onset), 0, len(travel) - 1)
    for number, depth in enumerate(travel):
        state = press(space, surface + depth, compliance, state)
        rise = _gradient(space, state.height)
        slope = np.hypot(*rise)
        looked = np.isfinite(watched.onset) & (interval == number)
        if number == len(travel) - 1:
            looked |= watched.dark & (slope > watched.slope)
        firm = state.strain > _FIRM * float(state.strain.max())
        if firm.any() and looked.any():
            weights = _weights(space, firm, rise, looked, compliance)
            last, steep = before or (float(depth) - 1.0, slope - np.inf)
            early = np.where(np.isfinite(watched.onset), depth - watched.onset, 0.0)[looked]
            rate = weights.sum(axis=1)
            backwards = (slope - steep)[looked] / (depth - last)
            at = slope[looked] - np.where(np.isfinite(backwards), backwards, rate) * early
            load = np.full(at.shape, state.load)
            by_surface = np.asarray((basis[firm.ravel()].T @ weights.T).T)
            parts.append((watched.slope[looked] - at, by_surface, rate, load, np.flatnonzero(looked)))
        before = float(depth), slope
    assert state is not None
    if not parts:
        nothing = np.zeros(0)
        return Seen(
            nothing, np.zeros((0, basis.shape[1])), nothing, nothing, np.zeros(0, np.intp), state.contact
        )
    missing, by_surface, rate, load, cell = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Seen(missing, by_surface, rate, load, cell, state.contact)


def _gradient(space: HalfSpace, height: Doubles) -> tuple[Doubles, Doubles]:
    """Return the slopes along rows (down the picture) and along columns."""
    across, down = space.pixel_size
    return np.gradient(height, down, axis=0), np.gradient(height, across, axis=1)


def _weights(
    space: HalfSpace, contact: Mask, rise: tuple[Doubles, Doubles], looked: Mask, compliance: float
) -> Doubles:
    """Return the derivatives of some cells' slopes by the heights of those in contact, (n, touching), 1/mm.

    The sheet lies on those in contact: their pressure follows from their heights, and the slope from it.
    """
    rows, columns = space.shape
    touching, cells = np.argwhere(contact), np.argwhere(looked)
    influence = space.influence()
    whole = np.block([[influence[:0:-1, :0:-1], influence[:0:-1]], [influence[:, :0:-1], influence]])
    down, across = _gradient(space, whole)
    way = cells[:, np.newaxis] - touching[np.newaxis] + (rows - 1, columns - 1)
    along = [part[looked] for part in rise]
    steep = np.maximum(np.hypot(*along), _LEAST)
    slopes = (
        (along[0] / steep)[:, np.newaxis] * down[way[..., 0], way[..., 1]]
        + (along[1] / steep)[:, np.newaxis] * across[way[..., 0], way[..., 1]]
    )  # fmt: skip
    loads = np.zeros((len(cells), *space.shape), np.float32)
    loads[:, contact] = slopes
    return _pressed_by(space, contact, loads, compliance)


def _pressed_by(space: HalfSpace, contact: Mask, heights: Singles, compliance: float) -> Doubles:
    """Return which strains give heights, (n, H, W), where there is contact: (n, touching).

    All at once by conjugate gradients: the maps are too small for factors of matrices to be worth their
    while, whose threads wait for each other. They only steer the search, so two digits will do.
    """
    window, space = _window(space, contact)
    contact, heights = contact[window], heights[(slice(None), *window)]
    lift = np.float32(compliance * space.pixel_area)
    strain: Singles = np.zeros_like(heights)
    direction: Singles = np.zeros_like(heights)
    residual: Singles = heights
    goal: Singles = _PRECISION**2 * _square(heights, heights)
    last = np.full_like(goal, np.inf)
    for _ in range(_STEPS):
        steepest: Singles = space.pressed(residual) * contact
        square = _square(residual, steepest)
        direction = np.add(steepest, square / last * direction, dtype=np.float32)
        moved = space.displacement(direction)
        if lift:
            moved = moved + lift * direction.sum(axis=(1, 2), keepdims=True)
        moved = np.multiply(moved, contact, dtype=np.float32)
        length = np.divide(square, np.maximum(_square(direction, moved), _TINY), dtype=np.float32)
        strain = np.add(strain, length * direction, dtype=np.float32)
        residual = np.subtract(residual, length * moved, dtype=np.float32)
        if (_square(residual, residual) <= goal).all():
            break
        last = np.maximum(square, _TINY)
    return np.asarray(strain[:, contact], np.float64)


def _window(space: HalfSpace, contact: Mask) -> tuple[tuple[slice, slice], HalfSpace]:
    """Return the part of the grid that holds what touches, and the half-space below it."""
    window = []
    for axis, size in zip((1, 0), space.shape, strict=True):
        places = np.flatnonzero(contact.any(axis=axis))
        # Of few different sizes, so that what belongs to a size is worked out seldom.
        length = min(size, -(-(places[-1] + 1 - places[0]) // _SIZES) * _SIZES)
        start = min(int(places[0]), size - length)
        window.append(slice(start, start + int(length)))
    shape = window[0].stop - window[0].start, window[1].stop - window[1].start
    return (window[0], window[1]), HalfSpace(shape, space.pixel_size)


def _square(a: Singles, b: Singles) -> Singles:
    """Return the sum of products of each map, (n, 1, 1)."""
    return np.asarray(np.sum(a * b, axis=(1, 2), keepdims=True))
