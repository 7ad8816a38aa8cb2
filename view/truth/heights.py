"""Figures for people: heights as a whole, and cut across against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mirrorskin.io import Result, Truth
from mirrorskin.view.canvas import new_figure, save_figure
from mirrorskin.view.truth.relief import draw_cuts, draw_map, draw_surface, relief_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def height_figure(
    results: Mapping[str, Result], truth: Truth, title: str, path: Path, *, surface: bool = False
) -> None:
    """Draw heights, and cuts across the middle against the truth, into a PNG.

    Parameters
    ----------
    results : mapping
        Names and results with ``height``, ``x`` and ``y``. The first and the last are drawn as a whole, all
        are cut. What was ``filled`` is drawn apart, and what has no known offset lies as the truth does.
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
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    names = list(reliefs)
    whole = dict.fromkeys([names[0], names[-1]])
    figure = new_figure(14, 4.6)
    grid = figure.add_gridspec(1, len(whole) + 1, width_ratios=[1] * len(whole) + [1.2])
    for place, name in enumerate(whole):
        if surface:
            draw_surface(figure.add_subplot(grid[place], projection="3d"), name, reliefs[name])
        else:
            draw_map(figure.add_subplot(grid[place]), name, reliefs[name])
    draw_cuts(figure.add_subplot(grid[-1]), reliefs, truth)
    return figure
