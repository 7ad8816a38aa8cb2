"""Preconditioned conjugate gradients for symmetric positive definite systems, also with limited unknowns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The directions in which the unknowns can change, and a preconditioner for these directions.

    ``curvature`` is added to the diagonal of the matrix along curved limits.
    """

    project: Callable[[Array], Array]
    precondition: Callable[[Array], Array]
    curvature: Array | None = None

    @classmethod
    def of(cls, mask: NDArray[np.bool_], precondition: Callable[[Array], Array]) -> Face:
        """Return the face where the unknowns within a mask are free, and the others are fixed."""
        return cls(lambda values: np.where(mask, values, values.dtype.type(0)), precondition)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The unknowns x, the product A x, the residual b - A x on the last face, and the number of steps."""

    x: Array
    product: Array
    residual: Array
    steps: int
    converged: bool


def conjugate_gradients(
    product: Callable[[Array], Array],
    target: Array,
    face: Face | Callable[[Array, Array], Face],
    *,
    converged: Callable[[Array], bool],
    steps: int,
    start: Array | None = None,
    moved: Array | None = None,
    limit: Callable[[Array], Array] | None = None,
    axes: tuple[int, ...] | None = None,
) -> Solution:
    """Minimise ``x A x / 2 - b x`` for symmetric positive definite A.

    Directions follow the formula of Polak and Ribiere; the iteration restarts when the face changes. With
    limits, the unknowns are projected after each step (Polonsky and Keer, Wear 231, 1999, 206-219). Sums are
    computed by NumPy: for the size of a map, the threads of BLAS cost more than they save.

    Parameters
    ----------
    product
        Returns A times an increment of x. Increments become small, and so do their rounding errors.
    target
        b.
    face
        The free directions, or a function that returns them, given x and ``b - A x``.
    converged
        Whether a residual on the face is small enough.
    steps
        Largest number of steps.
    start
        Initial x, within the limits; 0 by default.
    moved
        A times the initial x, if it is available.
    limit
        Returns the x within the limits that is closest to an x: the same array if it is within them.
    axes
        Last axes, those of one system; systems along the others are solved simultaneously. By default all.
    """
    x = np.zeros_like(target) if start is None else start
    if moved is None:
        moved = np.zeros_like(target) if start is None else product(x)
    direction: Array | None = None
    last: Array | None = None
    gain: Array | float = np.inf
    tiny = np.finfo(target.dtype).tiny

    systems = (1,) * target.ndim if axes is None else (*target.shape[: -len(axes)], *(1 for _ in axes))
    flat = math.prod(systems), -1

    def inner(first: Array, second: Array) -> Array:
        sums: Array = np.einsum("ni,ni->n", first.reshape(flat), second.reshape(flat))
        return sums.reshape(systems)

    for step in range(steps + 1):
        rest = target - moved
        here = face(x, rest) if callable(face) else face
        residual = here.project(rest)
        is_converged = converged(residual)
        if is_converged or step == steps:
            break
        steepest = here.project(here.precondition(residual))
        before, gain = gain, inner(residual, steepest)
        if last is None or direction is None:
            direction = steepest.astype(target.dtype, copy=False)
        else:
            memory = np.maximum(gain - inner(last, steepest), 0) / np.maximum(before, tiny)
            direction = steepest + memory * direction
            if callable(face):  # the direction before may be outside of this face
                direction = here.project(direction)
        last = residual
        along = product(direction)
        stiff = along if here.curvature is None else along + here.curvature * direction
        length = inner(residual, direction) / np.maximum(inner(direction, stiff), tiny)
        farther = x + length * direction
        within = farther if limit is None else limit(farther)
        moved = moved + (length * along if within is farther else product(within - x))
        x = within
    return Solution(x, moved, residual, step, is_converged)
