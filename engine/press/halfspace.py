"""The sensor's silicone as an incompressible elastic half-space, and a rigid surface pressed into it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from mirrorskin.engine.errors import NotConverged

Doubles = NDArray[np.float64]
Real = TypeVar("Real", np.float32, np.float64)
Mask = NDArray[np.bool_]

TOLERANCE = 1e-4
"""Largest error of the gap in contact, as a share of how far the surface reaches above the rest plane."""

_SOFTNESS = 3 / (4 * math.pi)  # 1 / (pi E*) at E = 1: E* = E / (1 - nu^2), nu = 1/2
_ROUNDS = 40  # of changes of the contact
_STEPS = 300  # of conjugate gradients


class HalfSpace:
    """How pressure on a grid pushes in the surface of an incompressible half-space.

    Pressure is told as strain: divided by Young's modulus, so that no modulus is needed. A point load F moves
    the surface by ``3 / (4 pi E) F / r`` (Boussinesq), whose spectrum is ``3 / (2 E q)`` at the wavenumber q.
    Cut off at r = L, beyond which the grid has no points, it is ::

        3 / (2 E q) times the integral of the Bessel function J0 from 0 to q L

    which is finite at q = 0 and lets an FFT on a padded grid do the sum, exact for pressures without
    wavenumbers above the grid's own (Vico, Greengard and Ferrando, J. Comput. Phys. 323, 2016, 191-203).
    Nothing outside the grid presses.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    pixel_size : (float, float)
        Millimetres along x and y.
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
    is found by an active set: on those that are thought to, the pressure is solved for by conjugate
    gradients; then those that pull are let go, and those that overlap are added, until none does either.

    Parameters
    ----------
    space : HalfSpace
    surface : ndarray, (H, W), float64
        Millimetres above the rest plane if the stage were stiff; NaN where there is nothing.
    compliance : float
        Millimetres by which the stage gives way for each mm^2 of load, 1/mm.
    start : Pressed, optional
        A similar case, to begin with.

    Returns
    -------
    Pressed

    Raises
    ------
    mirrorskin.engine.NotConverged
        The contact goes on changing.
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
        raise NotConverged(f"the contact did not come to rest in {_ROUNDS} rounds")

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
    weights = _influence(shape, pixel_size)
    whole = np.zeros(_padded(shape))
    rows, columns = shape
    whole[:rows, :columns] = weights
    whole[-rows + 1 :, :columns] = weights[:0:-1] if rows > 1 else whole[-rows + 1 :, :columns]
    whole[:, -columns + 1 :] = whole[:, columns - 1 : 0 : -1] if columns > 1 else whole[:, -columns + 1 :]
    return np.ascontiguousarray(fft.rfft2(whole).real)
