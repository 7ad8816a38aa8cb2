"""Traction and force along the sheet, in newtons, from how far the skin is displaced."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage, special
from scipy.optimize import brentq

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.halfspace import (
    influences,
    inverse_transform,
    packed,
    padded_shape,
    reach_of,
    spectrum_of,
    transform,
)
from mirrorskin.engine.force.normal import modulus_of
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import as_array_or_number, check_count, check_number, checked, in_unit
from mirrorskin.io.base.findings import carried
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.conjugate_gradients import Face, conjugate_gradients

Mask = NDArray[np.bool_]
Singles = NDArray[np.float32]

_SOFTNESS = 3 / (4 * math.pi)  # 1 / (4 pi G) at E = 1: G = E / 3
UP = np.array([1.0, -1.0]).reshape(2, 1, 1)  # y points up, rows increase downwards
_TOLERANCE, _ROUGH = 1e-4, 1e-3  # residual relative to the largest displacement; with damping, the second
_MAX_STEPS = 400  # maximum number of conjugate gradient steps
_MAX_DISPLACEMENT = 1e6  # maximum displacement, mm
MIN_COVERAGE = 0.8  # minimum share of the contact with a displacement
_DAMPING = 1e-4, 1e4  # range of the damping, relative to the compliance of the contact as a whole


@checked(
    pixel_size=in_unit("mm"),
    modulus=in_unit("MPa", check_number),
    contact=as_array_or_number,
    normal_pressure=in_unit("MPa"),
    sigma=in_unit("mm"),
    window_size=check_count,
    modulus_sigma=in_unit("MPa", check_number),
)
def find_tangential_force(
    displacement: Maps,
    pixel_size: ArrayLike | None = None,
    modulus: float | None = None,
    *,
    contact: ArrayLike | None = None,
    normal_pressure: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
    window_size: int = 1,
    modulus_sigma: float = 0.0,
) -> Result:
    """Find the traction that displaces the skin along the sheet, and the force.

    The elastomer is an incompressible half-space, in which pressure displaces nothing along the surface. A
    force Q along x displaces it by 3 / (4 pi E) times Q (1 / r + x^2 / r^3) along x and Q x y / r^3 along y
    (Cerruti; Johnson, Contact Mechanics, 1985, 3.6). This is inverted within the contact; outside, the
    traction is 0. No law of friction is needed: the skin may stick or slip.

    The operator is symmetric, so the force is a sum of the displacements, weighted by the traction that
    displaces the whole contact by 1; the error of the force is propagated from their errors. Tractions
    amplify noise of short wavelengths, so they are damped such that the misfit of the displacements equals
    their standard deviation (Morozov's discrepancy principle).

    Parameters
    ----------
    displacement : Result, mapping, xarray.Dataset, path or array_like, (H, W, 2)
        Displacement of the skin against the body, mm, x to the right and y up, and its standard deviation, if
        available; of several frames, (T, H, W, 2), the last is used. An array is the displacement.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the result.
    modulus : float, optional
        Young's modulus, MPa; by default that of the result's calibration.
    contact : array_like, (H, W), optional
        Nonzero where the object touches; by default where the pressure is above 0, or the contact or pressure
        of the result. If it is too large, noise increases; if it is too small, force is lost.
    normal_pressure : array_like, (H, W), optional
        Pressure, as in the ``pressure`` of a result; required without a contact.
    sigma : array_like, scalar, (H, W) or (H, W, 2), optional
        Standard deviation of each component of the displacement, mm; NaN is replaced by the value of the
        nearest pixel. By default ``displacement_sigma`` of the result, or 0.
    window_size : int
        Side of the windows in which displacements were estimated, pixels; errors are correlated within it.
    modulus_sigma : float
        Standard deviation of the modulus, MPa; by default that of the calibration if the modulus is.

    Returns
    -------
    Result
        ``traction``, (H, W, 2), MPa along x and y that the object exerts on the sensor, 0 outside the
        contact; ``force_x`` and ``force_y``, N, with their standard deviations.

    Raises
    ------
    mirrorskin.io.InputError
        There is no contact, a shape or number is not possible, or less than 80 % of the contact has a
        displacement.
    mirrorskin.engine.NotConverged
        The traction was not found in the allowed number of steps.

    Examples
    --------
    A sticking disc of 2 mm, displaced by 0.1 mm: Mindlin's formula, 16/3 G a times that, gives 0.0178 N.

    >>> import numpy as np
    >>> x = np.linspace(-1.5, 1.5, 61)
    >>> disc = np.hypot(x, x[:, np.newaxis]) <= 1
    >>> moved = np.broadcast_to([0.1, 0.0], (61, 61, 2))
    >>> round(find_tangential_force(moved, 0.05, modulus=0.1, contact=disc).force_x, 3)
    0.018
    """
    result = as_result(displacement, "displacement", quantity="displacement")
    target, spread, touches, place = _checked(result, sigma, contact, normal_pressure, window_size)
    size = pixel_size_of(result, "displacement", pixel_size)
    young, young_sigma = modulus_of(result, modulus, modulus_sigma)
    x, y = pixel_axes((touches.shape[0], touches.shape[1]), size)
    traction = np.zeros((*touches.shape, 2), np.float32)
    touches = touches[place]
    system = ContactShear(touches, size)
    weights = system.weights() * size[0] * size[1]
    force = young * np.sum(weights * target, axis=(1, 2, 3)) * UP.ravel()
    window = (0, 0, window_size, window_size)
    shared = ndimage.uniform_filter(weights * spread, window, mode="constant") * window_size
    from_measurement = young * np.sqrt(np.sum(shared**2, axis=(1, 2, 3)))
    strain = system.damped(target, spread)
    traction[place] = np.moveaxis(young * strain * UP, 0, -1)
    force_sigma = np.hypot(from_measurement, young_sigma / young * force)
    return Result(
        traction=traction,
        force_x=float(force[0]),
        force_x_sigma=float(force_sigma[0]),
        force_y=float(force[1]),
        force_y_sigma=float(force_sigma[1]),
        x=x,
        y=y,
        process={"modulus": float(young), **carried({}, displacement=result.process)},
    )


def _checked(
    result: Result,
    sigma: ArrayLike | None,
    contact: ArrayLike | None,
    pressure: ArrayLike | None,
    window_size: int,
) -> tuple[Doubles, Doubles, Mask, tuple[slice, slice]]:
    """Return displacements in contact along x and rows, standard deviations, the contact, and its place.

    The first two, (2, H, W), are of the smallest part of the map that contains the contact, without gaps.
    """
    moved, spread = last_displacement(result, sigma)
    if contact is None and pressure is None:
        contact, pressure = result.contact, result.pressure
    touches = _touches(contact, pressure, moved.shape[:2])
    if window_size < 1:
        raise InputError(f"window_size {window_size} is not possible: give pixels, 1 or more")
    rows, columns = (slice(int(part.min()), int(part.max()) + 1) for part in np.nonzero(touches))
    inside = touches[rows, columns]
    moved, spread = (np.asarray(part[rows, columns], np.float64) for part in (moved, spread))
    finite = np.isfinite(moved).all(axis=-1)
    if finite.any() and not (farthest := np.abs(moved[finite]).max()) < _MAX_DISPLACEMENT:
        raise InputError(f"a displacement is {farthest:.3g} mm: less than {_MAX_DISPLACEMENT:g} are needed")
    fraction = np.count_nonzero(finite & inside) / np.count_nonzero(inside)
    if not np.isfinite(spread).any() or np.any(spread < 0):
        raise InputError("sigma is below 0, or nowhere known: give millimetres, 0 or more")
    if fraction < MIN_COVERAGE:
        raise InputError(f"{fraction:.0%} of the contact has a displacement: {MIN_COVERAGE:.0%} are needed")
    target, sigmas = (
        np.stack([fill_with_nearest(np.where(finite, part, np.nan)) for part in np.moveaxis(values, -1, 0)])
        for values in (moved, spread)
    )
    return np.where(inside, target * UP, 0.0), sigmas, touches, (rows, columns)


def last_displacement(result: Result, sigma: ArrayLike | None = None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the last displacement of a result and its standard deviation, (H, W, 2), as given or its own."""
    if result.displacement is None:
        raise InputError("displacement has no map of that name: give the result of a slide, or an array")
    moved = np.asarray(result.displacement)
    moved = moved[-1] if moved.ndim == 4 and len(moved) else moved
    if moved.ndim != 3 or moved.shape[2] != 2 or 0 in moved.shape:
        raise InputError(f"displacements have shape {moved.shape}: one map (H, W, 2) is needed")
    displacement_sigma = 0.0 if result.displacement_sigma is None else result.displacement_sigma
    spread = np.asarray(displacement_sigma if sigma is None else sigma)
    spread = spread[-1] if sigma is None and spread.ndim == 4 else spread
    if spread.shape not in ((), moved.shape[:2], moved.shape):
        raise InputError(f"sigma has shape {spread.shape}: it must be that of the map, {moved.shape[:2]}")
    if spread.shape != moved.shape:
        spread = np.broadcast_to(spread[..., np.newaxis] if spread.ndim == 2 else spread, moved.shape)
    return moved, spread


def _touches(contact: ArrayLike | None, pressure: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """Return where the object touches."""
    if contact is None and pressure is None:
        raise InputError("it is unknown where the object touches: give contact, or normal_pressure")
    touches = np.asarray(contact if contact is not None else np.asarray(pressure, np.float64) > 0) > 0
    if touches.shape != shape:
        raise InputError(f"contact has shape {touches.shape}: it must be that of the map, {shape}")
    if not touches.any():
        raise InputError("nothing touches: there is no traction to find")
    return touches


class ContactShear:
    """The linear map from tractions over Young's modulus to displacements of a contact, along x and rows.

    Maps are (..., 2, H, W), float32. A part of a larger grid, ``whole``, has that grid's weights.
    """

    def __init__(
        self, contact: Mask, pixel_size: tuple[float, float], whole: tuple[int, ...] | None = None
    ) -> None:
        self._contact, self._size, shape = contact, pixel_size, contact.shape
        self._padded = padded_shape(shape)
        self._spectra = _spectra(shape, whole or shape, pixel_size)

    def weights(self, error: float = _TOLERANCE, start: Singles | None = None) -> Singles:
        """Return the tractions that displace the contact by 1 along x, and along rows, (2, 2, H, W)."""
        units = np.eye(2, dtype=np.float32)[:, :, np.newaxis, np.newaxis] * self._contact
        return self._solve(units, error, start=start)

    def _solve(
        self, target: Singles, tolerance: float, damping: float = 0.0, start: Singles | None = None
    ) -> Singles:
        """Return the traction for a displacement of the contact, by preconditioned conjugate gradients."""
        goal, factor = tolerance * float(np.abs(target).max()), np.float32(damping)
        shape, nothing = (self._contact.shape[0], self._contact.shape[1]), np.float32(0)
        inverse = _inverse_spectra(shape, self._size, damping)

        def displaced(strain: Singles) -> Singles:
            moved = _filtered(strain, self._spectra, self._padded)
            return moved + factor * strain if damping else moved

        solution = conjugate_gradients(
            displaced,
            target,
            Face.of(self._contact, lambda residual: _filtered(residual, inverse, shape)),
            converged=lambda residual: float(np.abs(residual).max()) <= goal,
            steps=_MAX_STEPS,
            start=None if start is None else np.where(self._contact, start, nothing),
            axes=(-3, -2, -1),
        )
        if not solution.converged:
            raise NotConverged(f"the traction in contact was not found in {_MAX_STEPS} steps")
        return np.asarray(solution.x)

    def damped(self, displacement: Doubles, sigma: Doubles) -> Singles:
        """Return the damped traction whose misfit equals the standard deviation of the displacements."""
        target = displacement.astype(np.float32)
        noise = float(np.mean(sigma[:, self._contact] ** 2))
        if not noise:
            return self._solve(target, _TOLERANCE)
        softness = _SOFTNESS * math.sqrt(np.count_nonzero(self._contact))
        strain: Singles | None = None

        def excess(power: float) -> float:
            nonlocal strain
            damping = softness * 10**power
            strain = self._solve(target, _ROUGH, damping, strain)
            misfit = damping * strain[:, self._contact]
            return math.log10(float(np.mean(misfit**2)) / noise)

        low, high = (math.log10(end) for end in _DAMPING)
        power, step = 0.0, -1.0 if excess(0.0) > 0 else 1.0
        while (excess(power + step) > 0) == (step < 0):
            power += step
            if power >= high:  # noise explains all displacements
                return np.zeros_like(target)
            if power <= low:
                break
        else:
            power = float(brentq(excess, *sorted((power, power + step)), xtol=0.05))
        return self._solve(target, _ROUGH, softness * 10**power, strain)


def _filtered(values: Singles, spectra: Singles, shape: tuple[int, int]) -> Singles:
    """Return the convolution of vectors, (..., 2, H, W), with a symmetric tensor of spectra xx, yy and xy."""
    wave = transform(values, shape)
    xx, yy, xy = spectra
    x, y = wave[..., 0, :, :], wave[..., 1, :, :]
    across = xy * x
    x *= xx
    x += xy * y
    y *= yy
    y += across
    return inverse_transform(wave, values.shape[-2:])


@lru_cache(maxsize=32)
def _spectra(shape: tuple[int, ...], whole: tuple[int, ...], pixel_size: tuple[float, float]) -> Singles:
    """Return the transforms of a whole grid's weights on a part, padded."""
    weights = [part[: shape[0], : shape[1]] for part in influences(tensor_spectra, whole, pixel_size)]
    spectra = [spectrum_of(part, sign) for part, sign in zip(weights, (1.0, 1.0, -1.0), strict=True)]
    return np.stack(spectra).astype(np.float32)


@lru_cache(maxsize=8)
def _inverse_spectra(shape: tuple[int, ...], pixel_size: tuple[float, float], damping: float) -> Singles:
    """Return the inverse of the spectra, with damping, on a periodic grid, as of `inverse_spectra`."""
    inverse = inverse_spectra(shape, pixel_size, damping)
    return np.stack([packed(part, shape[1]) for part in inverse]).astype(np.float32)


def inverse_spectra(
    shape: tuple[int, ...], pixel_size: tuple[float, float], damping: float = 0.0
) -> tuple[Doubles, Doubles, Doubles]:
    """Return the spectra xx, yy and xy of the inverse of `tensor_spectra`, with damping."""
    along, up, across = tensor_spectra(shape, pixel_size, reach_of(shape, pixel_size))
    along, up = along + damping, up + damping
    determinant = along * up - across**2
    return up / determinant, along / determinant, -across / determinant


@lru_cache(maxsize=32)
def tensor_spectra(
    shape: tuple[int, ...], pixel_size: tuple[float, float], reach: float
) -> tuple[Doubles, Doubles, Doubles]:
    """Return the spectra xx, yy and xy of the displacements by a point force, cut off at a reach, mm.

    At the wavenumber q in the direction phi, they are 3 / (2 E q) times ``3/2 S0 - cos(2 phi) S2 / 2`` for
    xx, the same with plus for yy, and ``- sin(2 phi) S2 / 2`` for xy. S0 and S2 are the integrals of the
    Bessel functions J0 and J2 from 0 to q times the reach, which converge to 1.
    """
    q_y = 2 * math.pi * fft.fftfreq(shape[0], pixel_size[1])[:, np.newaxis]
    q_x = 2 * math.pi * fft.rfftfreq(shape[1], pixel_size[0])[np.newaxis]
    q = np.hypot(q_x, q_y)
    q[0, 0] = 1.0
    even = special.itj0y0(q * reach)[0]
    odd = even - 2 * special.j1(q * reach)
    even, odd = 2 * math.pi * _SOFTNESS * even / q, math.pi * _SOFTNESS * odd / q
    even[0, 0], odd[0, 0] = 2 * math.pi * _SOFTNESS * reach, 0.0
    cosine, sine = (q_x**2 - q_y**2) / q**2, 2 * q_x * q_y / q**2
    return 1.5 * even - odd * cosine, 1.5 * even + odd * cosine, -odd * sine
