"""The picture of heights: a lit surface from above, with a scale."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from mirrorskin.view.canvas import exceeded, explain_colours, round_length
from mirrorskin.view.colours import span
from mirrorskin.view.result.shade import shaded
from mirrorskin.view.result.sheet import SMALL, TEXT, Sheet, draw_map, entitle, lay_out, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mirrorskin.engine.metrology.sections import Section

_BAR = 0.3  # of the picture's width: the longest scale bar
_MARGIN = 0.05
_EDGE = 0.1  # of the picture's width: room for a letter


def draw_height(axes: Axes, sheet: Sheet, cut: Section | None = None) -> None:
    """Draw heights as a lit surface, with a scale bar, and where the section runs.

    Parameters
    ----------
    axes : Axes
    sheet : Sheet
        Of a result with heights.
    cut : Section, optional
        Drawn from A to B.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    height = sheet.result.height
    assert height is not None
    ends = span(height)
    draw_map(axes, sheet, shaded(height, sheet.filled, _pixel(sheet), ends), interpolation="antialiased")
    colours = ScalarMappable(Normalize(*_apart(*ends)), "viridis")
    explain_colours(axes, colours, f"{quantity(sheet)} (mm)", exceeded(height, *ends))
    if sheet.true_to_scale and sheet.unit == "mm" and height.size > 1:
        _draw_scale(axes, sheet)
    if cut is not None:
        _draw_line(axes, sheet, cut)
    lay_out(axes, sheet)
    entitle(axes, quantity(sheet).capitalize(), "; ".join(_notes(sheet)))


def quantity(sheet: Sheet) -> str:
    """Name what heights are: relative where nobody knows how high they lie."""
    unknown = sheet.result.offset_unknown
    return "relative height" if unknown is not None and unknown.size and unknown.all() else "height"


def _notes(sheet: Sheet) -> Iterator[str]:
    """Tell what colours mean, and what a level is worth."""
    result, filled = sheet.result, sheet.filled
    assert result.height is not None
    if filled.any():
        yield f"orange: filled ({percent(int(np.count_nonzero(filled)), filled.size)})"
    missing = int(np.count_nonzero(~np.isfinite(result.height)))
    if missing:
        yield f"blue: no answer ({percent(missing, filled.size)})"
    unknown = result.offset_unknown
    if unknown is not None and unknown.any():
        pieces = "each piece" if unknown.all() else f"{np.count_nonzero(unknown)} of {unknown.size} pieces"
        yield "mean 0" if unknown.size == 1 else f"{pieces} about its mean"


def _pixel(sheet: Sheet) -> tuple[float, float]:
    left, right, bottom, top = sheet.place
    return (right - left) / len(sheet.x), (top - bottom) / len(sheet.y)


def _apart(low: float, high: float) -> tuple[float, float]:
    """Part the ends of a scale that lie together."""
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def outlined(width: float) -> list[Any]:
    """Return what keeps black lines and letters readable on any colour."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground="white")]


def _draw_scale(axes: Axes, sheet: Sheet) -> None:
    """Draw a bar of a round length in the lower left corner."""
    left, right, bottom, top = sheet.place
    length = round_length(_BAR * (right - left))
    margin = _MARGIN * min(right - left, top - bottom)
    ends = [left + margin, left + margin + length]
    (bar,) = axes.plot(ends, [bottom + margin] * 2, color="black", lw=3, solid_capstyle="butt")
    bar.set_path_effects(outlined(5))
    axes.annotate(
        f"{length:g} mm",
        (sum(ends) / 2, bottom + margin),
        (0, 4),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=TEXT,
        path_effects=outlined(2.5),
    )


def _draw_line(axes: Axes, sheet: Sheet, cut: Section) -> None:
    """Draw the line of a section, and its ends A and B beyond it, or within where it ends at the edge."""
    (line,) = axes.plot(cut.x[[0, -1]], cut.y[[0, -1]], color="black", lw=1, ls=(0, (6, 3)))
    line.set_path_effects(outlined(2.5))
    left, right, _, top = sheet.place
    edge = _EDGE * (right - left)
    to_left = cut.x[0] <= cut.x[-1]
    for name, place, beyond in (("A", 0, to_left), ("B", -1, not to_left)):
        room = (cut.x[place] - left if beyond else right - cut.x[place]) > edge
        align = "right" if beyond == room else "left"
        above = top - cut.y[place] > edge
        axes.annotate(
            name,
            (float(cut.x[place]), float(cut.y[place])),
            (3 if align == "left" else -3, 3 if above else -3),
            textcoords="offset points",
            ha=align,
            va="bottom" if above else "top",
            fontsize=SMALL + 2,
            weight="bold",
            path_effects=outlined(2.5),
        )
