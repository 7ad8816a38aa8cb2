"""The sensor's silicone as an incompressible elastic half-space, and a rigid surface pressed into it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse, special

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.conjugate_gradients import Face, conjugate_gradients

Singles = NDArray[np.float32]
Reals = NDArray[Any]
Real = TypeVar("Real", np.float32, np.float64)
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]
Spectra = Callable[[tuple[int, int], tuple[float, float], float], tuple[Doubles, ...]]
"""Of a shape, a pixel size and the distance at which the displacement is cut off."""

TOLERANCE = 1e-4
"""Maximum gap in contact, as a share of the surface's maximum height above the rest plane."""

_SOFTNESS = 3 / (4 * math.pi)  # 1 / (pi E*) at E = 1, with E* = E / (1 - nu^2) and nu = 1/2
_MAX_CONTACT_CHANGES = 40  # maximum number of changes of the contact
_MAX_STEPS = 300  # maximum number of conjugate-gradient steps
_ROUGHLY = 0.1  # gap in a contact that may change, as a share of its initial gap
GRADIENT_ERROR = 1e-3
"""Maximum gap of a flat punch that is pressed in by 1."""
_NO_SLOPE = 1e-9  # slope below which its direction is undefined
_FIRM = 0.05  # share of the maximum pressure below which the contact of a cell is neglected in derivatives
_ROUGH_TOLERANCE, _ROUGH_STEPS = 2e-2, 60  # relative residual, and maximum number of steps, for derivatives
_OWN = _SOFTNESS * 4 * math.log(1 + math.sqrt(2))  # displacement of a square of side 1 by unit strain on it
_SIZES = 4  # pixels: granularity of the size of windows
_INVERSE = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
MARGIN = 0.1
"""Margin of the window in which a contact is searched, as a share of the initial contact's length."""

_COARSEST = 16  # pixels: minimum side of a surface of half the resolution


def transform(values: Reals, padded: tuple[int, int]) -> Reals:
    """Return the transforms of maps, (..., H, W), on a padded grid, in OpenCV's packed format."""
    waves = np.zeros((*values.shape[:-2], *padded), values.dtype)
    waves[..., : values.shape[-2], : values.shape[-1]] = values
    for wave in waves.reshape(-1, *padded):
        cv2.dft(wave, dst=wave)
    return waves


def inverse_transform(waves: Reals, shape: tuple[int, ...]) -> Reals:
    """Return the maps, (..., H, W), of a shape, from their transforms, which are overwritten."""
    for wave in waves.reshape(-1, *waves.shape[-2:]):
        cv2.dft(wave, dst=wave, flags=_INVERSE)
    return waves[..., : shape[0], : shape[1]]


def packed(spectrum: Doubles, columns: int) -> Doubles:
    """Return a real spectrum, (H, columns // 2 + 1), as factors of the numbers of a packed transform.

    A packed transform has real and imaginary parts next to each other, along rows; those of the first column,
    and of the last if ``columns`` is even, are along this column. Numbers without imaginary part have none.
    """
    factors = spectrum.repeat(2, axis=1)[:, 1 : columns + 1]
    for column in (0, -1) if columns % 2 == 0 else (0,):
        factors[:, column] = factors[:, column].repeat(2)[1 : len(factors) + 1]
    return factors


