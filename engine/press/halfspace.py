"""The sensor's silicone as an incompressible elastic half-space, and a rigid surface pressed into it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse, special

from mirrorskin.engine.errors import NotConverged

Doubles = NDArray[np.float64]
Real = TypeVar("Real", np.float32, np.float64)
Mask = NDArray[np.bool_]

TOLERANCE = 1e-4
"""Largest error of the gap in contact, as a share of how far the surface reaches above the rest plane."""

_SOFTNESS = 3 / (4 * math.pi)  # 1 / (pi E*) at E = 1: E* = E / (1 - nu^2), nu = 1/2
_ROUNDS = 40  # of changes of the contact
_STEPS = 300  # of conjugate gradients
_GRADIENT_ERROR = 1e-3  # of a flat punch pressed in by 1


class HalfSpace:
    """How pressure on a grid pushes in the surface of an incompressible half-space.

    Pressure is divided by Young's modulus (strain), so that no modulus is needed. A point load F moves
    the surface by ``3 / (4 pi E) F / r`` (Boussinesq), whose spectrum is ``3 / (2 E q)`` at the wavenumber q.
    Cut off at r = L, beyond which the grid has no points, it is ::

        3 / (2 E q) times the integral of the Bessel function J0 from 0 to q L

    which is finite at q = 0 and lets an FFT on a padded grid do the sum, exact for pressures without
    wavenumbers above the grid's own (Vico, Greengard and Ferrando, J. Comput. Phys. 323, 2016, 191-203).
    Nothing outside the grid presses.

    Shape is rows and columns, the pixel size mm along x and y.
    """

    def __init__(self, shape: tuple[int, int], pixel_size: tuple[float, float]) -> None:
        self.shape = shape
        self.pixel_size = pixel_size
        self._padded = _padded(shape)

    @property
    def pixel_area(self) -> float:
        """Of one pixel, mm^2."""
        return self.pixel_size[0] * self.pixel_size[1]

    def displacement(self, strain: NDArray[Real]) -> NDArray[Real]:
        """Return how far pressures, (..., H, W), over Young's modulus push the surface in, mm."""
        rows, columns = self.shape
        wave = fft.rfft2(strain, self._padded)
        wave *= _spectrum(self.shape, self.pixel_size).astype(wave.real.dtype)
        moved: NDArray[Real] = fft.irfft2(wave, self._padded, overwrite_x=True)[..., :rows, :columns]
        return moved

    def pressed(self, moved: NDArray[Real]) -> NDArray[Real]:
        """Return roughly what strain gives displacements, (..., H, W), as if the grid came round."""
        wave = fft.rfft2(moved)
        wave /= _cut_off(self.shape, self.pixel_size, _reach(self.shape, self.pixel_size)).astype(
            wave.real.dtype
        )
        strain: NDArray[Real] = fft.irfft2(wave, self.shape, overwrite_x=True)
        return strain

    def influence(self) -> Doubles:
        """Return how far unit strain on a pixel pushes in those to its lower right, (H, W), mm."""
        return _influence(self.shape, self.pixel_size)


@dataclass(frozen=True, slots=True, eq=False)
class Pressed:
    """A rigid surface and the half-space at rest.

    Attributes
    ----------
    strain : ndarray, (H, W), float64
        Pressure over Young's modulus, 0 or more.
    height : ndarray, (H, W), float64
        Of the half-space's surface above its rest plane, mm.
    contact : ndarray, (H, W), bool
        Where the two touch.
    load : float
        Force over Young's modulus, mm^2.
    """

    strain: Doubles
    height: Doubles
    contact: Mask
    load: float


def press(
    space: HalfSpace, surface: Doubles, compliance: float = 0.0, start: Pressed | None = None
) -> Pressed:
    """Press a rigid surface into the half-space without friction.

    Where they touch the half-space takes the surface's height; elsewhere nothing presses. Which pixels touch
    is found by an active set: on those of the set the pressure is solved for by conjugate gradients; then
    those that pull are removed, and those that overlap are added, until neither happens.

    The surface, (H, W), is mm above the rest plane if the stage were stiff, NaN where there is nothing; the
    stage gives way by ``compliance`` for each mm^2 of load, 1/mm. A similar case is a ``start``.
    NotConverged if the contact does not converge.
    """
    surface = np.where(np.isfinite(surface), surface, -np.inf)
    reach = surface > 0
    if not reach.any():
        nothing = np.zeros(space.shape)
        return Pressed(nothing, nothing, np.zeros(space.shape, bool), 0.0)
    system = _System(space, surface, compliance, TOLERANCE * float(surface.max()))
    contact, strain = reach, np.zeros(space.shape)
    if start is not None and start.contact.any():
        contact, strain = reach & start.contact, start.strain
    return system.rest(contact if contact.any() else reach, strain)


