"""What all figures share: a canvas, where a map lies on it, and how it becomes a file."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.io.types import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MISSING = "lightsteelblue"
"""Colour of what has no answer."""
FILLED = "tab:orange"
"""Colour of what was not measured but filled."""
FILLED_SHADES = "#331a00", "#ffb266"
"""Its shades, from the lowest to the highest."""


def check_drawing() -> None:
    """Raise InputError if nothing can be drawn, before any work is done for a figure."""
    if find_spec("matplotlib") is None:
        raise InputError("figures need Matplotlib: pip install 'mirrorskin[view]'")


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, of so many inches."""
    check_drawing()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, title: str, path: Path) -> None:
    """Write a figure with its title into a PNG, or raise InputError."""
    figure.suptitle(title, x=0.02, ha="left", weight="bold")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}") from error


def extent(x: Floats, y: Floats) -> tuple[float, float, float, float]:
    """Return the outer edges of a map's pixels, mm: left, right, bottom and top."""
    half = (abs(x[1] - x[0]) / 2, abs(y[1] - y[0]) / 2)
    return float(x[0] - half[0]), float(x[-1] + half[0]), float(y[-1] - half[1]), float(y[0] + half[1])


def check_same_size(shape: tuple[int, ...], truth: NDArray[np.float32]) -> None:
    """Raise InputError unless a result and the truth are of one stack."""
    if truth.shape != shape:
        raise InputError(f"the result is {shape} pixels, the truth {truth.shape}: not of one stack")