class HalfSpace:
    """The displacement of the surface of an incompressible half-space under pressure on a grid.

    Pressure is divided by Young's modulus (strain), so that no modulus is needed. A point load F displaces
    the surface by ``3 / (4 pi E) F / r`` (Boussinesq), with the spectrum ``3 / (2 E q)`` at the wavenumber q.
    Cut off at r = L, the largest distance on the grid, the spectrum is ::

        3 / (2 E q) times the integral of the Bessel function J0 from 0 to q L

    It is finite at q = 0, and an FFT on a padded grid computes the convolution exactly for pressures without
    wavenumbers above the grid's own (Vico, Greengard and Ferrando, J. Comput. Phys. 323, 2016, 191-203).
    The pressure outside the grid is 0.

    ``shape`` is rows and columns; ``pixel_size`` is along x and y, mm. A part of a larger grid, ``whole``,
    has that grid's weights, so that each of its sizes costs one transform and not many Bessel functions.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        pixel_size: tuple[float, float],
        whole: tuple[int, int] | None = None,
    ) -> None:
        self.shape, self.pixel_size, self._padded = shape, pixel_size, padded_shape(shape)
        self._whole = whole or shape

    def part(self, shape: tuple[int, int]) -> HalfSpace:
        """Return the half-space of a part of the grid."""
        return HalfSpace(shape, self.pixel_size, self._whole)

    @property
    def pixel_area(self) -> float:
        """Area of a pixel, mm^2."""
        return self.pixel_size[0] * self.pixel_size[1]

    def displacement(self, strain: NDArray[Real]) -> NDArray[Real]:
        """Return the displacement by pressures over Young's modulus, (..., H, W) mm, positive inwards."""
        wave = transform(strain, self._padded)
        wave *= _spectrum(self.shape, self._whole, self.pixel_size, wave.dtype)
        return inverse_transform(wave, self.shape)

    def pressed(self, moved: NDArray[Real]) -> NDArray[Real]:
        """Return approximately the strain of displacements, (..., H, W), as if the grid were periodic."""
        wave = transform(moved, self.shape)
        wave *= _inverse_spectrum(self.shape, self.pixel_size, wave.dtype)
        return inverse_transform(wave, self.shape)

    @property
    def own_displacement(self) -> float:
        """Displacement of a pixel, as if it were square, by unit strain on it, mm."""
        return _OWN * math.sqrt(self.pixel_area)

    def influence(self) -> Doubles:
        """Return the displacement of the pixels below and to the right by unit strain on one, (H, W), mm."""
        return influences(point_spectrum, self._whole, self.pixel_size)[0][: self.shape[0], : self.shape[1]]


@dataclass(frozen=True, slots=True, eq=False)
class Pressed:
    """A rigid surface and the half-space in equilibrium; maps are (H, W)."""

    strain: Reals  # pressure over Young's modulus, 0 or more
    contact: Mask
    load: float  # force over Young's modulus, mm^2
    gap: Reals  # gap in contact that the search left, mm; 0 elsewhere

    def more(self, gradient: Reals) -> float:
        """Return what a sum of pressures lacks because of the gap, given its derivatives by heights."""
        return -float(np.sum(gradient * self.gap))


def press(space: HalfSpace, surface: Reals, compliance: float = 0.0, start: Pressed | None = None) -> Pressed:
    """Press a rigid surface into the half-space without friction.

    In contact, the half-space takes the surface's height; elsewhere the pressure is 0. The contact is found
    by an active-set method: conjugate gradients solve for the pressure in the current contact; then pixels
    with negative pressure are removed and overlapping ones are added, until the contact does not change. This
    is done in a window around the contact, which grows if the surface overlaps with the sheet outside. The
    initial guess is the contact of a surface of half the resolution.

    ``surface``, (H, W), is mm above the rest plane for a stiff stage, NaN where there is none; its type is
    that of the computation. The stage deflects by ``compliance``, 1/mm, for each mm^2 of load. ``start`` is a
    similar press, as an initial guess. NotConverged if the contact does not converge.
    """
    surface = np.where(np.isfinite(surface), surface, surface.dtype.type(-np.inf))
    reach, nothing = surface > 0, np.zeros(space.shape, surface.dtype)
    if not reach.any():
        return Pressed(nothing, reach, 0.0, nothing)
    tolerance = TOLERANCE * float(surface.max())
    if start is None and min(space.shape) >= 2 * _COARSEST:
        start = _coarse_press(space, surface, compliance)
    contact, strain = reach, nothing
    if start is not None and (reach & start.contact).any():
        contact, strain = reach & start.contact, start.strain
    while True:
        window, part = window_of(space, contact, MARGIN)
        pressure, touching, remaining = _press_within(
            part, surface[window], compliance, tolerance, strain[window], contact[window]
        )
        strain, contact, left = nothing.copy(), np.zeros_like(reach), nothing.copy()
        strain[window], contact[window], left[window] = pressure, touching, remaining
        outside = overlap_outside(space, surface, compliance, tolerance, strain, window)
        if not outside.any():
            load = float(pressure.sum(dtype=np.float64)) * space.pixel_area
            return Pressed(strain, contact, load, left)
        contact |= outside