def load_gradient(space: HalfSpace, contact: Mask, compliance: float = 0.0) -> Doubles:
    """Return the derivatives of the load by the heights of the surface in contact, (H, W), mm.

    They are the strain under a flat punch of the contact's shape that is pressed in by 1, times the pixel
    area: the operator is symmetric, and a contact's border, where nothing presses, adds nothing as it moves.
    """
    if not contact.any():
        return np.zeros(space.shape)
    system = _System(space, np.ones(space.shape), compliance, _GRADIENT_ERROR)
    return system.strain_for(contact) * space.pixel_area


class _System:
    """One surface at one depth."""

    def __init__(self, space: HalfSpace, surface: Doubles, compliance: float, tolerance: float) -> None:
        self._space = space
        self._surface = surface
        self._lift = compliance * space.pixel_area
        self._tolerance = tolerance

    def rest(self, contact: Mask, strain: Doubles) -> Pressed:
        """Change the contact until it holds."""
        for _ in range(_ROUNDS):
            strain, gap = self._solve(contact, np.where(contact, strain, 0.0))
            changed = np.where(contact, strain > 0, gap < -self._tolerance)
            if np.array_equal(changed, contact):
                load = float(strain.sum()) * self._space.pixel_area
                return Pressed(strain, self._space.displacement(strain), contact, load)
            contact = changed
        raise NotConverged(f"the contact did not converge in {_ROUNDS} rounds")

    def strain_for(self, contact: Mask) -> Doubles:
        """Return the strain, of either sign, that brings a given contact to the surface."""
        return self._solve(contact, np.zeros_like(self._surface))[0]

    def _solve(self, contact: Mask, strain: Doubles) -> tuple[Doubles, Doubles]:
        """Return the pressure that brings all that is in contact to the surface, and the gap everywhere."""
        gap = self._opened(strain) - self._surface
        direction, last = np.zeros_like(gap), np.inf
        for _ in range(_STEPS):
            residual = np.where(contact, -gap, 0.0)
            if float(np.abs(residual).max()) <= self._tolerance:
                return strain, gap
            steepest = np.where(contact, self._space.pressed(residual), 0.0)
            square = float(np.sum(residual * steepest))
            direction = steepest + square / last * direction
            opened = self._opened(direction)
            length = square / float(np.sum(direction * opened))
            strain = strain + length * direction
            gap += length * opened
            last = square
        raise NotConverged(f"the pressure in contact was not found in {_STEPS} steps")

    def _opened(self, strain: Doubles) -> Doubles:
        """Return by how much a pressure opens the gap."""
        opened = self._space.displacement(strain)
        if self._lift:
            opened += self._lift * float(strain.sum())
        return opened


def _padded(shape: tuple[int, int]) -> tuple[int, int]:
    rows, columns = shape
    return fft.next_fast_len(2 * rows - 1), fft.next_fast_len(2 * columns - 1, real=True)


@lru_cache(maxsize=128)
def _influence(shape: tuple[int, int], pixel_size: tuple[float, float]) -> Doubles:
    """Return the sum's weights: the inverse transform of the cut-off spectrum, on a grid wide enough."""
    rows, columns = shape
    reach = _reach(shape, pixel_size)
    padded = (
        fft.next_fast_len(rows + math.ceil(reach / pixel_size[1])),
        fft.next_fast_len(columns + math.ceil(reach / pixel_size[0]), real=True),
    )
    weights: Doubles = fft.irfft2(_cut_off(padded, pixel_size, reach), padded)
    return np.ascontiguousarray(weights[:rows, :columns])


def _reach(shape: tuple[int, int], pixel_size: tuple[float, float]) -> float:
    """Return the greatest distance on a grid, mm."""
    return math.hypot(shape[0] * pixel_size[1], shape[1] * pixel_size[0])


@lru_cache(maxsize=128)
def _cut_off(shape: tuple[int, int], pixel_size: tuple[float, float], reach: float) -> Doubles:
    """Return the spectrum of a point's displacement, cut off at a reach, at a grid's wavenumbers; mm."""
    q_y = 2 * math.pi * fft.fftfreq(shape[0], pixel_size[1])
    q_x = 2 * math.pi * fft.rfftfreq(shape[1], pixel_size[0])
    q = np.hypot(q_y[:, np.newaxis], q_x[np.newaxis])
    q[0, 0] = 1.0
    spectrum = special.itj0y0(q * reach)[0] / q
    spectrum[0, 0] = reach
    return np.asarray(2 * math.pi * _SOFTNESS * spectrum)


@lru_cache(maxsize=128)
def _spectrum(shape: tuple[int, int], pixel_size: tuple[float, float]) -> Doubles:
    """Return the transform of the weights on the padded grid; they are even, so it is real."""
    return spectrum_of(_influence(shape, pixel_size))


