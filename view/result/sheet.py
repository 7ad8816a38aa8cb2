"""Coordinates of the maps of a result, in millimetres or pixels, and titles and axes of panels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result, select_turn
from mirrorskin.io.base.types import Floats, axes_with_unit
from mirrorskin.io.base.units import numbers_with_unit
from mirrorskin.io.model.maps import Map
from mirrorskin.io.model.result import map_shape
from mirrorskin.view.drawing.canvas import Extent, draw_image, extent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

SMALL, TEXT, TITLE = 9, 10.5, 12.5
"""Font sizes, points."""
BOX = 0.62
"""Height over width of a panel that is not a map."""

_LONGEST = 8  # aspect ratio above which a picture is not drawn to scale


@dataclass(frozen=True, slots=True)
class Sheet:
    """The maps of one turn of a result, and the positions of its pixels.

    Attributes
    ----------
    result : Result
    x, y : ndarray, (W,) and (H,), float64
        Pixel centres from the picture's centre.
    unit : {"mm", "px"}
        Unit of ``x`` and ``y``: pixels if their size is unknown.
    """

    result: Result
    x: Floats
    y: Floats
    unit: str

    @property
    def place(self) -> Extent:
        """Outer edges of the pixels."""
        return extent(self.x, self.y)

    @property
    def proportion(self) -> float:
        """Width over height of the picture."""
        left, right, bottom, top = self.place
        return (right - left) / (top - bottom)

    @property
    def true_to_scale(self) -> bool:
        """Whether the picture is drawn to scale, which a single row is not."""
        return 1 / _LONGEST <= self.proportion <= _LONGEST

    @property
    def filled(self) -> NDArray[np.bool_]:
        """Where the height was filled, not measured, (H, W)."""
        assert self.result.height is not None
        finite: NDArray[np.bool_] = np.isfinite(self.result.height)
        return np.zeros_like(finite) if self.result.filled is None else finite & (self.result.filled > 0)

    @property
    def of_height(self) -> Map:
        """Declaration of the heights, which have its ``figure_unit`` in figures."""
        return self.result.declaration(self.result.name_of("height") or "height")

    def height_text(self, height: float) -> str:
        """Return a height, given in mm, as text in the unit of figures."""
        unit, value = self.of_height.figure_unit, self.of_height.figure_scale * height
        if unit != "mm":
            return f"{value:.4g} {unit}"
        (text,), unit = numbers_with_unit([value], unit)
        return f"{text} {unit}"


def sheet_of(result: Result) -> Sheet:
    """Return the coordinates of a result."""
    result = select_turn(result, None)
    if result.x is not None and result.y is not None:
        return Sheet(result, result.x, result.y, "mm")
    rows, columns = map_shape(result)
    return Sheet(result, *axes_with_unit((rows, columns), None))


def draw_map(axes: Axes, sheet: Sheet, values: NDArray[Any], label: str = "", **colours: Any) -> AxesImage:
    """Draw a map at its coordinates; see ``draw_image``."""
    picture = draw_image(axes, values, sheet.place, label, **colours)
    lay_out(axes, sheet)
    return picture


def lay_out(axes: Axes, sheet: Sheet) -> None:
    """Set the axes and proportions of a map."""
    axes.set_aspect("equal" if sheet.true_to_scale else "auto")
    if not sheet.true_to_scale:
        axes.set_box_aspect(0.5 if sheet.proportion > 1 else 2.0)
    for name, along, axis in (("x", sheet.x, axes.xaxis), ("y", sheet.y, axes.yaxis)):
        axis.set_label_text(f"{name} ({sheet.unit})", fontsize=TEXT)
        if len(along) == 1:
            axis.set_ticks([])
            axis.set_label_text(f"{name} = {along[0]:.3g} {sheet.unit}")
    for scales in (axes, *axes.child_axes):
        scales.tick_params(labelsize=SMALL)
        scales.yaxis.label.set_fontsize(TEXT)


def entitle(axes: Axes, title: str, note: str = "", top: float = 1.0) -> None:
    """Add a title to a panel, and a note in smaller letters below it, above a height of the panel."""
    # Without y, Matplotlib measures all tick labels to place the title.
    axes.set_title(title, loc="left", y=top, fontsize=TITLE, weight="bold", pad=18, parse_math=False)
    axes.set_anchor("NW")  # aligns the titles of a row
    axes.annotate(
        note,
        (0, top),
        (0, 5),
        "axes fraction",
        textcoords="offset points",
        fontsize=SMALL,
        color="0.3",
        parse_math=False,
    )


def percent(part: int, whole: int) -> str:
    """Return a share as text, as in "12.3 %"; a share above 0 is never printed as 0."""
    percentage = 100 * part / whole
    return "< 0.1 %" if 0 < percentage < 0.05 else f"{percentage:.1f} %"
