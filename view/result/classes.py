"""Pictures of classes: where edges and contact are, and what became of each pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.view.canvas import draw_classes
from mirrorskin.view.colours import MISSING
from mirrorskin.view.result.sheet import SMALL, Sheet, entitle, lay_out, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ONSET = "invalid input", "onset", "never light", "light at start"
_RELEASE = "invalid input", "release", "dark at start", "light to the end"
_UNKNOWN = "unknown number"
_STATUS_COLOURS = "#d55e00", "#009e73", "0.25", "#f0e442", "white"
_EDGE_COLOURS = "0.85", "black", MISSING


def draw_edges(axes: Axes, sheet: Sheet) -> None:
    """Draw edges, and where the sheet was in contact in every frame, if that is told."""
    edges, contact = sheet.result.edges, sheet.result.contact
    assert edges is not None
    classes = np.zeros(edges.shape, np.uint8)
    if contact is not None:
        classes[contact == 0] = 2
    classes[edges > 0] = 1
    names = ("no edge" if contact is None else "in contact", "edge", "no lasting contact")
    _draw(axes, sheet, classes, _EDGE_COLOURS, names)
    entitle(axes, "Edges" if contact is None else "Edges and contact")


def draw_status(axes: Axes, sheet: Sheet) -> None:
    """Draw what became of each pixel in a press or a release."""
    status = sheet.result.status
    assert status is not None
    released = sheet.result.process.get("event") == "release"
    names = *(_RELEASE if released else _ONSET), _UNKNOWN
    classes = np.minimum(status, names.index(_UNKNOWN)).astype(np.uint8)
    _draw(axes, sheet, classes, _STATUS_COLOURS, names)
    entitle(axes, "Status")


def _draw(
    axes: Axes, sheet: Sheet, classes: NDArray[np.uint8], colours: tuple[str, ...], names: tuple[str, ...]
) -> None:
    """Draw classes, and tell of each how many per cent of the pixels it has."""
    counts = np.bincount(classes.ravel(), minlength=len(names))
    labels = {
        number: f"{name}\n{percent(int(counts[number]), classes.size)}"
        for number, name in enumerate(names)
        if counts[number]
    }
    draw_classes(axes, classes, colours, labels, sheet.place, "antialiased")
    legend = axes.get_legend()
    assert legend is not None
    for text in legend.get_texts():
        text.set_fontsize(SMALL)
    lay_out(axes, sheet)