def overlap_outside(
    space: HalfSpace, surface: Reals, compliance: float, tolerance: float, strain: Reals, window: Window
) -> Mask:
    """Return where a surface overlaps with the sheet outside of a window, (H, W)."""
    outside = surface > 0
    outside[window] = False
    if outside.any():
        reached, part = window_of(space, surface > 0)
        gap = _opening(part, compliance)(strain[reached]) - surface[reached]
        outside[reached] &= gap < -tolerance
    return outside


def _press_within(
    space: HalfSpace, surface: Reals, compliance: float, tolerance: float, strain: Reals, contact: Mask
) -> tuple[Reals, Mask, Reals]:
    """Return the strain, the contact, and the gap in it, from initial ones; the first solution is rough."""
    moved: Reals | None = None
    for _ in range(_MAX_CONTACT_CHANGES):
        if moved is not None and strain[~contact].any():
            moved = None
        strain = np.where(contact, strain, strain.dtype.type(0))
        strain, moved, error = _solve(space, surface, compliance, tolerance, contact, strain, moved)
        gap = moved - surface
        changed = np.where(contact, strain > 0, gap < -tolerance)
        if error <= tolerance and np.array_equal(changed, contact):
            return strain, contact, np.where(contact, gap, gap.dtype.type(0))
        contact = changed
    raise NotConverged(f"the contact did not converge in {_MAX_CONTACT_CHANGES} rounds")


