"""A rigid object pressed into the silicone without friction: where it touches, how hard, what gives way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from mirrorskin.hw.twin.contact.halfspace import HalfSpace, inner, rectangle
from mirrorskin.io.types import Floats

TOLERANCE = 1e-6
"""Largest error of the gap, as a share of how far the object reaches above the rest plane."""

ITERATIONS = 1000
"""After this many a press has failed; smooth objects take 10 to 30, rough ones about 100."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """How an object and the silicone have come to rest.

    Attributes
    ----------
    space : HalfSpace
    pressure : ndarray, (H, W), float64
        N/mm^2, 0 or more; they touch where it is above 0.
    iterations : int
        That it took.
    """

    space: HalfSpace
    pressure: Floats
    iterations: int

    @property
    def force(self) -> float:
        """Newtons: the pressure's sum over the area."""
        return self.space.pixel_area * float(self.pressure.sum())

    @property
    def displacement(self) -> Floats:
        """Of the surface, mm up from the body's rest plane, (H, W), float64; worked out at each call."""
        return self.space.surface(self.pressure)


def press(
    space: HalfSpace, obstacle: Floats, *, start: Floats | None = None, compliance: float = 0.0
) -> Contact:
    """Press a rigid object into the half-space, without friction.

    Pressure p and displacement u are those for which, at each pixel, p >= 0, the gap u + compliance force -
    obstacle is 0 or more, and one of the two is 0: the least elastic energy less work. They are found by
    conjugate gradients on the pixels that press or overlap (Polonsky and Keer, Wear 231, 1999, 206-219), here
    at a given depth instead of a given force, and preconditioned by the inverse of an endless half-space.

    Where the object is below the rest plane it cannot touch, as pressure anywhere pushes all of it in. The
    rest is iterated on, in the smallest rectangle round it.

    Parameters
    ----------
    space : HalfSpace
    obstacle : ndarray, (H, W), float64
        The object's surface in the body's frame if the stage were stiff, mm above the rest plane; NaN where
        there is no object.
    start : ndarray, (H, W), float64, optional
        A pressure to start from, as of the step before; it does not change the answer beyond the tolerance.
    compliance : float
        How far a force lifts the body, mm/N: the stage's flexure.

    Returns
    -------
    Contact
        The gap is right to `TOLERANCE` times the greatest height of the obstacle above the rest plane.

    Raises
    ------
    RuntimeError
        It does not converge in `ITERATIONS`.
    ValueError
        The obstacle or the start is not of the half-space's shape.
    """
    for given in (obstacle, start):
        if given is not None and given.shape != space.shape:
            raise ValueError(f"a map of {given.shape} does not fit a half-space of {space.shape}")
    pressure = np.zeros(space.shape)
    iterations = 0
    reach = obstacle > 0
    if reach.any():
        window = rectangle(reach)
        first = np.zeros(reach.shape) if start is None else np.maximum(start, 0.0)
        system = _System(space, obstacle[window], reach[window], compliance)
        pressure[window], iterations = _minimise(system, np.where(reach, first, 0.0)[window])
    return Contact(space, pressure, iterations)


class _System:
    """The problem on the rectangle that the object can touch."""

    def __init__(
        self, space: HalfSpace, obstacle: Floats, reach: NDArray[np.bool_], compliance: float
    ) -> None:
        self.space = space.window(*reach.shape)
        self.reach = reach
        self.obstacle = np.where(reach, obstacle, 0.0)
        self.precondition = _inverse(self.space)
        self._lift = compliance * space.pixel_area

    def response(self, pressure: Floats) -> Floats:
        """Return by how much a pressure opens the gap, mm."""
        opened = self.space.surface(pressure)
        if self._lift:
            opened += self._lift * pressure.sum()
        return opened

    def gap(self, pressure: Floats) -> Floats:
        return self.response(pressure) - self.obstacle


def _minimise(system: _System, pressure: Floats) -> tuple[Floats, int]:
    """Return the pressure at rest, and the iterations that it took."""
    tolerance = TOLERANCE * float(system.obstacle.max())
    gap = system.gap(pressure)
    direction = last = np.zeros_like(pressure)
    last_decline = np.inf
    for iteration in range(ITERATIONS):
        free = system.reach & ((pressure > 0) | (gap < 0))
        residual = np.where(free, gap, 0.0)
        if float(np.abs(residual).max()) <= tolerance:
            return pressure, iteration
        steepest = np.where(free, system.precondition(residual), 0.0)
        decline = inner(residual, steepest)
        # Polak and Ribiere's rule, which forgets by itself when pixels come and go.
        memory = max(0.0, (decline - inner(last, steepest)) / last_decline)
        direction = steepest + memory * np.where(free, direction, 0.0)
        last, last_decline = residual, decline
        pressure, gap = _step(system, pressure, gap, residual, direction)
    raise RuntimeError(
        f"the contact did not come to rest in {ITERATIONS} iterations: the gap is wrong by"
        f" {float(np.abs(residual).max()):.2g} mm, the tolerance {tolerance:.2g} mm"
    )


def _step(
    system: _System, pressure: Floats, gap: Floats, residual: Floats, direction: Floats
) -> tuple[Floats, Floats]:
    """Go to the lowest energy along the direction, without pull; return pressure and gap."""
    response = system.response(direction)
    length = inner(residual, direction) / inner(direction, response)
    moved = pressure - length * direction
    if moved.min() >= 0:
        return moved, gap - length * response
    np.maximum(moved, 0.0, out=moved)
    return moved, system.gap(moved)


def _inverse(space: HalfSpace) -> Callable[[Floats], Floats]:
    """Return a rough inverse of the half-space's response, by its spectrum: 2 E q / 3 at wavenumber q.

    The grid comes round on itself here, and single precision will do: it only steers the search.
    """
    rows, columns = (fft.next_fast_len(n, real=True) for n in space.shape)
    q_x = 2 * np.pi * fft.rfftfreq(columns, space.pixel_size[0])
    q_y = 2 * np.pi * fft.fftfreq(rows, space.pixel_size[1])
    q = np.hypot(q_x[np.newaxis, :], q_y[:, np.newaxis])
    # An even load is as soft as half a wave over the grid.
    q[0, 0] = np.pi / max(rows * space.pixel_size[1], columns * space.pixel_size[0])
    stiffness = (2 * space.modulus / 3 * q).astype(np.float32)

    def apply(values: Floats) -> Floats:
        spectrum = fft.rfft2(values.astype(np.float32), (rows, columns), workers=2, overwrite_x=True)
        spectrum *= stiffness
        back: Floats = fft.irfft2(spectrum, (rows, columns), workers=2, overwrite_x=True)
        return back[: space.shape[0], : space.shape[1]]

    return apply
