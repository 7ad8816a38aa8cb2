"""Figures for people: heights as a map, and cut across against the truth."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result, Truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MISSING = "0.88"


def height_figure(result: Result, truth: Truth, title: str, path: Path) -> None:
    """Draw a height map, and a cut across its middle against the truth, into a PNG.

    Parameters
    ----------
    result : Result
        With ``height``, ``x`` and ``y``.
    truth : Truth
        Of the same size.
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, the result has no heights or axes, or the file cannot be written.
    """
    figure = _draw(result, truth)
    figure.suptitle(title, x=0.02, ha="left", weight="bold")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}") from error


def _draw(result: Result, truth: Truth) -> Figure:
    height, x, y = result.height, result.x, result.y
    if height is None or x is None or y is None or min(height.shape) < 2:
        raise InputError("a figure needs heights and the pixel size, of 2 x 2 pixels at least")
    if truth.height.shape != height.shape:
        raise InputError(
            f"the result is {height.shape} pixels, the truth {truth.height.shape}: not of one stack"
        )
    figure = _new_figure()
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.35])
    _draw_map(left, height, x, y)
    _draw_cut(right, height, truth.height, x)
    return figure


def check_drawing() -> None:
    """Raise InputError if nothing can be drawn, before any work is done for a figure."""
    if find_spec("matplotlib") is None:
        raise InputError("figures need Matplotlib: pip install 'mirrorskin[view]'")


def _new_figure() -> Figure:
    check_drawing()
    from matplotlib.figure import Figure

    return Figure(figsize=(11, 4.6), layout="constrained")


def _draw_map(
    axes: Axes, height: NDArray[np.float32], x: NDArray[np.float64], y: NDArray[np.float64]
) -> None:
    half = (abs(x[1] - x[0]) / 2, abs(y[1] - y[0]) / 2)
    extent = (x[0] - half[0], x[-1] + half[0], y[-1] - half[1], y[0] + half[1])
    axes.set_facecolor(_MISSING)
    heights = height[np.isfinite(height)]
    # A few pixels at the edge of visibility must not take the colours from all others.
    lowest, highest = np.percentile(heights, [0.2, 99.8]) if heights.size else (None, None)
    picture = axes.imshow(
        height, extent=extent, cmap="viridis", interpolation="nearest", vmin=lowest, vmax=highest
    )
    axes.figure.colorbar(picture, ax=axes, label="height (mm)", shrink=0.85)
    axes.axhline(0, color="white", lw=0.8, ls=":")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title="height; grey: no answer")


def _draw_cut(
    axes: Axes, height: NDArray[np.float32], truth: NDArray[np.float32], x: NDArray[np.float64]
) -> None:
    row = len(height) // 2
    axes.plot(x, truth[row], color="0.55", lw=2.5, label="truth")
    axes.plot(x, height[row], ".", color="tab:red", ms=3, label="reconstructed")
    lowest = np.nanmin(height[row], initial=0.0)
    axes.set(xlabel="x (mm)", ylabel="height (mm)", title="cut along the dotted line")
    axes.set_ylim(1.35 * lowest - 0.02, -0.12 * lowest + 0.02)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", ncols=2)
