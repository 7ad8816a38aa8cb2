"""Where the sheet sticks to the object and where it slips, while the body moves along it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.elastic import HalfSpace, Spectrum, Window, filter_roughly, rectangle, wavenumbers
from mirrorskin.io.types import Floats
from mirrorskin.kernels.conjugate_gradients import Face, conjugate_gradients

TOLERANCE = 3e-4
"""Largest error of the surface's shift in a step, as a share of how far the object moves in it."""

ITERATIONS = 1000
"""After this many a step has failed; most take 5 to 40."""

# Of the way so far; a step that is no more than this is none.
_NO_STEP = 1e-9

# Tractions so close to the limit are at it.
_AT_LIMIT = 1 - 1e-9


class Friction:
    """Coulomb friction between the body and an object that moves along it, pressed as before.

    Traction does not raise the surface of an incompressible body, nor does pressure shift it: the contact and
    its pressure p stay what they are (Johnson, Contact Mechanics, 1985, section 7.2). In a step the object
    goes on by dU and the surface by du = C dq, C being Cerruti's response to the traction q. Where |q| < mu p
    it sticks, du = dU; where |q| = mu p it may slip, and then q points along the slip dU - du. Among all |q|
    <= mu p this q is the one of least dq C dq / 2 - dq dU (Kalker's principle for one step). It is found by
    conjugate gradients that are cut off at the limit, as Polonsky and Keer (1999) do it with pressure, from
    the traction of a step that goes on as the one before.

    ``traction``, (2, H, W), is that of the object on the body, N/mm^2, along x and y; it is 0 outside of the
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
            # How far a pixel shifts itself.
            self._own = float(space.window(1, 1).tangential(np.ones((2, 1, 1))).mean())

    @property
    def force(self) -> Floats:
        """Newtons along x and y that the object exerts on the body, (2,)."""
        force: Floats = self.traction.sum(axis=(1, 2)) * self._pixel_area
        return force

    def move(self, displacement: Floats) -> NDArray[np.bool_]:
        """Move the object straight on to another place; return where it slips over the sheet in this step.

        ``displacement``, (2, H, W), is that of the object against the body since the press, mm along x and y:
        the same everywhere if it is pushed, a rotation if it is twisted. Slip is what exceeds the tolerance.
        """
        slips = np.zeros_like(self._contact)
        if not self._contact.any():
            return slips
        here = np.where(self._touches, displacement[:, *self.window], 0.0)
        step = here - self._before
        far = float(_length(step).max())
        # Steps of rounding are put together until they are worth a step.
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
        """Return how much of the last step is in this one; 0 if it goes back."""
        before = float(np.sum(self._step**2))
        return max(0.0, float(np.sum(step * self._step)) / before) if before > 0 else 0.0

    def _shifted(self, change: Floats) -> Floats:
        """Return how much more a change of the traction shifts the surface, (2, H, W), mm."""
        return self._space.tangential(change.astype(np.float32))

    def _follow(
        self, traction: Floats, shift: Floats, target: Floats, tolerance: float
    ) -> tuple[Floats, Floats, _Limited]:
        """Return the traction that shifts the surface to the target where the limit allows, and its shift.

        The search starts from a traction, and from the shift that it causes.
        """

        def within(traction: Floats) -> Floats:
            factors = _shrink(traction, self._limit)
            return traction if (factors == 1).all() else traction * factors

        found = conjugate_gradients(
            self._shifted,
            target,
            lambda traction, lag: self._face(self._limited(traction, lag)),
            converged=lambda residual: float(_length(residual).max()) <= tolerance,
            steps=ITERATIONS,
            start=traction,
            moved=shift,
            limit=within,
        )
        if not found.converged:
            raise RuntimeError(
                f"stick and slip did not converge in {ITERATIONS} iterations: the shift is wrong by"
                f" {float(_length(found.residual).max()):.2g} mm, the tolerance {tolerance:.2g} mm"
            )
        return found.x, found.product, self._limited(found.x, target - found.product)

    def _limited(self, traction: Floats, lag: Floats) -> _Limited:
        return _limited(traction, np.where(self._touches, lag, 0.0), self._limit)

    def _face(self, limited: _Limited) -> Face:
        """Return the directions in which the traction can change.

        What may stick moves together. Where it slips far, only tiny turns of the traction are called for:
        Jacobi's preconditioner.
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
    """The pixels whose traction is at its limit and pushed beyond it: it can only turn.

    ``along`` is the traction's direction there, ``slip`` by how much the surface lags behind in that
    direction, mm, and ``curvature`` that of the energy where the limit's circle bends away from a straight
    turn: slip / limit, mm^3/N.
    """

    where: NDArray[np.bool_]
    along: Floats
    slip: Floats
    curvature: Floats

    def turn(self, vectors: Floats) -> Floats:
        """Return vectors without their part along the traction where that cannot grow."""
        turned: Floats = vectors - np.sum(vectors * self.along, axis=0) * self.along
        return turned


def _inverse(space: HalfSpace) -> Callable[[Floats], Floats]:
    """Return a rough inverse of Cerruti's response, by its spectrum.

    At wavenumber q a traction is softened by 1 / (2 G q) along q, and twice as much across.
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
    # Without friction there is no traction, and slip goes where the object goes.
    along = np.where(limit > 0, traction, lag)
    along = along / np.maximum(_length(along), np.finfo(float).tiny)
    slip = np.sum(lag * along, axis=0)
    where = (size >= _AT_LIMIT * limit) & (slip > 0)
    slip = np.where(where, slip, 0.0)
    curvature = np.divide(slip, limit, out=np.zeros_like(slip), where=limit > 0)
    return _Limited(where, np.where(where, along, 0.0), slip, curvature)


def _shrink(traction: Floats, limit: Floats) -> Floats:
    """Return the factors that bring tractions back to their limit, 1 for those within."""
    size = _length(traction)
    factors: Floats = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    return factors


def _length(vectors: Floats) -> Floats:
    length: Floats = np.sqrt(vectors[0] ** 2 + vectors[1] ** 2)  # three times as quick as np.hypot
    return length
