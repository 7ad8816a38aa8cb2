"""Stick and slip between sheet and object while the body moves along it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.kernels.numerics.conjugate_gradients import Face, conjugate_gradients
from mirrorskin.twin.elastic import HalfSpace, Spectrum, Window, filter_roughly, rectangle, wavenumbers

TOLERANCE = 3e-4
"""Maximum error of the surface's displacement in a step, as a share of the object's displacement."""

ITERATIONS = 1000
"""Maximum number of iterations; most steps take 5 to 40."""

# Relative to the total displacement; smaller steps are ignored.
_NO_STEP = 1e-9

# Tractions this close to the limit are at it.
_AT_LIMIT = 1 - 1e-9


class Friction:
    """Coulomb friction between the body and an object that moves along it at constant pressure.

    Traction does not raise the surface of an incompressible body, and pressure does not displace it along
    itself: the contact and its pressure p are unchanged (Johnson, Contact Mechanics, 1985, section 7.2). In a
    step the object moves by dU and the surface by du = C dq, with C Cerruti's response to the traction q.
    Where |q| < mu p it sticks, du = dU; where |q| = mu p it may slip, and q is parallel to the slip dU - du.
    Among all |q| <= mu p this q minimises dq C dq / 2 - dq dU (Kalker's principle for one step). It is found
    by conjugate gradients that are projected onto the limit, as Polonsky and Keer (1999) do for pressure,
    starting from the extrapolated traction of the preceding step.

    ``traction``, (2, H, W), is exerted by the object on the body, N/mm^2, along x and y; it is 0 outside the
    ``window`` of the grid.
    """

    def __init__(self, space: HalfSpace, pressure: Floats, coefficient: float) -> None:
        self.traction: Floats = np.zeros((2, *space.shape))
        self._pixel_area = space.pixel_area
        self._contact = pressure > 0
        self.window: Window = np.s_[0:0, 0:0]
        if self._contact.any():
            self.window = rectangle(self._contact)
            self._touches = self._contact[self.window]
            self._limit = np.where(self._touches, coefficient * pressure[self.window], 0.0)
            self._space = space.window(*self._touches.shape)
            self._before = self._shift = np.zeros((2, *self._touches.shape))
            self._step = self._growth = np.zeros_like(self._before)
            self._inverse = _inverse(self._space)
            # Displacement of a pixel under its own load.
            self._own = float(space.window(1, 1).tangential(np.ones((2, 1, 1))).mean())

    @property
    def force(self) -> Floats:
        """Force of the object on the body along x and y, (2,), N."""
        force: Floats = self.traction.sum(axis=(1, 2)) * self._pixel_area
        return force

    def move(self, displacement: Floats) -> NDArray[np.bool_]:
        """Move the object along a straight line; return where it slips over the sheet in this step.

        ``displacement``, (2, H, W), is the total displacement of the object relative to the body since the
        press, mm along x and y: uniform for a slide, a rotation for a twist. Slip is displacement beyond the
        tolerance.
        """
        slips = np.zeros_like(self._contact)
        if not self._contact.any():
            return slips
        here = np.where(self._touches, displacement[:, *self.window], 0.0)
        step = here - self._before
        far = float(_length(step).max())
        # Steps of the size of rounding errors are accumulated.
        if far > _NO_STEP * max(float(_length(place).max()) for place in (here, self._shift)):
            tolerance = TOLERANCE * far
            held = self.traction[:, *self.window]
            likely = held + self._likeness(step) * self._growth
            likely *= _shrink(likely, self._limit)
            begin = self._shift + self._shifted(likely - held)
            traction, self._shift, limited = self._follow(likely, begin, self._shift + step, tolerance)
            self._step, self._growth = step, traction - held
            self.traction[:, *self.window] = traction
            self._before = here
            slips[self.window] = limited.where & (limited.slip > tolerance)
        return slips

    def _likeness(self, step: Floats) -> float:
        """Return the share of the last step that is contained in this one; 0 if it reverses."""
        before = float(np.sum(self._step**2))
        return max(0.0, float(np.sum(step * self._step)) / before) if before > 0 else 0.0

    def _shifted(self, change: Floats) -> Floats:
        """Return the displacement of the surface by a change of the traction, (2, H, W), mm."""
        return self._space.tangential(change.astype(np.float32))

    def _follow(
        self, traction: Floats, shift: Floats, target: Floats, tolerance: float
    ) -> tuple[Floats, Floats, _Limited]:
        """Return the traction that moves the surface to the target within the limit, and its displacement.

        The search starts from a traction and the displacement that it causes.
        """

        def within(traction: Floats) -> Floats:
            factors = _shrink(traction, self._limit)
            return traction if (factors == 1).all() else traction * factors

        solution = conjugate_gradients(
            self._shifted,
            target,
            lambda traction, lag: self._face(self._limited(traction, lag)),
            converged=lambda residual: float(_length(residual).max()) <= tolerance,
            steps=ITERATIONS,
            start=traction,
            moved=shift,
            limit=within,
        )
        if not solution.converged:
            raise RuntimeError(
                f"stick and slip did not converge in {ITERATIONS} iterations: the error of the "
                f"displacement is {float(_length(solution.residual).max()):.2g} mm, the tolerance "
                f"{tolerance:.2g} mm"
            )
        return solution.x, solution.product, self._limited(solution.x, target - solution.product)

    def _limited(self, traction: Floats, lag: Floats) -> _Limited:
        return _limited(traction, np.where(self._touches, lag, 0.0), self._limit)

    def _face(self, limited: _Limited) -> Face:
        """Return the directions in which the traction can change.

        Pixels that may stick move together. Where the slip is large, only small rotations of the traction are
        needed: Jacobi's preconditioner.
        """

        def precondition(residual: Floats) -> Floats:
            free = self._inverse(np.where(limited.where, 0.0, residual))
            return np.where(limited.where, residual / (self._own + limited.curvature), free)

        return Face(
            lambda vectors: limited.turn(np.where(self._touches, vectors, 0.0)),
            precondition,
            limited.curvature,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Limited:
    """The pixels whose traction is at its limit and pushed beyond it: it can only rotate.

    ``along`` is the direction of the traction there, ``slip`` the lag of the surface in that direction, mm,
    and ``curvature`` the curvature of the energy along the limit's circle: slip / limit, mm^3/N.
    """

    where: NDArray[np.bool_]
    along: Floats
    slip: Floats
    curvature: Floats

    def turn(self, vectors: Floats) -> Floats:
        """Return vectors without their component along the traction where it is at its limit."""
        turned: Floats = vectors - np.sum(vectors * self.along, axis=0) * self.along
        return turned


def _inverse(space: HalfSpace) -> Callable[[Floats], Floats]:
    """Return an approximate inverse of Cerruti's response, by its spectrum.

    The response at wavenumber q is 1 / (2 G q) along q, and twice that across.
    """
    padded, q_x, q_y, q = wavenumbers(space)
    along_x, along_y, stiff = q_x / q, q_y / q, q / (4 * np.pi * space.softness)
    xx, xy, yy = (
        (stiff * part).astype(np.float32) for part in (1 + along_x**2, along_x * along_y, 1 + along_y**2)
    )

    def stiffen(along: Spectrum) -> Spectrum:
        return np.stack([xx * along[0] + xy * along[1], xy * along[0] + yy * along[1]])

    return lambda values: filter_roughly(values, padded, stiffen)


def _limited(traction: Floats, lag: Floats, limit: Floats) -> _Limited:
    size = _length(traction)
    # Without friction there is no traction, and the slip equals the motion of the object.
    along = np.where(limit > 0, traction, lag)
    along = along / np.maximum(_length(along), np.finfo(float).tiny)
    slip = np.sum(lag * along, axis=0)
    where = (size >= _AT_LIMIT * limit) & (slip > 0)
    slip = np.where(where, slip, 0.0)
    curvature = np.divide(slip, limit, out=np.zeros_like(slip), where=limit > 0)
    return _Limited(where, np.where(where, along, 0.0), slip, curvature)


def _shrink(traction: Floats, limit: Floats) -> Floats:
    """Return factors that scale tractions back to their limit, 1 for those within."""
    size = _length(traction)
    factors: Floats = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    return factors


def _length(vectors: Floats) -> Floats:
    length: Floats = np.sqrt(vectors[0] ** 2 + vectors[1] ** 2)  # three times as fast as np.hypot
    return length
