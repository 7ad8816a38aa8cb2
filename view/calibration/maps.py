"""What the figures of a calibration share: a map over the camera's pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, exceeded, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

AZIMUTHS = np.linspace(0, math.tau, 181)
"""Of the normal, radians."""

_SHOWN = 1.0, 99.0  # per cent of the values that the colours tell apart


def new_sheet(width: float, height: float) -> Figure:
    """Return an empty figure, of so many inches, on which maps keep their colour bars beside them."""
    figure = new_figure(width, height)
    figure.set_layout_engine("compressed")
    return figure


def draw_pixels(
    axes: Axes, values: ArrayLike, title: str, label: str, colours: str = "viridis", even: bool = False
) -> None:
    """Draw a map of all pixels, with its colours explained.

    Parameters
    ----------
    axes : Axes
    values : array_like, (H, W)
        NaN without an answer.
    title, label : str
        What it is, and the unit beside the colours.
    colours : str
        Name of a colour map.
    even : bool
        Whether the colours go as far below 0 as above.
    """
    shown = np.asarray(values, np.float64)
    known = shown[np.isfinite(shown)]
    low, high = (float(v) for v in np.percentile(known, _SHOWN)) if known.size else (0.0, 1.0)
    if even:
        high = max(abs(low), abs(high))
        low = -high
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # one value is no range
        low, high = low - 0.5, high + 0.5
    beyond = exceeded(known, low, high)
    draw_image(axes, shown, label=label, extend=beyond, cmap=colours, vmin=low, vmax=high)
    told = f"median {np.median(known):.4g} {label.split()[0]}" if known.size else "no answer"
    blue = "; blue: no answer" if 0 < known.size < shown.size else ""
    axes.set(title=f"{title}\n{told}{blue}", xlabel="column (px)", ylabel="row (px)")


def draw_azimuths(axes: PolarAxes, zeniths: Mapping[str, Floats], title: str) -> None:
    """Draw zeniths over all azimuths of the normal.

    Parameters
    ----------
    axes : PolarAxes
    zeniths : mapping
        Names, and values at `AZIMUTHS`, (n,), radians; NaN without an answer.
    title : str
    """
    for name, values in zeniths.items():
        axes.plot(AZIMUTHS, np.degrees(values), lw=1.8, label=name)
    axes.set_rmin(0)
    axes.set_yticks([tick for tick in axes.get_yticks() if tick > 0][1::2])
    axes.set_rlabel_position(22)
    axes.yaxis.set_major_formatter("{x:g}°")
    axes.set_title(title)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), frameon=False, ncols=2)


def places_about(reach: float) -> dict[str, tuple[float, float]]:
    """Return the axis and places so far from it, x and y in mm, by their names."""
    return {
        "on the axis": (0.0, 0.0),
        f"{reach:.2g} mm to the right": (reach, 0.0),
        f"{reach:.2g} mm up": (0.0, reach),
        f"{reach:.2g} mm to the left": (-reach, 0.0),
    }
