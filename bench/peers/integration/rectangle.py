"""What a peer can be asked about a full picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]  # float32, or float64 where an exact answer is wanted


@dataclass(frozen=True, slots=True)
class Peer:
    """One way to integrate a rectangle.

    Attributes
    ----------
    name : str
    solve : callable
        ``(source, divisors)`` to the heights with mean 0, all (H, W) and of one type, for square pixels and
        links of weight 1.
    """

    name: str
    solve: Callable[[Floats, Floats], Floats]


def divisors(shape: tuple[int, int], dtype: type[np.floating[Any]]) -> Floats:
    """Return the inverse eigenvalues of the rectangle's cosines, (H, W): the set-up of a solve."""
    down, across = (4 * np.square(np.sin(np.pi * np.arange(n) / (2 * n))).astype(dtype) for n in shape)
    found: Floats = np.add(down[:, np.newaxis], across)
    found[0, 0] = np.inf  # the mean
    np.divide(dtype(1), found, out=found)
    return found
