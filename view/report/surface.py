"""What the page's script is told of a surface."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result
from mirrorskin.io.types import Floats
from mirrorskin.view.colours import FILLED_RGB, span
from mirrorskin.view.report.grid import Grid, sample

MOST_EXAGGERATED = 20
"""Times that heights are drawn larger than they are, at most."""

_RELIEF = 0.25  # of the picture's width, that heights should span on the screen
_MAP = "viridis"
_STOPS = 16  # colours of the map that the script is told
_CODES = 65535
_PIECES = 0x7FFF  # numbers of pieces that a mark has room for
_FILLED_BIT = 0x8000


def surface_data(result: Result) -> dict[str, Any] | None:
    """Return the surface that a page shows in space, as its script reads it.

    Parameters
    ----------
    result : Result
        Of (H, W) maps.

    Returns
    -------
    dict or None
        ``x``, ``y`` (mm, or pixels from the centre, as ``unit`` says); ``lowest`` and ``highest`` height, mm;
        ``heights``: as a share of 65535 from the lowest to the highest, uint16, little-endian, base64;
        ``marks`` in the same form: 0 in a hole, else one more than the number of the piece, and 32768 more
        where it was filled; ``shown``: heights at the ends of the ``colours``; ``stretch``: what a millimetre
        of height is drawn as, in the unit of x and y; ``factor``: the exaggeration to begin with, of at most
        ``most``. None where fewer than two rows or columns have heights.
    """
    if result.height is None or not np.isfinite(result.height).any():
        return None
    grid = sample(result)
    known = grid.height[grid.piece >= 0]
    if min(grid.height.shape) < 2 or not known.size:
        return None
    scaled = result.x is not None and result.y is not None
    shown = span(known)
    ideal = _RELIEF * max(np.ptp(grid.x), np.ptp(grid.y)) / max(shown[1] - shown[0], 1e-9)
    stretch, factor = (1.0, ideal) if scaled else (ideal, 1.0)
    return {
        "unit": "mm" if scaled else "px",
        "x": np.round(grid.x, 6).tolist(),
        "y": np.round(grid.y, 6).tolist(),
        **_encoded(grid, known),
        "shown": shown,
        "stretch": stretch,
        "factor": round(min(max(factor, 1.0), MOST_EXAGGERATED)),
        "most": MOST_EXAGGERATED,
        "colours": _colours(),
        "filled": [round(part / 255, 4) for part in FILLED_RGB] if grid.filled.any() else None,
    }


def _encoded(grid: Grid, known: Floats) -> dict[str, Any]:
    lowest, highest = float(known.min()), float(known.max())
    hole = grid.piece < 0
    share = (np.where(hole, lowest, grid.height) - lowest) / ((highest - lowest) or 1.0)
    marks = np.where(hole, 0, 1 + grid.piece % _PIECES + _FILLED_BIT * grid.filled)
    return {
        "lowest": lowest,
        "highest": highest,
        "heights": _text(np.round(_CODES * share)),
        "marks": _text(marks),
    }


def _text(values: NDArray[Any]) -> str:
    return base64.b64encode(values.astype("<u2").tobytes()).decode("ascii")


def _colours() -> list[list[float]]:
    """Return colours along the map of the pictures, red, green and blue from 0 to 1."""
    from matplotlib import colormaps

    return [[round(part, 4) for part in colormaps[_MAP](k / (_STOPS - 1))[:3]] for k in range(_STOPS)]
