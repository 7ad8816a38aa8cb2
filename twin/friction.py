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

# Relative error of a displacement that is computed in single precision; steps are not followed closer.
_ROUNDING = 5e-7

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

    If the object is pressed more or less in between, what sticks keeps its place on the sheet, and slips only
    where the traction exceeds the new limit.

    ``traction``, (2, H, W), is exerted by the object on the body, N/mm^2, along x and y; it is 0 outside the
    ``window`` of the grid. ``slid``, (2, H, W), is how far the object has slid over the sheet since it
    touched, mm.
    """

    def __init__(self, space: HalfSpace, pressure: Floats, coefficient: float) -> None:
        self.traction: Floats = np.zeros((2, *space.shape))
        self.slid: Floats = np.zeros_like(self.traction)
        self._half_space, self._coefficient = space, coefficient
        self._pixel_area = space.pixel_area
        self._displacement: Floats = np.zeros((2, *space.shape))
        # Displacement of a pixel under its own load.
        self._own = float(space.window(1, 1).tangential(np.ones((2, 1, 1))).mean())
        self.press(pressure)

    def press(self, pressure: Floats) -> None:
        """Change the pressure, N/mm^2, while the object rests along the sheet."""
        held, self.traction = self.traction, np.zeros_like(self.traction)
        self._contact = pressure > 0
        self.slid = self.slid * self._contact
        self.window: Window = np.s_[0:0, 0:0]
        if not self._contact.any():
            return
        rows, columns = self.window = rectangle(self._contact)
        self._touches = self._contact[self.window]
        self._limit = np.where(self._touches, self._coefficient * pressure[self.window], 0.0)
        self._space = self._half_space.window(*self._touches.shape)
        self._inverse = _inverse(self._space)
        self._before = np.where(self._touches, self._displacement[:, rows, columns], 0.0)
        self._step = self._growth = self._shift = np.zeros_like(self._before)
        if not held.any():
            return
        across, along = both = rectangle(self._contact | held.any(axis=0))
        loaded = self._half_space.window(across.stop - across.start, along.stop - along.start)
        shift = loaded.tangential(held[:, *both].astype(np.float32))
        shift = shift[
            :,
            rows.start - across.start : rows.stop - across.start,
            columns.start - along.start : columns.stop - along.start,
        ]
        start = held[:, rows, columns] * _shrink(held[:, rows, columns], self._limit)
        tolerance = TOLERANCE * float(_length(shift).max())
        traction, self._shift, _ = self._follow(start, self._shifted(start), shift, tolerance)
        self.traction[:, rows, columns] = traction
        self.slid[:, rows, columns] += np.where(self._touches, shift - self._shift, 0.0)

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
            tolerance = max(TOLERANCE * far, _ROUNDING * float(_length(self._shift).max()))
            held = self.traction[:, *self.window]
            likely = held + self._likeness(step) * self._growth
            likely *= _shrink(likely, self._limit)
            begin, target = self._shift + self._shifted(likely - held), self._shift + step
            traction, self._shift, limited = self._follow(likely, begin, target, tolerance)
            self._step, self._growth = step, traction - held
            self.traction[:, *self.window] = traction
            self.slid[:, *self.window] += np.where(self._touches, target - self._shift, 0.0)
            self._before, self._displacement = here, displacement
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
