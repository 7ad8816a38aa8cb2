"""The figure of dark and bright references, their errors, and the defects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from mirrorskin.io.calibration.types import DEAD, HOT, SATURATED, References
from mirrorskin.view.calibration.maps import draw_pixels, new_sheet
from mirrorskin.view.canvas import draw_classes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_KINDS = {"hot": HOT, "dead": DEAD, "saturated": SATURATED}
_COLOURS = {
    "sound": "0.9",
    "hot": "tab:red",
    "dead": "black",
    "saturated": "tab:orange",
    "several": "tab:purple",
}
_VISIBLE = 100  # dots in a row that can be told apart


def draw_references(references: References) -> Figure:
    """Draw both levels, their difference, both standard errors, and where the defects are."""
    figure = new_sheet(17, 8.2)
    axes = figure.subplots(2, 3)
    light = references.bright - references.dark
    draw_pixels(axes[0, 0], references.dark, "dark: without light", "counts")
    draw_pixels(axes[0, 1], references.bright, "bright: in full light", "counts")
    draw_pixels(axes[0, 2], light, "light: bright less dark", "counts")
    draw_pixels(axes[1, 0], references.dark_sigma, "standard error of dark", "counts", "magma")
    draw_pixels(axes[1, 1], references.bright_sigma, "standard error of bright", "counts", "magma")
    _draw_defects(axes[1, 2], references.defects)
    return figure


def _draw_defects(axes: Axes, defects: NDArray[np.uint8]) -> None:
    """Draw defects by colour, each large enough to be seen."""
    names = list(_COLOURS)
    kind = np.full(defects.shape, names.index("several"), np.uint8)
    for name, bits in ({"sound": 0} | _KINDS).items():
        kind[defects == bits] = names.index(name)
    size = max(1, max(defects.shape) // _VISIBLE)
    counts = np.bincount(kind.ravel(), minlength=len(names))
    labels = {number: f"{names[number]}: {count}" for number, count in enumerate(counts) if count}
    draw_classes(axes, maximum_filter(kind, size), list(_COLOURS.values()), labels)
    axes.set(title="defects\ndrawn larger than they are", xlabel="column (px)", ylabel="row (px)")
    if size == 1:
        axes.set_title("defects\n")
