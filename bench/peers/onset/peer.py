"""What a peer can be asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Levels = NDArray[Any]  # smallest light sample in the frames' type: one for all, (), or one a pixel, (H, W)


class Heights(NamedTuple):
    """The maps of the full default, (H, W)."""

    height: Floats
    sigma: Floats
    status: NDArray[np.uint8]

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Heights:
        """Return room for the maps of a picture."""
        return cls(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))

    def put(self, rows: slice, part: Heights) -> None:
        """Fill some rows."""
        self.height[rows], self.sigma[rows], self.status[rows] = part


class References(NamedTuple):
    """What is known of each pixel before the first frame, (H, W).

    `level` is the float32 at which it turns light, NaN for a dead pixel, `light` the smallest sample that is
    light, `dark` its dark plateau.
    """

    level: Floats
    light: Levels
    dark: Floats

    def of(self, rows: slice) -> References:
        """Return those of some rows."""
        return References(self.level[rows], self.light[rows], self.dark[rows])


@dataclass(frozen=True, slots=True)
class Peer:
    """One way to compute the onset.

    Attributes
    ----------
    name : str
    first_light : callable
        ``(frames, light, hold)`` to the number of each pixel's onset, (H, W), int32: the first frame of the
        first run of `hold` light frames, 1 or 2, or of one that lasts to the end; -1 without one, -2 where
        a sample that is no number came before it was decided.
    heights : callable or None
        ``(frames, travel, references, noise)`` to the maps of the full default (`hold` 2, sub-frame); None
        where that would only repeat another peer.
    whole_stack : bool
        Whether it takes as much memory again as the frames.
    """

    name: str
    first_light: Callable[[NDArray[Any], Levels, int], NDArray[np.int32]]
    heights: Callable[[NDArray[Any], NDArray[np.float64], References, float], Heights] | None = None
    whole_stack: bool = False
