"""Figures for people: heights as a whole, and cut across against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import MISSING, check_same_size, extent, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_MESH = 120  # samples of a surface along its longer side


def height_figure(
    results: Mapping[str, Result], truth: Truth, title: str, path: Path, *, surface: bool = False
) -> None:
    """Draw heights, and cuts across the middle against the truth, into a PNG.

    Parameters
    ----------
    results : mapping
        Names and results with ``height``, ``x`` and ``y``. The first and the last are drawn as a whole, all
        are cut.
    truth : Truth
        Of the same size.
    title : str
    path : Path
        PNG to write.
    surface : bool
        Draw a surface in space, as Fig. 5 (a) of the paper, instead of height by brightness, as its Fig. 6.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no heights or axes, or the file cannot be written.
    """
    save_figure(_draw(results, truth, surface), title, path)


def _draw(results: Mapping[str, Result], truth: Truth, surface: bool) -> Figure:
    for result in results.values():
        _check(result, truth)
    names = list(results)
    whole = dict.fromkeys([names[0], names[-1]])
    figure = new_figure(14, 4.6)
    grid = figure.add_gridspec(1, len(whole) + 1, width_ratios=[1] * len(whole) + [1.2])
    for place, name in enumerate(whole):
        if surface:
            _draw_surface(figure.add_subplot(grid[place], projection="3d"), name, *_heights(results[name]))
        else:
            _draw_map(figure.add_subplot(grid[place]), name, *_heights(results[name]))
    heights = {name: _heights(result)[0] for name, result in results.items()}
    _draw_cuts(figure.add_subplot(grid[-1]), heights, truth, _heights(results[names[0]])[1])
    return figure


def _check(result: Result, truth: Truth) -> None:
    height, x, y = result.height, result.x, result.y
    if height is None or x is None or y is None or min(height.shape) < 2:
        raise InputError("a figure needs heights and the pixel size, of 2 x 2 pixels at least")
    check_same_size(height.shape, truth.height)


def _heights(result: Result) -> tuple[NDArray[np.float32], Floats, Floats]:
    assert result.height is not None
    assert result.x is not None
    assert result.y is not None
    return result.height, result.x, result.y


def _draw_map(axes: Axes, name: str, height: NDArray[np.float32], x: Floats, y: Floats) -> None:
    axes.set_facecolor(MISSING)
    lowest, highest = _span(height)
    picture = axes.imshow(
        height, extent=extent(x, y), cmap="gray", interpolation="nearest", vmin=lowest, vmax=highest
    )
    axes.figure.colorbar(picture, ax=axes, label="height (mm)", shrink=0.85)
    axes.axhline(0, color="tab:red", lw=0.8, ls=":")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}; blue: no answer")


def _draw_surface(axes: Axes3D, name: str, height: NDArray[np.float32], x: Floats, y: Floats) -> None:
    step = max(1, max(height.shape) // _MESH)
    lowest, highest = _span(height)
    shown = np.where((height >= lowest) & (height <= highest), height, np.nan)[::step, ::step]
    across, up = np.meshgrid(x[::step], y[::step])
    axes.plot_surface(across, up, shown, cmap="viridis", rstride=1, cstride=1, linewidth=0, antialiased=True)
    axes.set_box_aspect((np.ptp(x), np.ptp(y), 0.45 * np.ptp(x)))
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name} (mm); holes: no answer")


def _span(height: NDArray[np.float32]) -> tuple[float, float]:
    """Return the lowest and highest height but for a few pixels at the edge of visibility."""
    heights = height[np.isfinite(height)]
    lowest, highest = np.percentile(heights, [0.2, 99.8]) if heights.size else (-1.0, 0.0)
    return float(lowest), float(highest)


def _draw_cuts(axes: Axes, heights: Mapping[str, NDArray[np.float32]], truth: Truth, x: Floats) -> None:
    row = len(truth.height) // 2
    axes.plot(x, truth.height[row], color="0.6", lw=3, label="truth")
    for number, (name, height) in enumerate(heights.items()):
        # The first lies on top, small enough to show the others round it.
        axes.plot(x, height[row], ".", ms=3 + number, zorder=9 - number, label=name)
    lowest = min(_span(height)[0] for height in heights.values())
    axes.set(xlabel="x (mm)", ylabel="height (mm)", title="cut across the middle")
    axes.set_ylim(1.35 * lowest - 0.02, -0.12 * lowest + 0.02)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", ncols=2, markerscale=2)
