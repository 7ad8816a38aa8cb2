"""The figure of one surface: in space, from above, against the truth, and cut."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.io import Result, Truth
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.colours import FILLED
from mirrorskin.view.truth.relief import (
    Relief,
    dots_on_row,
    draw_cuts,
    draw_map,
    draw_surface,
    relief_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WORST = 98  # per cent of the errors that the colours tell apart
_MICROMETRES = 1e3  # in a millimetre


def surface_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw a surface, and how it came about, into a PNG.

    The last result is drawn in space, as Fig. 10 (b) of the paper, by brightness, and as what is left when
    the truth is taken away; all are cut across the middle, and below lies what is left of these cuts. What
    was filled is orange or open; what nobody answered stays empty.

    Parameters
    ----------
    results : mapping
        Names and results with ``height``, ``x`` and ``y``. A component of unknown offset is moved to the
        truth's mean height.
    truth : Truth
        Of the same size.
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no heights or axes, or the file cannot be written.
    """
    save_figure(_draw(results, truth), title, path)


def _draw(results: Mapping[str, Result], truth: Truth) -> Figure:
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    last = list(reliefs)[-1]
    figure = new_figure(13, 10)
    grid = figure.add_gridspec(2, 2)
    draw_surface(figure.add_subplot(grid[0, 0], projection="3d"), last, reliefs[last])
    draw_map(figure.add_subplot(grid[0, 1]), last, reliefs[last])
    _draw_errors(figure.add_subplot(grid[1, 0]), reliefs[last], truth)
    cuts = grid[1, 1].subgridspec(2, 1, height_ratios=[2, 1])
    above = figure.add_subplot(cuts[0])
    draw_cuts(above, reliefs, truth)
    above.tick_params(labelbottom=False)
    above.set_xlabel("")
    _draw_errors_on_row(figure.add_subplot(cuts[1], sharex=above), reliefs, truth)
    return figure


def _draw_errors(axes: Axes, relief: Relief, truth: Truth) -> None:
    error = _MICROMETRES * (relief.height - truth.height)
    known = error[np.isfinite(error)]
    worst = float(np.percentile(np.abs(known), _WORST)) if known.size else 1.0
    told = f"RMS {np.sqrt(np.mean(known**2)):.1f} \N{MICRO SIGN}m" if known.size else "no pixel answered"
    place, label = extent(relief.x, relief.y), "height - truth (\N{MICRO SIGN}m)"
    draw_image(axes, error, place, label, cmap="RdBu_r", vmin=-worst, vmax=worst)
    if relief.filled.any():
        marks = relief.filled.astype(float)
        axes.contour(relief.x, relief.y, marks, levels=[0.5], colors=FILLED, linewidths=1)
        told += ", orange: round what was filled"
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"error: {told}\nblue: no answer")


def _draw_errors_on_row(axes: Axes, reliefs: Mapping[str, Relief], truth: Truth) -> None:
    row = len(truth.height) // 2
    errors = {
        name: _MICROMETRES * (relief.height[row] - truth.height[row]) for name, relief in reliefs.items()
    }
    axes.axhline(0, color="0.6", lw=3)
    dots_on_row(axes, errors, reliefs)
    last = np.abs(list(errors.values())[-1])
    worst = np.percentile(last[np.isfinite(last)], _WORST) if np.isfinite(last).any() else 1.0
    axes.set_ylim(-2.5 * worst - 1, 2.5 * worst + 1)
    axes.set(xlabel="x (mm)", ylabel="error (\N{MICRO SIGN}m)")
    axes.grid(alpha=0.3)
