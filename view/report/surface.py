"""The 3D surface of a report, with few enough samples for any browser; holes are kept."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result
from mirrorskin.io.base.types import Floats, axes_with_unit
from mirrorskin.view.drawing.colours import FILLED_RGB, SEQUENTIAL, span

MOST_EXAGGERATED = 20
"""Largest vertical exaggeration."""

_RELIEF = 0.25  # height range on the screen, relative to the picture's width
_STOPS = 16  # samples of the colour map for the script
_CODES = 65535
_PIECES = 0x7FFF  # largest number of a piece that a mark can store
_FILLED_BIT = 0x8000


def surface_data(result: Result) -> dict[str, Any] | None:
    """Return the surface of a page as the data that its script reads."""
    if result.height is None or not np.isfinite(result.height).any():
        return None
    grid = sample(result)
    heights = grid.height[grid.piece >= 0]
    if min(grid.height.shape) < 2 or not heights.size:
        return None
    unit = result.declaration(result.name_of("height") or "height").unit
    scaled = grid.unit == unit
    shown = span(heights)
    ideal = _RELIEF * max(np.ptp(grid.x), np.ptp(grid.y)) / max(shown[1] - shown[0], 1e-9)
    stretch, factor = (1.0, ideal) if scaled else (ideal, 1.0)
    return {
        "unit": grid.unit,
        "unit_of_height": unit,
        "x": np.round(grid.x, 6).tolist(),
        "y": np.round(grid.y, 6).tolist(),
        **_encoded(grid, heights),
        "shown": shown,
        "stretch": stretch,
        "factor": round(min(max(factor, 1.0), MOST_EXAGGERATED)),
        "most": MOST_EXAGGERATED,
        "colours": _colours(),
        "filled": [round(part / 255, 4) for part in FILLED_RGB] if grid.filled.any() else None,
    }


def _encoded(grid: Grid, heights: Floats) -> dict[str, Any]:
    lowest, highest = float(heights.min()), float(heights.max())
    hole = grid.piece < 0
    fraction = (np.where(hole, lowest, grid.height) - lowest) / ((highest - lowest) or 1.0)
    marks = np.where(hole, 0, 1 + grid.piece % _PIECES + _FILLED_BIT * grid.filled)
    return {
        "lowest": lowest,
        "highest": highest,
        "heights": _text(np.round(_CODES * fraction)),
        "marks": _text(marks),
    }


def _text(values: NDArray[Any]) -> str:
    return base64.b64encode(values.astype("<u2").tobytes()).decode("ascii")


def _colours() -> list[list[float]]:
    """Return colours along the colour map, red, green and blue from 0 to 1."""
    from matplotlib import colormaps

    return [[round(part, 4) for part in colormaps[SEQUENTIAL](k / (_STOPS - 1))[:3]] for k in range(_STOPS)]


MOST = 400
"""Largest number of samples along a side."""

Number = TypeVar("Number", bound=np.generic)

_HOLE = -1


@dataclass(frozen=True, slots=True)
class Grid:
    """Heights on a grid.

    Attributes
    ----------
    x, y : ndarray, (n,) and (m,), float64
        Positions of the samples, mm or pixels from the picture's centre; y points up.
    height : ndarray, (m, n), float64
        NaN in a hole.
    piece : ndarray, (m, n), int64
        Number of the connected piece, from 0; -1 in a hole.
    filled : ndarray, (m, n), bool
        Where the height was not measured.
    unit : str
        Of x and y.
    """

    x: Floats
    y: Floats
    height: Floats
    piece: NDArray[np.int64]
    filled: NDArray[np.bool_]
    unit: str


def sample(result: Result, limit: int = MOST) -> Grid:
    """Average over blocks of pixels, so that each side has at most ``limit`` samples.

    Only the rectangle that contains all heights is used. A block with heights at less than half of its pixels
    is a hole. In a block with several pieces, or with measured and filled pixels, only pixels of the median
    kind are used, which is the most common one wherever one has more than half: heights of different kinds
    are never mixed.
    """
    assert result.height is not None
    answered = np.isfinite(result.height)
    rows, columns = (_reach(np.asarray(answered.any(axis=axis))) for axis in (1, 0))
    x, y, unit = _places(result)
    kind_of, height = _kinds(result)[rows, columns], result.height[rows, columns].astype(np.float64)
    block = -(-height.shape[0] // limit), -(-height.shape[1] // limit)
    kind, mean = _averaged(_blocks(kind_of, block, _HOLE), _blocks(height, block, np.nan))
    kind[2 * _count(kind_of != _HOLE, block) < _count(np.ones_like(kind_of, bool), block)] = _HOLE
    hole = kind == _HOLE
    return Grid(
        _means(x[columns], block[1]),
        _means(y[rows], block[0]),
        np.where(hole, np.nan, mean),
        np.where(hole, _HOLE, kind // 2),
        ~hole & (kind % 2 == 1),
        unit,
    )


def _reach(answered: NDArray[np.bool_]) -> slice:
    """Return the range from the first to the last true value."""
    (where,) = np.nonzero(answered)
    return slice(int(where[0]), int(where[-1]) + 1)


def _places(result: Result) -> tuple[Floats, Floats, str]:
    """Return x and y of the pixels, and their unit."""
    if result.x is not None and result.y is not None:
        return result.x, result.y, "mm"
    assert result.height is not None
    rows, columns = result.height.shape
    return axes_with_unit((rows, columns), None)


def _kinds(result: Result) -> NDArray[np.int64]:
    """Return a number of pixels that may be averaged: twice the piece, plus one for filled pixels."""
    assert result.height is not None
    kind = np.zeros(result.height.shape, np.int64)
    if result.component is not None:
        kind += 2 * np.maximum(result.component, 0)
    if result.filled is not None:
        kind += result.filled > 0
    return np.where(np.isfinite(result.height), kind, _HOLE)


def _averaged(kinds: NDArray[np.int64], heights: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the median kind of each block, and the mean height of its pixels; a block of holes is a hole."""
    ordered = np.sort(kinds, axis=-1)  # holes come first
    size, answered = kinds.shape[-1], np.count_nonzero(kinds != _HOLE, axis=-1)
    middle = np.minimum(size - answered + answered // 2, size - 1)[..., np.newaxis]
    kind = np.take_along_axis(ordered, middle, axis=-1)
    chosen = (kinds == kind) & (kinds != _HOLE)
    count = np.maximum(np.count_nonzero(chosen, axis=-1), 1)
    return kind[..., 0], np.sum(heights, axis=-1, where=chosen) / count


def _blocks(values: NDArray[Number], block: tuple[int, int], beyond: float) -> NDArray[Number]:
    """Return the pixels of each block, (m, n, pixels); pixels outside the picture are ``beyond``."""
    padding = [(0, -size % step) for size, step in zip(values.shape, block, strict=True)]
    whole = np.pad(values, padding, constant_values=beyond)
    rows, columns = whole.shape[0] // block[0], whole.shape[1] // block[1]
    return whole.reshape(rows, block[0], columns, block[1]).swapaxes(1, 2).reshape(rows, columns, -1)


def _count(where: NDArray[np.bool_], block: tuple[int, int]) -> NDArray[np.int64]:
    """Count the true values in each block."""
    return np.asarray(np.count_nonzero(_blocks(where, block, False), axis=-1))


def _means(places: Floats, step: int) -> Floats:
    """Return the centres of the blocks."""
    starts = np.arange(0, len(places), step)
    lengths = np.minimum(step, len(places) - starts)
    return np.asarray(np.add.reduceat(places, starts) / lengths)
