"""The figure of a gel: where on a ball light begins, and how far the stage gives way."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import numpy as np

from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.io.calibration.types import Gel
from mirrorskin.view.calibration.maps import AZIMUTHS, draw_azimuths, new_sheet, places_about

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

_BALL = 2.0  # radius of the ball in the figure, mm
_RADII = 2.0, 3.0, 5.0  # of the balls pressed into the gel, mm
_DEEPEST = 1.0  # mm
_FINE = 400
_OFF = 0.3  # of the wall's radius: how far off the axis the places lie of which more is told
_NEAR = 3.0  # the same where the wall is infinitely far, mm


def draw_gel(gel: Gel) -> Figure:
    """Draw where on a ball light begins, that by place and azimuth, and how far the stage gives way."""
    figure = new_sheet(17, 5.2)
    grid = figure.add_gridspec(1, 3)
    _draw_threshold(figure.add_subplot(grid[0]), gel)
    polar = cast("PolarAxes", figure.add_subplot(grid[1], projection="polar"))
    x0, y0 = gel.axis
    zeniths = {
        name: threshold_at(gel, x0 + x, y0 + y, AZIMUTHS)
        for name, (x, y) in places_about(_OFF / gel.curvature if gel.curvature else _NEAR).items()
    }
    draw_azimuths(polar, zeniths, "zenith at which light begins, by azimuth")
    _draw_give(figure.add_subplot(grid[2]), gel)
    return figure


def _draw_threshold(axes: Axes, gel: Gel) -> None:
    """Draw the upper side of a ball: dark where it is too flat to show light."""
    angle = np.linspace(-math.radians(60), math.radians(60), _FINE)
    lit = np.abs(angle) >= gel.threshold
    x, z = _BALL * np.sin(angle), _BALL * (np.cos(angle) - 1)
    axes.plot(x, np.where(lit, z, np.nan), color="tab:orange", lw=4, label="light")
    axes.plot(x, np.where(lit, np.nan, z), color="0.25", lw=4, label="too flat: dark")
    for side in (-1, 1):
        across, up = side * math.sin(gel.threshold), math.cos(gel.threshold)
        foot = _BALL * across, _BALL * (up - 1)
        tip = foot[0] + 0.5 * across, foot[1] + 0.5 * up
        axes.annotate("", tip, foot, arrowprops={"arrowstyle": "-|>", "color": "tab:blue", "lw": 1.5})
        axes.plot([foot[0]] * 2, [foot[1], foot[1] + 0.5], color="0.6", lw=1, ls=":")
    told = _told(math.degrees(gel.threshold), math.degrees(gel.sigma.get("threshold", math.nan)), "°")
    axes.set(
        xlabel="x (mm)",
        ylabel="height above the top (mm)",
        aspect="equal",
        ylim=(-1.15, 0.75),
        title=f"a ball of {2 * _BALL:g} mm, on the wall's axis:\nlight begins at a zenith of {told}",
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", frameon=False)


def _draw_give(axes: Axes, gel: Gel) -> None:
    """Draw how far the stage gives way under balls (Hertz, of a gel that keeps its volume)."""
    depth = np.linspace(0, _DEEPEST, _FINE)
    for radius in _RADII:
        force = 16 / 9 * math.sqrt(radius) * depth**1.5  # over Young's modulus, mm^2
        axes.plot(depth, 1000 * gel.compliance * force, lw=2, label=f"ball of {2 * radius:g} mm")
    told = _told(gel.compliance, gel.sigma.get("compliance", math.nan), " per mm")
    axes.set(
        xlabel="depth in the gel (mm)",
        ylabel="the stage gives way by (µm)",
        xlim=(0, _DEEPEST),
        title=f"flexure times modulus {told}\nleft on the ball: {1000 * gel.error:.3g} µm RMS",
    )
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", frameon=False)


def _told(value: float, sigma: float, unit: str) -> str:
    """Write a value with its standard error, where that is known."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.4g}{unit}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}{unit}"
