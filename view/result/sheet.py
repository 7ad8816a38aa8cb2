"""Page coordinates of a result's maps, in millimetres or in pixels, and titles and axes of panels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result, pixel_axes, select_turn
from mirrorskin.io.result import map_shape
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import Extent, draw_image, extent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

SMALL, TEXT, TITLE = 9, 10.5, 12.5
"""Sizes of letters, points."""
BOX = 0.62
"""Height over width of a panel that is no map."""

_LONGEST = 8  # times as long as wide, and a picture is no longer drawn true to scale


@dataclass(frozen=True, slots=True)
class Sheet:
    """The maps of a result of one turn, and where its pixels are.

    Attributes
    ----------
    result : Result
    x, y : ndarray, (W,) and (H,), float64
        Pixel centres from the picture's centre.
    unit : {"mm", "px"}
        Of ``x`` and ``y``: pixels where their size is not known. That of heights is always mm.
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
        """How many times as wide as it is high the picture is."""
        left, right, bottom, top = self.place
        return (right - left) / (top - bottom)

    @property
    def true_to_scale(self) -> bool:
        """Whether pictures are drawn as wide and high as they are: not a single row."""
        return 1 / _LONGEST <= self.proportion <= _LONGEST

    @property
    def filled(self) -> NDArray[np.bool_]:
        """Where the height was not measured but filled, (H, W)."""
        assert self.result.height is not None
        known: NDArray[np.bool_] = np.isfinite(self.result.height)
        return np.zeros_like(known) if self.result.filled is None else known & (self.result.filled > 0)


def sheet_of(result: Result) -> Sheet:
    """Lay out a result."""
    result = select_turn(result, None)
    if result.x is not None and result.y is not None:
        return Sheet(result, result.x, result.y, "mm")
    rows, columns = map_shape(result)
    return Sheet(result, *pixel_axes((rows, columns), (1.0, 1.0)), "px")


def draw_map(axes: Axes, sheet: Sheet, values: NDArray[Any], label: str = "", **colours: Any) -> AxesImage:
    """Draw a map at its place; see ``draw_image``."""
    picture = draw_image(axes, values, sheet.place, label, **colours)
    lay_out(axes, sheet)
    return picture


def lay_out(axes: Axes, sheet: Sheet) -> None:
    """Give a map its axes and proportions."""
    axes.set_aspect("equal" if sheet.true_to_scale else "auto")
    if not sheet.true_to_scale:
        axes.set_box_aspect(0.5 if sheet.proportion > 1 else 2.0)
    for name, along, axis in (("x", sheet.x, axes.xaxis), ("y", sheet.y, axes.yaxis)):
        axis.set_label_text(f"{name} ({sheet.unit})", fontsize=TEXT)
        if len(along) == 1:
            axis.set_ticks([])
            axis.set_label_text(f"{name} = {along[0]:.3g} {sheet.unit}")
    for one in (axes, *axes.child_axes):
        one.tick_params(labelsize=SMALL)
        one.yaxis.label.set_fontsize(TEXT)


def entitle(axes: Axes, title: str, note: str = "") -> None:
    """Write a title above a panel, and a note in smaller letters below it."""
    axes.set_title(title, loc="left", fontsize=TITLE, weight="bold", pad=18, parse_math=False)
    axes.set_anchor("NW")  # the titles of a row in line
    axes.annotate(
        note,
        (0, 1),
        (0, 5),
        "axes fraction",
        textcoords="offset points",
        fontsize=SMALL,
        color="0.3",
        parse_math=False,
    )


def percent(part: int, whole: int) -> str:
    """Write a share, as in "12.3 %"; one that is not nothing never looks like nothing."""
    share = 100 * part / whole
    return "< 0.1 %" if 0 < share < 0.05 else f"{share:.1f} %"
