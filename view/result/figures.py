"""Figures of one result: a figure for each map, or all on one page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.summary import summarise
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import unknown_argument
from mirrorskin.io.base.findings import warnings_in
from mirrorskin.view.drawing.canvas import figure_pixels, new_figure
from mirrorskin.view.result.maps import draw_declared, draw_height
from mirrorskin.view.result.section import draw_histogram, draw_section
from mirrorskin.view.result.sheet import BOX, TEXT, Sheet, sheet_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mirrorskin.engine.metrology import Section

Ends = tuple[tuple[float, float], tuple[float, float]]
"""Ends of a section, x and y, mm."""

_GRAPHS = "section", "histogram"  # panels that are not maps
_IN_A_ROW = 3  # panels
# Inches: width and largest height of a map; margins of a panel; margin and gap of the page.
_WIDTH, _HIGHEST = 3.5, 5.2
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.95, 1.75, 0.6, 0.55
_MARGIN, _GAP = 0.15, 0.2
_NAME = 13  # points
_DOUBTFUL = "#b3261e"  # colour of warnings
_LETTER, _LINE = 0.65 / 72, 1.45 / 72  # inches per point of the font size: width of a letter, line spacing


@dataclass(frozen=True, slots=True)
class _Panel:
    """A panel: its name, the function that draws it, and whether the overview includes it."""

    name: str
    draw: Callable[[Axes], None]
    overview: bool = True


def figures_of(
    result: Result, *, name: str, section: Ends | None = None, maps: Sequence[str] | None = None
) -> dict[str, Figure]:
    """Draw a figure for each map of a result.

    Parameters
    ----------
    result : Result
        Maps of one turn. Without a pixel size, axes are in pixels.
    name : str
        Name of the result in titles.
    section : ((float, float), (float, float)), optional
        Ends of the section, x and y, mm; by default the row through the apex.
    maps : sequence of str, optional
        Names of maps, ``"section"`` or ``"histogram"``; by default those of the overview.

    Returns
    -------
    dict of str to Figure
        By name: heights, section, histogram, then the other maps in the order of the result.

    Raises
    ------
    mirrorskin.io.InputError
        Matplotlib is not installed, the result has several turns or none of the requested maps, or a section
        cannot be placed.
    """
    return dict(each_figure(result, name=name, section=section, maps=maps))


def each_figure(
    result: Result, *, name: str, section: Ends | None = None, maps: Sequence[str] | None = None
) -> Iterator[tuple[str, Figure]]:
    """Yield the name and the figure of each map, each only when it is needed; see `figures_of`."""
    sheet = sheet_of(result)
    for panel in _chosen(sheet, name, section, maps):
        yield panel.name, _figure(sheet, [panel], name)


def overview(
    result: Result, *, name: str, section: Ends | None = None, maps: Sequence[str] | None = None
) -> Figure:
    """Draw all panels of a result, or some, on one page; see ``figures_of``."""
    sheet = sheet_of(result)
    return _figure(sheet, _chosen(sheet, name, section, maps), name)


def pixels_of(figure: Figure, width_px: int) -> NDArray[np.uint8]:
    """Return a figure with a width in pixels, (H, W, 3): red, green and blue."""
    return figure_pixels(figure, width_px / figure.get_figwidth())


def _chosen(sheet: Sheet, name: str, section: Ends | None, maps: Sequence[str] | None) -> list[_Panel]:
    """Return the requested panels, by default those of the overview; InputError if one does not exist."""
    panels = list(_panels_of(sheet, section))
    has = list(dict.fromkeys(panel.name for panel in panels))
    lacking = [name for name in maps or () if name not in has]
    if not has:
        raise InputError(f"{name} has no map to draw: 'mirrorskin export' writes all it has into an .npz")
    if lacking:
        raise InputError(unknown_argument(name, lacking[0], has, "picture"))
    if section is not None and "section" not in has:
        raise InputError(f"{name} has no heights to cut: leave the section out")
    return [panel for panel in panels if (panel.overview if maps is None else panel.name in maps)]


def _panels_of(sheet: Sheet, section: Ends | None) -> Iterator[_Panel]:
    """Yield the panels of a result: heights, their section and histogram, and all other maps."""
    result = sheet.result
    height, profile = result.name_of("height"), _cut(sheet, section)
    if height is not None:
        yield _Panel(height, partial(draw_height, sheet=sheet, profile=profile))
    if profile is not None:
        yield _Panel("section", partial(draw_section, sheet=sheet, profile=profile))
    if height is not None:
        yield _Panel("histogram", partial(draw_histogram, sheet=sheet))
    for name in result.maps():
        declared = result.declaration(name)
        if name != height:
            overview = declared.overview and declared.included_in not in result
            yield _Panel(name, partial(draw_declared, sheet=sheet, name=name), overview)


def _cut(sheet: Sheet, ends: Ends | None) -> Section | None:
    """Return a section of the heights, if there are any, with more than one sample."""
    from mirrorskin.engine.metrology import section

    height = sheet.result.height
    if height is None or not np.isfinite(height).any():
        return None
    profile = section(sheet.result, *(ends or ()))
    if not np.isfinite(profile.height).any():
        raise InputError("no height is known along the section: choose other points, or leave it out")
    return profile if len(profile.distance) > 1 else None


def _figure(sheet: Sheet, panels: Sequence[_Panel], name: str) -> Figure:
    """Draw panels in rows, with the height that the maps need, under one title."""
    rows = math.ceil(len(panels) / _IN_A_ROW)
    columns = math.ceil(len(panels) / rows)
    maps = any(panel.name not in _GRAPHS for panel in panels)
    high = min(max(_WIDTH / sheet.proportion if maps else 0.0, BOX * _WIDTH), _HIGHEST)
    wide, tall = _LEFT + _WIDTH + _RIGHT, _BELOW + high + _ABOVE
    warnings = [f"Warning: {text}" for text in warnings_in(sheet.result.process)]
    lines: list[tuple[str, float, dict[str, Any]]] = [(name, _NAME, {"weight": "bold"})]
    lines += [(str(summarise(sheet.result)), TEXT, {"color": "0.3"})]
    lines += [(text, TEXT, {"color": _DOUBTFUL}) for text in warnings]
    words = [_wrapped(text, wide * columns, size) for text, size, _ in lines]
    head = _MARGIN + sum(height for _, height in words) + _GAP
    size = wide * columns, tall * rows + head
    figure = new_figure(*size)
    figure.set_layout_engine("none")  # all panels have one size, so their positions are computed
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        corner = column * wide + _LEFT, (rows - 1 - row) * tall + _BELOW
        place = corner[0] / size[0], corner[1] / size[1], _WIDTH / size[0], high / size[1]
        panel.draw(figure.add_axes(place))
    side, top = _MARGIN / size[0], 1 - _MARGIN / size[1]
    for (text, height), (_, points, style) in zip(words, lines, strict=True):
        figure.text(side, top, text, fontsize=points, va="top", parse_math=False, **style)
        top -= height / size[1]
    return figure


def _wrapped(text: str, width: float, size: float) -> tuple[str, float]:
    """Break a text (size in points) into lines that fit a width; return them and their height in inches."""
    lines = wrap(text, int((width - 2 * _MARGIN) / (_LETTER * size)))
    return "\n".join(lines), _LINE * size * len(lines)