def _coarse_press(space: HalfSpace, surface: Reals, compliance: float) -> Pressed | None:
    """Return the strain and the contact of a surface of half the resolution, if it touches."""
    rows, columns = (size // 2 for size in space.shape)
    blocks = surface[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
    size = 2 * space.pixel_size[0], 2 * space.pixel_size[1]
    coarse = press(HalfSpace((rows, columns), size), blocks.mean(axis=(1, 3)), compliance)
    odd = [(0, whole - 2 * half) for whole, half in zip(space.shape, (rows, columns), strict=True)]
    strain, contact = (
        np.pad(values.repeat(2, axis=0).repeat(2, axis=1), odd) for values in (coarse.strain, coarse.contact)
    )
    return Pressed(strain, contact, coarse.load, strain)


def load_gradient(space: HalfSpace, contact: Mask, compliance: float = 0.0) -> Doubles:
    """Return the derivatives of the load with respect to the surface's heights in contact, (H, W), mm.

    They equal the pixel area times the strain under a flat punch of the contact's shape, indented by 1: the
    operator is symmetric, and the pressure at the border of a contact is 0, so its motion adds nothing.
    """
    if not contact.any():
        return np.zeros(space.shape)
    gradient: Doubles = punches(space, contact, np.ones((1, *space.shape)), compliance)[0] * space.pixel_area
    return gradient


def punches(
    space: HalfSpace, contact: Mask, forms: Reals, compliance: float = 0.0, start: Reals | None = None
) -> Reals:
    """Return the strains under punches of the contact's shape and given forms, (n, H, W), mm, about 1."""
    window, part = window_of(space, contact)
    inner, touching = (slice(None), *window), contact[window]
    strains = np.zeros_like(forms)
    solution = conjugate_gradients(
        _opening(part, compliance),
        forms[inner],
        Face.of(touching, part.pressed),
        converged=lambda residual: float(np.abs(residual).max()) <= GRADIENT_ERROR,
        steps=_MAX_STEPS,
        start=None if start is None else np.where(touching, start[inner], start.dtype.type(0)),
        axes=(1, 2),
    )
    if not solution.converged:
        raise NotConverged(f"the pressure of a punch was not found in {_MAX_STEPS} steps")
    strains[inner] = solution.x
    return strains


def _solve(
    space: HalfSpace,
    surface: Reals,
    compliance: float,
    tolerance: float,
    contact: Mask,
    strain: Reals,
    moved: Reals | None,
) -> tuple[Reals, Reals, float]:
    """Return the strain for which the sheet follows the surface in contact, the sheet, and the largest gap.

    The largest gap is at most a tolerance, or a tenth of that of the initial strain, if it is larger.
    """
    errors: list[float] = []

    def converged(residual: Reals) -> bool:
        errors.append(float(np.abs(residual).max()))
        return errors[-1] <= max(tolerance, _ROUGHLY * errors[0])

    solution = conjugate_gradients(
        _opening(space, compliance),
        surface,
        Face.of(contact, space.pressed),
        converged=converged,
        steps=_MAX_STEPS,
        start=strain,
        moved=moved,
    )
    if not solution.converged:
        raise NotConverged(f"the pressure in contact was not found in {_MAX_STEPS} steps")
    return solution.x, solution.product, errors[-1]


def _opening(space: HalfSpace, compliance: float) -> Callable[[NDArray[Real]], NDArray[Real]]:
    """Return the function from strains, (..., H, W), to displacements of the sheet against the stage, mm."""
    lift = compliance * space.pixel_area

    def opened(strain: NDArray[Real]) -> NDArray[Real]:
        moved = space.displacement(strain)
        if lift:
            moved += strain.dtype.type(lift) * strain.sum(axis=(-2, -1), keepdims=True)
        return moved

    return opened


def padded_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the size of the padded grid, on which a convolution does not wrap around."""
    rows, columns = (2 * fft.next_fast_len(size, real=True) for size in shape)
    return rows, columns


@lru_cache(maxsize=128)
def influences(spectra: Spectra, shape: tuple[int, ...], pixel_size: tuple[float, float]) -> list[Doubles]:
    """Return weights of convolutions: the inverse transforms of cut-off spectra, on a larger grid."""
    rows, columns = shape
    reach = reach_of(shape, pixel_size)
    padded = (
        fft.next_fast_len(rows + math.ceil(reach / pixel_size[1])),
        fft.next_fast_len(columns + math.ceil(reach / pixel_size[0]), real=True),
    )
    return [
        np.ascontiguousarray(fft.irfft2(part, padded)[:rows, :columns])
        for part in spectra(padded, pixel_size, reach)
    ]


def reach_of(shape: tuple[int, ...], pixel_size: tuple[float, float]) -> float:
    """Return the largest distance on a grid, mm."""
    return math.hypot(shape[0] * pixel_size[1], shape[1] * pixel_size[0])


@lru_cache(maxsize=128)
def point_spectrum(
    shape: tuple[int, int], pixel_size: tuple[float, float], reach: float
) -> tuple[Doubles, ...]:
    """Return the one spectrum of a point's displacement, cut off at a reach, at a grid's wavenumbers; mm."""
    q_y = 2 * math.pi * fft.fftfreq(shape[0], pixel_size[1])
    q_x = 2 * math.pi * fft.rfftfreq(shape[1], pixel_size[0])
    q = np.hypot(q_y[:, np.newaxis], q_x[np.newaxis])
    q[0, 0] = 1.0
    spectrum = special.itj0y0(q * reach)[0] / q
    spectrum[0, 0] = reach
    return (2 * math.pi * _SOFTNESS * spectrum,)


@lru_cache(maxsize=128)
def _spectrum(
    shape: tuple[int, int], whole: tuple[int, int], pixel_size: tuple[float, float], dtype: np.dtype[Any]
) -> Reals:
    """Return the transform of a whole grid's weights on a part, padded: real, because they are even."""
    weights = influences(point_spectrum, whole, pixel_size)[0]
    return spectrum_of(weights[: shape[0], : shape[1]]).astype(dtype)


@lru_cache(maxsize=128)
def _inverse_spectrum(shape: tuple[int, int], pixel_size: tuple[float, float], dtype: np.dtype[Any]) -> Reals:
    """Return the inverse of the spectrum of a point's displacement on a periodic grid, 1/mm."""
    spectrum = 1 / point_spectrum(shape, pixel_size, reach_of(shape, pixel_size))[0]
    return packed(spectrum, shape[1]).astype(dtype)


def spectrum_of(weights: Doubles, sign: float = 1.0) -> Doubles:
    """Return the packed transform of weights (H, W) on the padded grid, even, or odd along both axes."""
    rows, columns = weights.shape
    whole = np.zeros(padded_shape((rows, columns)))
    whole[:rows, :columns] = weights
    if rows > 1:
        whole[-rows + 1 :, :columns] = sign * weights[:0:-1]
    if columns > 1:
        whole[:, -columns + 1 :] = sign * whole[:, columns - 1 : 0 : -1]
    return packed(fft.rfft2(whole).real, whole.shape[1])


class Targets(NamedTuple):
    """Cells whose onsets are to be explained, (H, W)."""

    onset: Doubles  # travel at which a cell turned light, mm; NaN if it did not
    dark: Mask  # cells that never turned light
    slope: Doubles  # slope of the sheet at which a cell turns light


class SlopeFit(NamedTuple):
    """Threshold slopes of n cells less the sheet's slopes at their onsets, for m spline coefficients."""

    residual: Doubles  # (n,)
    jacobian: Doubles  # (n, m): derivatives of the sheet's slope by the coefficients, 1/mm
    by_travel: Doubles  # (n,): derivatives by the travel, 1/mm
    load: Doubles  # (n,): force over Young's modulus, mm^2; compliance lowers the slope by load * by_travel
    cell: NDArray[np.intp]  # (n,): flat index of the cell
    contact: Mask  # (H, W): contact at the greatest travel


def sweep(
    space: HalfSpace,
    surface: Doubles,
    basis: sparse.csr_matrix,
    travel: Doubles,
    targets: Targets,
    compliance: float,
) -> SlopeFit:
    """Press a spline surface, (H, W), and compare the sheet's slopes with those at which cells turn light.

    ``basis``, (H W, m), are the splines. Travels increase, from at most the first onset to the deepest;
    slopes are interpolated linearly between them. A cell that never turned light is compared at the greatest
    travel, if it would be light there.
    """
    state: Pressed | None = None
    before: tuple[float, Doubles] | None = None
    parts: list[tuple[NDArray[np.generic], ...]] = []
    interval = np.clip(np.searchsorted(travel, targets.onset), 0, len(travel) - 1)
    for number, depth in enumerate(travel):
        state = press(space, surface + depth, compliance, state)
        rise = _gradient(space, space.displacement(state.strain))
        slope = np.hypot(*rise)
        compared = np.isfinite(targets.onset) & (interval == number)
        if number == len(travel) - 1:
            compared |= targets.dark & (slope > targets.slope)
        firm = state.strain > _FIRM * float(state.strain.max())
        if firm.any() and compared.any():
            weights = _weights(space, firm, rise, compared, compliance)
            last, steep = before or (float(depth) - 1.0, slope - np.inf)
            early = np.where(np.isfinite(targets.onset), depth - targets.onset, 0.0)[compared]
            rate = weights.sum(axis=1)
            backwards = (slope - steep)[compared] / (depth - last)
            at = slope[compared] - np.where(np.isfinite(backwards), backwards, rate) * early
            load = np.full(at.shape, state.load)
            jacobian = np.asarray((basis[firm.ravel()].T @ weights.T).T)
            parts.append((targets.slope[compared] - at, jacobian, rate, load, np.flatnonzero(compared)))
        before = float(depth), slope
    assert state is not None
    if not parts:
        none = np.zeros(0)
        no_cells = none, np.zeros((0, basis.shape[1])), none, none, np.zeros(0, np.intp)
        return SlopeFit(*no_cells, state.contact)
    residual, jacobian, rate, load, cell = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SlopeFit(residual, jacobian, rate, load, cell, state.contact)


def _gradient(space: HalfSpace, height: Doubles) -> tuple[Doubles, Doubles]:
    """Return the slopes along rows (down the picture) and along columns."""
    across, down = space.pixel_size
    return np.gradient(height, down, axis=0), np.gradient(height, across, axis=1)


def _weights(
    space: HalfSpace, contact: Mask, rise: tuple[Doubles, Doubles], compared: Mask, compliance: float
) -> Doubles:
    """Return the derivatives of some cells' slopes by the heights of those in contact, (n, touching), 1/mm.

    The heights in contact determine the pressure, and the pressure the slopes.
    """
    rows, columns = space.shape
    touching, cells = np.argwhere(contact), np.argwhere(compared)
    influence = space.influence()
    whole = np.block([[influence[:0:-1, :0:-1], influence[:0:-1]], [influence[:, :0:-1], influence]])
    down, across = _gradient(space, whole)
    shift = cells[:, np.newaxis] - touching[np.newaxis] + (rows - 1, columns - 1)
    along = [part[compared] for part in rise]
    steep = np.maximum(np.hypot(*along), _NO_SLOPE)
    slopes = (
        (along[0] / steep)[:, np.newaxis] * down[shift[..., 0], shift[..., 1]]
        + (along[1] / steep)[:, np.newaxis] * across[shift[..., 0], shift[..., 1]]
    )  # fmt: skip
    loads = np.zeros((len(cells), *space.shape), np.float32)
    loads[:, contact] = slopes
    return _pressed_by(space, contact, loads, compliance)


def _pressed_by(space: HalfSpace, contact: Mask, heights: Singles, compliance: float) -> Doubles:
    """Return the strains in contact for given heights in contact, (n, H, W): (n, touching).

    All are solved at once by conjugate gradients: for maps of this size, the threads of a factorisation would
    cost more than they save. Two digits are sufficient, because the derivatives only guide the search.
    """
    window, space = window_of(space, contact)
    contact, heights = contact[window], heights[(slice(None), *window)]
    enough = _ROUGH_TOLERANCE**2 * _square(heights)
    solution = conjugate_gradients(
        _opening(space, compliance),
        heights,
        Face.of(contact, space.pressed),
        converged=lambda residual: bool((_square(residual) <= enough).all()),
        steps=_ROUGH_STEPS,
        axes=(1, 2),
    )
    return np.asarray(solution.x[:, contact], np.float64)


def window_of(space: HalfSpace, contact: Mask, margin: float = 0.0) -> tuple[tuple[slice, slice], HalfSpace]:
    """Return the part of the grid that contains the contact, and its half-space.

    The margin on each side is a share of the contact's length.
    """
    window = []
    for axis, size in zip((1, 0), space.shape, strict=True):
        places = np.flatnonzero(contact.any(axis=axis))
        extent = int(places[-1] + 1 - places[0])
        more = math.ceil(margin * extent)
        # Sizes are rounded, so that few spectra are computed.
        length = min(size, -(-(extent + 2 * more) // _SIZES) * _SIZES)
        start = min(max(int(places[0]) - more, 0), size - length)
        window.append(slice(start, start + length))
    shape = window[0].stop - window[0].start, window[1].stop - window[1].start
    return (window[0], window[1]), space.part(shape)


def _square(maps: Singles) -> Singles:
    """Return the sum of the squares of each map, (n,)."""
    return np.asarray(np.sum(maps * maps, axis=(1, 2)))
