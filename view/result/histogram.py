"""The picture of how often each height is there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.view.canvas import BESIDE
from mirrorskin.view.colours import FILLED
from mirrorskin.view.result.height import quantity
from mirrorskin.view.result.sheet import BOX, SMALL, TEXT, Sheet, entitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS = 60


def draw_histogram(axes: Axes, sheet: Sheet) -> None:
    """Draw how many pixels have a height, those that were filled on top of those that were measured."""
    height = sheet.result.height
    assert height is not None
    parts = [height[np.isfinite(height) & (sheet.filled == filled)] for filled in (False, True)]
    known = np.concatenate(parts)
    bins = np.histogram_bin_edges(known, _BINS)
    counts = [np.histogram(part, bins)[0] for part in parts]
    names = ("measured", "tab:blue"), ("filled", FILLED)
    below = np.zeros(_BINS)
    for count, (name, colour) in zip(counts, names, strict=True):
        if count.any():
            axes.stairs(below + count, bins, baseline=below, fill=True, color=colour, label=name)
        below = below + count
    axes.set_xlabel(f"{quantity(sheet)} (mm)", fontsize=TEXT)
    axes.set_ylabel("pixels", fontsize=TEXT)
    axes.tick_params(labelsize=SMALL)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_box_aspect(BOX)
    if known.size:
        axes.legend(fontsize=SMALL, **BESIDE)
    sigma = sheet.result.height_sigma
    told = [f"median {np.median(known):.3f} mm"] if known.size else ["no answer"]
    if sigma is not None and np.isfinite(sigma).any():
        told.append(f"median expected error {1e3 * np.nanmedian(sigma):.3g} \N{MICRO SIGN}m")
    entitle(axes, "Distribution of heights", "; ".join(told))
