"""A result in one line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mirrorskin.io import Result


@dataclass(frozen=True, slots=True)
class Summary:
    """How much of a height map was answered.

    Attributes
    ----------
    pixels, answered : int
        All, and those with a height.
    lowest, highest : float
        Millimetres; NaN without an answer.
    """

    pixels: int
    answered: int
    lowest: float
    highest: float

    def __str__(self) -> str:
        if self.answered == 0:
            return f"no height at any of {self.pixels} pixels"
        reach = f"from {self.lowest:.3f} to {self.highest:.3f} mm"
        return f"height at {self.answered} of {self.pixels} pixels, {reach}"


def summarise(result: Result) -> Summary:
    """Count the pixels of a result that have a height, and tell how far the heights reach."""
    height = np.empty(0) if result.height is None else result.height
    heights = height[np.isfinite(height)]
    reach = (float(np.min(heights)), float(np.max(heights))) if heights.size else (np.nan, np.nan)
    return Summary(height.size, heights.size, *reach)
