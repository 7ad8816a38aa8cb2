"""Pictures of plain numbers: expected errors, and the light's swing as the body goes round."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import exceeded
from mirrorskin.view.result.sheet import Sheet, draw_map, entitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e3  # in a millimetre
_SHOWN = 1, 99  # per cent of the values that the colours tell apart
_DECADES = 30.0  # times between these, from which on colours are of the logarithm


def draw_height_sigma(axes: Axes, sheet: Sheet) -> None:
    """Draw the standard deviation that is expected of heights, in micrometres."""
    assert sheet.result.height_sigma is not None
    sigma = _MICROMETRES * sheet.result.height_sigma.astype(np.float64)
    _draw(axes, sheet, sigma, "Expected error of heights", "standard deviation", "\N{MICRO SIGN}m", "magma")


def draw_normal_sigma(axes: Axes, sheet: Sheet) -> None:
    """Draw the angular error that is expected of normals, in degrees."""
    assert sheet.result.normal_sigma is not None
    sigma = np.degrees(sheet.result.normal_sigma.astype(np.float64))
    _draw(axes, sheet, sigma, "Expected error of normals", "RMS angle", "deg", "magma")


def draw_modulation(axes: Axes, sheet: Sheet) -> None:
    """Draw how far the light swings in a turn, in counts."""
    assert sheet.result.modulation is not None
    _draw(
        axes,
        sheet,
        sheet.result.modulation.astype(np.float64),
        "Modulation",
        "swing of the light",
        "counts",
        "viridis",
    )


def draw_azimuth(axes: Axes, sheet: Sheet) -> None:
    """Draw the azimuth of the normal, in degrees, in colours that go round as it does."""
    assert sheet.result.azimuth is not None
    azimuth = np.degrees(np.angle(np.exp(1j * sheet.result.azimuth.astype(np.float64))))
    draw_map(axes, sheet, azimuth, "azimuth (deg)", cmap="twilight", vmin=-180, vmax=180)
    axes.child_axes[0].set_yticks(range(-180, 181, 90))
    entitle(axes, "Azimuth of the normal", "0: to the right; 90: up")


def _draw(
    axes: Axes, sheet: Sheet, values: Floats, title: str, quantity: str, unit: str, colours: str
) -> None:
    """Draw numbers above zero; where they span decades, by their logarithm."""
    from matplotlib.colors import LogNorm, Normalize

    values = np.where(np.isfinite(values), values, np.nan)
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(known, _SHOWN)) if known.size else (0.0, 1.0)
    scale = LogNorm if low > 0 and high > _DECADES * low else Normalize
    if not high > low:
        low, high = low - 0.5, high + 0.5
    beyond = exceeded(known, low, high)
    label = f"{quantity} ({unit})"
    draw_map(axes, sheet, values, label, extend=beyond, cmap=colours, norm=scale(low, high))
    missing = "; blue: no answer" if 0 < known.size < values.size else ""
    entitle(axes, title, f"median {np.median(known):.3g} {unit}{missing}" if known.size else "no answer")
