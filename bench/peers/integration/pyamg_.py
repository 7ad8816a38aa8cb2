"""pyamg: conjugate gradients, preconditioned by a cycle of classical (Ruge-Stuben) multigrid."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

from mirrorskin.bench.peers.integration.system import Doubles

_NEVER = 1e-14  # a residual that stops no run before its last iteration
_MOST = 40  # iterations: more reach nothing in double precision


def set_up(matrix: Any) -> Any:
    """Return the hierarchy of a CSR matrix."""
    return import_module("pyamg").ruge_stuben_solver(matrix)


def solve(hierarchy: Any, source: Doubles, iterations: int) -> Doubles:
    """Return what so many iterations from 0 find, (N,)."""
    values: Doubles = hierarchy.solve(source, tol=_NEVER, maxiter=iterations, accel="cg")
    return values


def fewest_iterations(
    hierarchy: Any, source: Doubles, error_of: Callable[[Doubles], float], error: float
) -> int:
    """Return how many iterations it takes until what ``error_of`` tells of an answer is at most `error`."""
    errors: list[float] = []

    def follow(values: Doubles) -> None:
        errors.append(error_of(values))
        if errors[-1] <= error:
            raise _Enough

    with suppress(_Enough):
        hierarchy.solve(source, tol=_NEVER, maxiter=_MOST, accel="cg", callback=follow)
    return len(errors)


class _Enough(Exception):  # noqa: N818  # it is no error
    pass