def spectrum_of(weights: Doubles, sign: float = 1.0) -> Doubles:
    """Return the transform of weights (H, W) on the padded grid; they are even, or odd along both axes."""
    rows, columns = weights.shape
    whole = np.zeros(_padded((rows, columns)))
    whole[:rows, :columns] = weights
    if rows > 1:
        whole[-rows + 1 :, :columns] = sign * weights[:0:-1]
    if columns > 1:
        whole[:, -columns + 1 :] = sign * whole[:, columns - 1 : 0 : -1]
    return np.ascontiguousarray(fft.rfft2(whole).real)


Singles = NDArray[np.float32]

_LEAST = 1e-9  # a slope that has a direction
_FIRM = 0.05  # of the greatest pressure; what presses less may as well not touch
_ROUGH, _ROUGH_STEPS = 2e-2, 60
_SIZES = 4  # cells by which windows grow
_TINY = np.float32(1e-30)


class Targets(NamedTuple):
    """Cells whose onsets are to be explained, (H, W)."""

    onset: Doubles  # travel at which a cell turned light, mm; NaN where it did not
    dark: Mask  # cells that never did
    slope: Doubles  # of the sheet, at which a cell turns light


class SlopeFit(NamedTuple):
    """Slopes that turn n cells light less those of the sheet when they did, for a surface of m splines."""

    residual: Doubles  # (n,)
    jacobian: Doubles  # (n, m): derivatives of the sheet's slope by the splines' factors, 1/mm
    by_travel: Doubles  # (n,): by the travel, 1/mm
    load: Doubles  # (n,): force over Young's modulus, mm^2; compliance lowers the slope by load * by_travel
    cell: NDArray[np.intp]  # (n,): counted row by row
    contact: Mask  # (H, W): at the greatest travel


def sweep(
    space: HalfSpace,
    surface: Doubles,
    basis: sparse.csr_matrix,
    travel: Doubles,
    targets: Targets,
    compliance: float,
) -> SlopeFit:
    """Press a surface, (H, W), made of splines, (H W, m), and compare slopes when cells turned light.

    Travels rise from the first onset, or before it, to the deepest; between two of them slopes are taken for
    linear. A cell that never turned light is compared at the greatest travel, if it is light then.
    """
    state: Pressed | None = None
    before: tuple[float, Doubles] | None = None
    parts: list[tuple[NDArray[np.generic], ...]] = []
    interval = np.clip(np.searchsorted(travel, targets.onset), 0, len(travel) - 1)
    for number, depth in enumerate(travel):
        state = press(space, surface + depth, compliance, state)
        rise = _gradient(space, state.height)
        slope = np.hypot(*rise)
        looked = np.isfinite(targets.onset) & (interval == number)
        if number == len(travel) - 1:
            looked |= targets.dark & (slope > targets.slope)
        firm = state.strain > _FIRM * float(state.strain.max())
        if firm.any() and looked.any():
            weights = _weights(space, firm, rise, looked, compliance)
            last, steep = before or (float(depth) - 1.0, slope - np.inf)
            early = np.where(np.isfinite(targets.onset), depth - targets.onset, 0.0)[looked]
            rate = weights.sum(axis=1)
            backwards = (slope - steep)[looked] / (depth - last)
            at = slope[looked] - np.where(np.isfinite(backwards), backwards, rate) * early
            load = np.full(at.shape, state.load)
            jacobian = np.asarray((basis[firm.ravel()].T @ weights.T).T)
            parts.append((targets.slope[looked] - at, jacobian, rate, load, np.flatnonzero(looked)))
        before = float(depth), slope
    assert state is not None
    if not parts:
        nothing = np.zeros(0)
        return SlopeFit(
            nothing, np.zeros((0, basis.shape[1])), nothing, nothing, np.zeros(0, np.intp), state.contact
        )
    residual, jacobian, rate, load, cell = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SlopeFit(residual, jacobian, rate, load, cell, state.contact)


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
    goal: Singles = _ROUGH**2 * _square(heights, heights)
    last = np.full_like(goal, np.inf)
    for _ in range(_ROUGH_STEPS):
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
        # Of few different sizes, so that the spectra of a size are seldom computed.
        length = min(size, -(-(places[-1] + 1 - places[0]) // _SIZES) * _SIZES)
        start = min(int(places[0]), size - length)
        window.append(slice(start, start + int(length)))
    shape = window[0].stop - window[0].start, window[1].stop - window[1].start
    return (window[0], window[1]), HalfSpace(shape, space.pixel_size)


def _square(a: Singles, b: Singles) -> Singles:
    """Return the sum of products of each map, (n, 1, 1)."""
    return np.asarray(np.sum(a * b, axis=(1, 2), keepdims=True))
