"""Edges of what is touched: what ``edges.cl`` computes, in NumPy with float64.

Between a pixel and its neighbour, to the right or below, the means of the normals on either side are
compared: of one pixel each where these are quiet, else of two or three deep and three or five across. The
first that is quiet enough counts.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDEST = 3
"""Pixels that the widest window is deep; it is one less than twice as many across."""


def edges_clean(contact: Mask) -> Mask:
    """Turn over the pixels that all neighbours but one, or all, contradict.

    Parameters
    ----------
    contact : ndarray, (H, W), bool

    Returns
    -------
    ndarray, (H, W), bool
    """
    inside = np.ones_like(contact, np.int64)
    around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    known = sum(_moved(inside, *way) for way in around)
    same = sum(
        _moved((contact == one).astype(np.int64), *way) * (contact == one)
        for one in (False, True)
        for way in around
    )
    wrong: Mask = (np.asarray(known) > 1) & (np.asarray(known) - np.asarray(same) >= np.asarray(known) - 1)
    return np.asarray(contact != wrong)


def edges_jumps(
    vectors: Doubles, sigma: Doubles, clean: Mask, least: float, quiet: float, sure: float
) -> Doubles:
    """Tell by which angle the normal jumps between neighbours.

    Parameters
    ----------
    vectors : ndarray, (H, W, 3), float64
    sigma : ndarray, (H, W), float64
        Standard error of the normals, radians; NaN where there is none.
    clean : ndarray, (H, W), bool
        Where there is contact.
    least : float
        Smallest jump that counts, radians.
    quiet : float
        Standard error of a jump with which no wider window is needed, radians.
    sure : float
        Standard errors that a jump must have.

    Returns
    -------
    ndarray, (2, H, W), float64
        Between a pixel and its neighbour to the right, and below; 0 where there is none.
    """
    known = clean & (sigma >= 0)
    maps = [known.astype(np.float64), np.where(known, sigma, 0.0) ** 2]
    maps += [np.where(known, vectors[..., axis], 0.0) for axis in range(3)]
    jumps = np.zeros((2, *clean.shape))
    for down, jump in enumerate(jumps):
        open_ = np.ones_like(clean)
        open_[(slice(None), -1) if not down else -1] = False
        for deep in range(1, WIDEST + 1):
            here, there = ([_side(one, down, way, deep) for one in maps] for way in (-1, 1))
            enough = (deep * (2 * deep - 1) + 1) // 2
            seen = open_ & (here[0] >= enough) & (there[0] >= enough)
            noise = np.sqrt(sum(side[1] / np.maximum(side[0], 1) ** 2 for side in (here, there)))
            told = seen & ((noise <= quiet) | (deep == WIDEST))
            a, b = np.stack(here[2:], axis=-1), np.stack(there[2:], axis=-1)
            angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
            jump[told] = np.where((angle > least) & (angle > sure * noise), angle, 0.0)[told]
            open_ &= ~told
    return jumps


def edges_thin(jumps: Doubles, clean: Mask) -> Mask:
    """Draw thin lines: at the largest jumps across them, and the first pixels out of contact.

    Of the two pixels that a jump is between, that one is drawn which is next to the larger of the jumps
    beside. A slanting line is drawn where rows cross it, or columns, whichever tell of the larger jump.

    Parameters
    ----------
    jumps : ndarray, (2, H, W), float64
    clean : ndarray, (H, W), bool

    Returns
    -------
    ndarray, (H, W), bool
    """
    edges = np.zeros_like(clean)
    for down, jump in enumerate(jumps):
        other = jumps[1 - down]
        beside = np.maximum(other, _moved(other, *((0, -1) if down else (-1, 0))))
        crossed = _crossed(jump, bool(down))
        edges |= (crossed > 0) & (crossed >= beside)
    out = np.zeros_like(clean)
    for way in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        out |= _moved(clean, *way)
    return np.where(clean, edges, out)


def _crossed(jump: Doubles, down: bool) -> Doubles:
    """Return the jump at the pixels where a row or a column crosses a line, 0 elsewhere."""
    highest = jump > 0
    for step in range(1, WIDEST + 1):
        highest &= _moved(jump, *_along(down, step)) <= jump
        highest &= _moved(jump, *_along(down, -step)) < jump
    later = _moved(jump, *_along(down, 1)) > _moved(jump, *_along(down, -1))
    first = np.where(highest & ~later, jump, 0.0)
    return np.where(first > 0, first, _moved(np.where(highest & later, jump, 0.0), *_along(down, -1)))


def _along(down: bool, step: int) -> tuple[int, int]:
    return (step, 0) if down else (0, step)


def _moved(values: NDArray[T], down: int, right: int) -> NDArray[T]:
    """Return at each pixel the value so far below and to the right of it, 0 beyond the picture."""
    moved = np.zeros_like(values)
    rows, columns = values.shape
    to = (slice(max(0, -down), min(rows, rows - down)), slice(max(0, -right), min(columns, columns - right)))
    from_ = (slice(max(0, down), min(rows, rows + down)), slice(max(0, right), min(columns, columns + right)))
    if abs(down) < rows and abs(right) < columns:
        moved[to] = values[from_]
    return moved


def _side(values: Doubles, down: int, way: int, deep: int) -> Doubles:
    """Sum values on one side of the border to the right of each pixel, or below it."""
    total = np.zeros_like(values)
    for i in range(deep):
        away = -i if way < 0 else i + 1
        for j in range(1 - deep, deep):
            total += _moved(values, *((away, j) if down else (j, away)))
    return total
