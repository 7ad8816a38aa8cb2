"""Colour maps of heights and normals, and the colours of missing and filled pixels; needs no Matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MISSING = "lightsteelblue"
"""Colour of undefined pixels."""
MISSING_RGB = (176, 196, 222)
"""The same as red, green and blue."""
FILLED = "tab:orange"
"""Colour of filled heights."""
FILLED_RGB = (255, 127, 14)
"""The same as red, green and blue."""
EDGE_RGB = (0, 0, 0)
"""Colour of edges, as red, green and blue."""

SEQUENTIAL = "viridis"
"""Matplotlib's colour map for heights, lengths and other sequential values."""
ERROR = "magma"
"""Colour map for errors and standard deviations."""
DIVERGING = "coolwarm"
"""Diverging colour map: blue below 0, red above."""
CYCLIC = "twilight"
"""Cyclic colour map for angles."""

Colours = NDArray[np.uint8]

_SHOWN = 0.2, 99.8  # percentiles at the ends of the colour scale
_EQUAL = 1e-6  # relative difference, about 10 units in the last place of float32
_HALF = 0.01  # half the width of a scale of equal values, relative to them, so that ticks need no offset


def span(values: NDArray[Any]) -> tuple[float, float]:
    """Return the lowest and highest value, except for a few outliers."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, _SHOWN) if finite.size else (-1.0, 0.0)
    return float(low), float(high)


def apart(low: float, high: float) -> tuple[float, float]:
    """Separate the ends of a scale that are equal, or differ by no more than the rounding of float32."""
    if high - low > _EQUAL * max(abs(low), abs(high)):
        return low, high
    middle = (low + high) / 2
    half = max(0.5, _HALF * abs(middle))
    return middle - half, middle + half


def grey(values: NDArray[Any], low: float, high: float) -> Colours:
    """Return shades from black at ``low`` to white at ``high``, of any shape; NaN is black."""
    width = high - low if high > low else 1.0
    return np.asarray(np.nan_to_num((values - low) * (255 / width)).clip(0, 255), np.uint8)


def height_colours(values: NDArray[Any], low: float, high: float) -> Colours:
    """Return colours from violet at ``low`` to yellow at ``high``; undefined values have their own colour."""
    import cv2

    shades = cv2.applyColorMap(grey(values, low, high), cv2.COLORMAP_VIRIDIS)
    colours = np.asarray(cv2.cvtColor(shades, cv2.COLOR_BGR2RGB), np.uint8)
    colours[np.isnan(values)] = MISSING_RGB
    return colours


def normal_colours(normals: NDArray[np.float32], edges: NDArray[np.uint8] | None = None) -> Colours:
    """Return the usual colours of normals: red, green and blue for x, y, z from -1 to 1; edges are black."""
    colours: Colours = ((np.nan_to_num(normals) + 1) * 127.5).astype(np.uint8)
    colours[np.isnan(normals[..., 2])] = MISSING_RGB
    if edges is not None:
        colours[edges > 0] = EDGE_RGB
    return colours
