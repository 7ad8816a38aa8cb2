"""Which axis of a stack is time: the one along which brightness changes as in a press, or in a turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding

CHANGES_ONCE = 0.75
"""Share of the pixels of a press that change once over time, at least."""
STAYS_AWAY = 3.0
"""Most that frames of a whole turn return to the first one within, in differences of neighbouring frames."""

_RISEN = 0.7  # share of a line's range
_ONCE = 0.9  # share of lines along an axis of pictures that change once, if the axis is time
_RETURNS = 1.6  # as STAYS_AWAY, along an axis of pictures that is the time of a turn
_LINES_MIN, _LENGTH = 64, 256  # fewest lines; about the most samples of a line

Lines = NDArray[np.float32]


def finding(problem: str) -> Finding:
    """Return the finding that the axes of a stack have another order."""
    return Finding("axes", f"{problem}: is the order of the axes (T, H, W)?")


def changes_once(lines: Lines) -> float:
    """Return the share of lines, (length, n), that rise once, or of those that fall once.

    A line is light above 70 % of its range, dark below 30 %, and unchanged in between.
    """
    if not lines.size:
        return 0.0
    lines = lines[:: max(1, len(lines) // _LENGTH)]
    lowest, highest = lines.min(axis=0), lines.max(axis=0)
    share = (lines - lowest) / np.maximum(highest - lowest, 1e-30)
    known = (share > _RISEN) | (share < 1 - _RISEN)
    last = np.maximum.accumulate(np.where(known, np.arange(len(lines))[:, np.newaxis], 0), axis=0)
    light = np.take_along_axis(share, last, axis=0) > 0.5
    once = np.count_nonzero(light[1:] != light[:-1], axis=0) == 1
    return float(max(np.mean(once & light[-1]), np.mean(once & light[0])))


def axis_of_press(pictures: Lines, response: float) -> str:
    """Return the axis of pictures, (T, rows, columns), along which brightness changes once; "" if none."""
    for name, lines in _lines(pictures):
        responding = lines[:, np.ptp(lines, axis=0) > response]
        if responding.shape[1] >= _LINES_MIN and changes_once(responding) > _ONCE:
            return name
    return ""


def axis_of_turn(pictures: Lines) -> str:
    """Return the axis of pictures, (T, rows, columns), along which brightness returns; "" if none."""
    return next((name for name, lines in _lines(pictures) if ends_apart(lines) < _RETURNS), "")


def ends_apart(lines: Lines) -> float:
    """Return the difference between the ends of lines, (length, n), over that of neighbours."""
    steps = float(np.nanmean(np.abs(np.diff(lines, axis=0)))) if len(lines) > 1 else 0.0
    return float(np.nanmean(np.abs(lines[-1] - lines[0]))) / steps if steps > 0 else 0.0


def _lines(pictures: Lines) -> Iterator[tuple[str, Lines]]:
    """Yield the brightness along the rows and along the columns of all pictures, (length, n)."""
    for axis, name in ((2, "rows"), (1, "columns")):
        yield name, np.moveaxis(pictures, axis, 0).reshape(pictures.shape[axis], -1)
