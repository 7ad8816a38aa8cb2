"""An elastic half-space, and a rigid object pressed into it without friction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.kernels.numerics.conjugate_gradients import Face, conjugate_gradients

Spectrum = NDArray[np.complex64]

Window = tuple[slice, slice]
"""Rows and columns of a grid."""


class HalfSpace:
    """An incompressible half-space with a uniform load within each pixel of a grid.

    Displacements are sums over loaded pixels in the closed form of Love (1929), from Boussinesq's and
    Cerruti's solutions for a point (Johnson, Contact Mechanics, 1985, sections 3.2, 3.3 and 3.6). At Poisson
    ratio 0.5 pressure displaces the surface only along its normal, and traction only along the surface. The
    sums are convolutions by FFT on a zero-padded grid, so there are neither loads outside the grid nor
    periodic images. Displacements are relative to points far inside the body.

    Lengths are mm, and Young's modulus E N/mm^2; ``depth`` is the depth of the mirror below the surface.
    Loads are maps of the whole grid, or of its part ``loaded``. Displacements are computed in the precision
    of the loads; float32 takes a quarter of the time of float64.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        pixel_size: tuple[float, float],
        modulus: float,
        depth: float = 0.0,
        loaded: Window | None = None,
    ) -> None:
        from scipy import fft

        self.shape = shape
        self.pixel_size = pixel_size
        self.modulus = modulus
        self.depth = depth
        self._loaded = loaded or (slice(0, shape[0]), slice(0, shape[1]))
        # Large enough that no periodic image of a load affects the displacements.
        rows, columns = (
            2 * max(size - part.start, part.stop) - 1 for size, part in zip(shape, self._loaded, strict=True)
        )
        self._padded = (fft.next_fast_len(rows), fft.next_fast_len(columns, real=True))

    @property
    def pixel_area(self) -> float:
        """Area of a pixel, mm^2."""
        return self.pixel_size[0] * self.pixel_size[1]

    @property
    def softness(self) -> float:
        """Displacement times distance of a point force, mm^2/N: 1 / (4 pi G) = 3 / (4 pi E)."""
        return 3 / (4 * math.pi * self.modulus)

    def window(self, rows: int, columns: int, loaded: Window | None = None) -> HalfSpace:
        """Return the same half-space with a grid of another size."""
        return HalfSpace((rows, columns), self.pixel_size, self.modulus, self.depth, loaded)

    def surface(self, pressure: NDArray[Any]) -> Floats:
        """Return the indentation of the surface by a pressure, N/mm^2, at the pixels' centres, (H, W), mm."""
        return self._normal(pressure, 0.0)

    def mirror(self, pressure: Floats) -> Floats:
        """Return the indentation of the layer at `depth` below the surface under a pressure.

        Below a point force P the displacement is P / (4 pi G) (1 / s + z^2 / s^3), with s the distance and z
        the depth (Johnson 1985, eq. 3.19). Integrated over a pixel it is Love's formula for the surface with
        z included in the distances. Its spectrum is the surface's times (1 + q z) exp(-q z), with q the
        wavenumber.
        """
        return self._normal(pressure, self.depth)

    def tangential(self, traction: NDArray[Any]) -> Floats:
        """Return the displacement along the surface under a traction, N/mm^2 along x and y, (2, H, W), mm.

        A point force Q along x displaces by Q / (4 pi G) times 1 / r + x^2 / r^3 along x and x y / r^3 along
        y (Cerruti; Johnson 1985, eq. 3.75 at Poisson ratio 0.5).
        """
        xx, xy, yy = _tangential_spectra(self._padded, self.pixel_size, traction.dtype)
        along_x, along_y = self._spectrum(traction[0]), self._spectrum(traction[1])
        return np.stack([self._field(xx * along_x + xy * along_y), self._field(xy * along_x + yy * along_y)])

    def _normal(self, pressure: NDArray[Any], depth: float) -> Floats:
        spectrum = self._spectrum(pressure)
        spectrum *= _normal_spectrum(self._padded, self.pixel_size, depth, pressure.dtype)
        return self._field(spectrum)

    def _spectrum(self, values: NDArray[Any]) -> NDArray[Any]:
        from scipy import fft

        # One axis at a time, because rows of zeros need no transform.
        (rows, columns), (across, along) = self._padded, self._loaded
        placed = np.zeros((len(values), columns), values.dtype)
        placed[:, along] = values
        spectrum = np.zeros((rows, columns // 2 + 1), np.result_type(values.dtype, np.complex64))
        spectrum[across] = fft.rfft(placed, axis=1)
        return np.asarray(fft.fft(spectrum, axis=0, overwrite_x=True))

    def _field(self, spectrum: NDArray[Any]) -> Floats:
        from scipy import fft

        rows, columns = self.shape
        half = fft.ifft(spectrum, axis=0, overwrite_x=True)[:rows]
        field: Floats = fft.irfft(half, self._padded[1], axis=1)[:, :columns]
        field *= self.softness
        return field


def rectangle(mask: NDArray[np.bool_]) -> Window:
    """Return the rows and columns of the smallest rectangle around all True pixels; there must be one."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


# For surface, mirror and the growing rectangle in contact; a spectrum has the size of two maps.
@lru_cache(maxsize=6)
def _normal_spectrum(
    padded: tuple[int, int], pixel_size: tuple[float, float], depth: float, dtype: np.dtype[Any]
) -> Floats:
    """Return the transform of the integral of 1 / s + z^2 / s^3 over a pixel; it is even, hence real."""
    x, y = _corners(padded, pixel_size)
    return _transform(_x_log(x, y, depth) + _x_log(y, x, depth)).astype(dtype)


@lru_cache(maxsize=3)
def _tangential_spectra(
    padded: tuple[int, int], pixel_size: tuple[float, float], dtype: np.dtype[Any]
) -> tuple[Floats, Floats, Floats]:
    """Return the transforms of the integrals of 1 / r + x^2 / r^3, x y / r^3 and 1 / r + y^2 / r^3."""
    x, y = _corners(padded, pixel_size)
    x_log, y_log = _x_log(x, y, 0.0), _x_log(y, x, 0.0)
    integrals = x_log + 2 * y_log, -np.hypot(x, y), 2 * x_log + y_log
    xx, xy, yy = (_transform(integral).astype(dtype) for integral in integrals)
    return xx, xy, yy


def _corners(padded: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return x (1, columns + 1) and y (rows + 1, 1) of the pixels' corners relative to pixel 0, mm.

    Pixel k of n is k to the right and below, or n - k to the left and above, whichever is nearer.
    """
    y, x = (np.arange(n + 1, dtype=np.float64) - 0.5 - n // 2 for n in padded)
    return x[np.newaxis, :] * pixel_size[0], -y[:, np.newaxis] * pixel_size[1]


def _x_log(x: Floats, y: Floats, z: float) -> Floats:
    """Return x ln(y + s), s the distance of (x, y, z); its derivative by x and y is (y^2 + z^2) / s^3.

    Only the part of the logarithm that depends on y is kept; the rest cancels in the second difference.
    """
    return x * np.arcsinh(y / np.sqrt(x**2 + z**2))


def _transform(corners: Floats) -> Floats:
    """Return the real transform of the integral over a pixel, from the values at its four corners."""
    from scipy import fft

    pixels = -np.diff(np.diff(corners, axis=0), axis=1)
    return np.ascontiguousarray(fft.rfft2(fft.ifftshift(pixels)).real)


TOLERANCE = 3e-7
"""Maximum error of the gap, as a share of the object's height above the rest plane."""

ITERATIONS = 1000
"""Maximum number of iterations; smooth objects take 10 to 30, rough ones about 100."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The equilibrium of an object and the silicone: they touch where the pressure, N/mm^2, is above 0."""

    space: HalfSpace
    pressure: Floats
    iterations: int

    @property
    def force(self) -> float:
        """Force, N: the integral of the pressure."""
        return self.space.pixel_area * float(self.pressure.sum())

    @property
    def displacement(self) -> Floats:
        """Displacement of the surface, mm up from the rest plane, (H, W), float64; computed at each call."""
        return self.space.surface(self.pressure)


def press(
    space: HalfSpace, obstacle: Floats, *, start: Floats | None = None, compliance: float = 0.0
) -> Contact:
    """Press a rigid object into the half-space, without friction.

    Pressure p and displacement u satisfy, at each pixel, p >= 0, gap u + compliance force - obstacle >= 0,
    and one of the two is 0. This minimises the elastic energy minus the work. It is solved by conjugate
    gradients on the pixels under pressure or overlapping (Polonsky and Keer, Wear 231, 1999, 206-219), here
    at a given depth instead of a given force, preconditioned by the inverse of an infinite half-space.

    Where the object is below the rest plane it cannot touch, because any pressure indents the whole surface.
    The iteration covers the smallest rectangle around the rest, until the gap is accurate to `TOLERANCE`
    times the obstacle's greatest height.

    Parameters
    ----------
    space : HalfSpace
    obstacle : (H, W), the object's surface in the body's frame if the stage were stiff, mm above the rest
        plane; NaN where
        there is no object
    start : (H, W), a pressure to start from, as of the step before
    compliance : how far a force lifts the body, mm/N: the stage's flexure
    """
    for argument in (obstacle, start):
        if argument is not None and argument.shape != space.shape:
            raise ValueError(f"a map of {argument.shape} does not fit a half-space of {space.shape}")
    pressure = np.zeros(space.shape)
    iterations = 0
    reach = obstacle > 0
    if reach.any():
        window = rectangle(reach)
        first = np.zeros(reach.shape) if start is None else np.maximum(start, 0.0)
        first = np.where(reach, first, 0.0)[window]
        pressure[window], iterations = _minimise(space, obstacle[window], reach[window], compliance, first)
    return Contact(space, pressure, iterations)


def _minimise(
    space: HalfSpace, obstacle: Floats, reach: NDArray[np.bool_], compliance: float, start: Floats
) -> tuple[Floats, int]:
    """Return the pressure in equilibrium on the rectangle that the object can touch, and the iterations."""
    space = space.window(*reach.shape)
    tolerance = TOLERANCE * float(obstacle[reach].max())
    lift, precondition = compliance * space.pixel_area, _inverse(space)

    def opened(pressure: Floats) -> Floats:
        moved = space.surface(pressure)
        if lift:
            moved += lift * pressure.sum()
        return moved

    steps = 0
    while True:
        solution = conjugate_gradients(
            lambda change: opened(change.astype(np.float32)),
            np.where(reach, obstacle, 0.0),
            lambda pressure, overlap: Face.of(reach & ((pressure > 0) | (overlap > 0)), precondition),
            converged=lambda residual: float(np.abs(residual).max()) <= tolerance,
            steps=ITERATIONS - steps,
            start=start,
            moved=opened(start),
            limit=lambda pressure: pressure if pressure.min() >= 0 else np.maximum(pressure, 0.0),
        )
        steps, start = steps + solution.steps, solution.x
        if not solution.converged:
            raise RuntimeError(
                f"the contact did not converge in {ITERATIONS} iterations: the error of the gap "
                f"is {float(np.abs(solution.residual).max()):.2g} mm, the tolerance {tolerance:.2g} "
                "mm"
            )
        if not solution.steps:  # converged in double precision as well
            return solution.x, steps


def _inverse(space: HalfSpace) -> Callable[[Floats], Floats]:
    """Return an approximate inverse of the half-space's response: 2 E q / 3 at wavenumber q."""
    padded, _, _, q = wavenumbers(space)
    stiffness = (2 * space.modulus / 3 * q).astype(np.float32)
    return lambda values: filter_roughly(values, padded, lambda spectrum: stiffness * spectrum)


def filter_roughly(
    values: Floats, padded: tuple[int, int], multiply: Callable[[Spectrum], Spectrum]
) -> Floats:
    """Filter the spectra of maps, (..., H, W), on a periodic grid.

    Single precision suffices, because this is only a preconditioner.
    """
    from scipy import fft

    spectrum = fft.rfft2(values.astype(np.float32), padded, overwrite_x=True)
    back: Floats = fft.irfft2(multiply(spectrum), padded, overwrite_x=True)
    return back[..., : values.shape[-2], : values.shape[-1]]


def wavenumbers(space: HalfSpace) -> tuple[tuple[int, int], Floats, Floats, Floats]:
    """Return the size of a periodic grid, and its transform's q_x, q_y and q, 1/mm."""
    from scipy import fft

    rows, columns = (fft.next_fast_len(n, real=True) for n in space.shape)
    q_x, q_y = np.meshgrid(
        2 * np.pi * fft.rfftfreq(columns, space.pixel_size[0]),
        -2 * np.pi * fft.fftfreq(rows, space.pixel_size[1]),
    )
    q = np.hypot(q_x, q_y)
    # A uniform load has the compliance of half a wave over the grid.
    q[0, 0] = np.pi / max(rows * space.pixel_size[1], columns * space.pixel_size[0])
    return (rows, columns), q_x, q_y, q
