"""Heights as counts of 16 bits, and where a picture's pixels are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.export.points import grid_of
from mirrorskin.io.types import Floats, InputError, Result

_MOST = np.iinfo(np.uint16).max
_FLAT = 1e-6  # mm a count, where all heights are one


@dataclass(frozen=True, slots=True)
class Counts:
    """A map of heights in 16 bits: its height is ``offset + step * counts``.

    Attributes
    ----------
    values : ndarray, (H, W), uint16
        1 at the lowest height, 65535 at the highest, 0 where there is no answer.
    offset, step : float
        Millimetres: the height at count 0, and of one count.
    pixel_size : (float, float)
        Millimetres along x and y.
    first : (float, float)
        Millimetres: x and y of the first pixel's centre, at the top left.
    """

    values: NDArray[np.uint16]
    offset: float
    step: float
    pixel_size: tuple[float, float]
    first: tuple[float, float]

    @property
    def highest(self) -> float:
        """The height at the highest count, mm."""
        return self.offset + self.step * _MOST

    def __str__(self) -> str:
        return f"height in mm = {self.offset!r} + {self.step!r} x count; count 0: no answer"


def counts_of(result: Result) -> Counts:
    """Spread the known heights of a result over 16 bits.

    Parameters
    ----------
    result : Result
        With heights, (H, W), some of them known, and places.

    Raises
    ------
    InputError
        There is one pixel alone.
    """
    height, x, y = grid_of(result)
    known = np.isfinite(height)
    heights = np.where(known, height, np.nan).astype(np.float64)
    lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
    step = (highest - lowest) / (_MOST - 1) or _FLAT
    values = np.rint((np.where(known, heights, lowest) - lowest) / step) + 1
    first = float(x[0]), float(y[0])
    return Counts(np.where(known, values, 0).astype(np.uint16), lowest - step, step, _pixel_size(x, y), first)


def _pixel_size(x: Floats, y: Floats) -> tuple[float, float]:
    """Tell the size of a pixel from the places; of a single row or column it is as long as it is wide."""
    sizes = [abs(float(axis[-1] - axis[0])) / (len(axis) - 1) for axis in (x, y) if len(axis) > 1]
    if not sizes:
        raise InputError("a result of one pixel does not tell how large that is: export it as .xyz or .npz")
    return sizes[0], sizes[-1]
