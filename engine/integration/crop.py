"""The part of a picture with an answer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Box = tuple[slice, slice]
"""Rows and columns of a part of a picture."""

Mask = NDArray[np.bool_]


def find_box(shape: tuple[int, int], answered: Callable[[Box], Mask]) -> Box:
    """Return the smallest box that contains all pixels with an answer; the whole picture if there are none.

    ``answered`` returns a mask of the pixels of a box. It is only called for the margins and a few lines.
    """
    columns = slice(0, shape[1])
    rows = _find_ends(shape[0], lambda lines: np.any(answered((lines, columns)), axis=1))
    return rows, _find_ends(shape[1], lambda lines: np.any(answered((rows, lines)), axis=0))


def _find_ends(count: int, answered: Callable[[slice], Mask]) -> slice:
    """Return the range from the first to the last line with an answer, searching from both ends."""
    begin, strip = 0, 1
    while not (some := answered(slice(begin, begin + strip))).any():
        begin, strip = begin + strip, 2 * strip
        if begin >= count:
            return slice(0, count)
    begin, end, strip = begin + int(some.argmax()), count, 1
    while not (some := answered(slice(max(begin, end - strip), end))).any():
        end, strip = end - strip, 2 * strip
    return slice(begin, end - int(some[::-1].argmax()))
