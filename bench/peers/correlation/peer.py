"""What a peer can be asked about any number of turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]


class Wave(NamedTuple):
    """The least-squares fit of mean, cosine and sine, and what it leaves, (H, W) each."""

    mean: Floats
    cosine: Floats
    sine: Floats
    residual: Floats

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Wave:
        """Return room for the maps of a picture."""
        return cls(*(np.empty(shape, np.float32) for _ in range(4)))

    def flat(self) -> Wave:
        """Return the same maps with pixels in one row."""
        return Wave(*(values.reshape(-1) for values in self))


@dataclass(frozen=True, slots=True)
class Peer:
    """One way to correlate.

    Attributes
    ----------
    name : str
    correlate : callable
        ``(frames, phase)`` to the wave, of uint8 frames (N, H, W) and phases (N,), float64.
    slide : callable
        ``(sums, now, gone, basis)``: take a frame into a window's sums, and out the one that it replaces.
        Sums are (4, H, W) int32: of the samples, of their products with cosine and sine and of their
        squares; ``basis`` is 1, cosine and sine of the new frame and of the old one, in units, (6,) int32.
    """

    name: str
    correlate: Callable[[NDArray[Any], Doubles], Wave]
    slide: Callable[[NDArray[np.int32], NDArray[Any], NDArray[Any], NDArray[np.int32]], None]
