"""Figures of the response of a wall and of a gel, with their uncertainties."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from mirrorskin.engine.calibration.wall_response import threshold_zenith
from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.engine.rotation.response import shade
from mirrorskin.io import Gel, Stiffness, WallResponse
from mirrorskin.io.base.types import Floats
from mirrorskin.view.drawing.canvas import draw_parameter, explain_colours, new_sheet
from mirrorskin.view.drawing.colours import DIVERGING, ERROR, MISSING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

AZIMUTHS = np.linspace(0, math.tau, 181)  # of the normal, radians


def _draw_by_azimuth(
    axes: PolarAxes, zenith_at: Callable[[float, float], Floats], axis: Sequence[float], away: float
) -> None:
    """Draw zeniths, radians, over the azimuth of the normal: on the wall's axis and ``away`` mm from it."""
    x0, y0 = axis
    for name, x, y in (
        ("on the axis", 0.0, 0.0),
        (f"{away:.2g} mm to the right", away, 0.0),
        (f"{away:.2g} mm up", 0.0, away),
        (f"{away:.2g} mm to the left", -away, 0.0),
    ):
        axes.plot(AZIMUTHS, np.degrees(zenith_at(x0 + x, y0 + y)), lw=1.8, label=name)
    axes.set_rmin(0)
    axes.set_yticks([tick for tick in axes.get_yticks() if tick > 0][1::2])
    axes.set_rlabel_position(22)
    axes.yaxis.set_major_formatter("{x:g}°")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), frameon=False, ncols=2)


_FINE = 300
_NAMED = 30  # largest number of parameters whose names fit
_HALF = 0.5  # of full brightness
_OFF_AXIS = 0.3  # of the radius: distance of the other points from the axis


def draw_response(response: WallResponse) -> Figure:
    """Draw the response of a wall, and its errors.

    Top: the curve of a graded wall or the section of a uniform one, the zenith of half brightness
    by azimuth, the shading. Bottom: the errors of zenith and azimuth, and the correlation of the
    errors of the parameters.
    """
    figure = new_sheet(17, 10)
    grid = figure.add_gridspec(2, 3)
    (_draw_curve if response.pattern == "graded" else _draw_section)(figure.add_subplot(grid[0, 0]), response)
    polar = cast("PolarAxes", figure.add_subplot(grid[0, 1], projection="polar"))
    half = _HALF * (1.0 if response.pattern == "graded" else float(response.curve[0]))
    _draw_by_azimuth(
        polar,
        lambda x, y: threshold_zenith(response, x, y, AZIMUTHS, half),
        response.axis,
        _OFF_AXIS * response.radius,
    )
    polar.set_title("zenith of half brightness, by azimuth")
    _draw_shade(figure.add_subplot(grid[0, 2]), response)
    zenith, azimuth = (figure.add_subplot(grid[1, column]) for column in range(2))
    draw_parameter(zenith, response, "zenith_sigma", ERROR)
    draw_parameter(azimuth, response, "azimuth_sigma", ERROR)
    _draw_correlation(figure.add_subplot(grid[1, 2]), response)
    return figure


def _central_zenith(q: Floats | float) -> Floats:
    """Return the zenith of a mirror on the axis that shows the wall at q, degrees."""
    return np.asarray(np.degrees(math.pi / 4 - np.arctan(q)))


def _draw_curve(axes: Axes, response: WallResponse) -> None:
    """Draw brightness, and its change per degree, against the zenith of a mirror on the axis."""
    q = np.linspace(*response.reach, _FINE)
    zenith, light = _central_zenith(q), np.polynomial.polynomial.polyval(q, response.curve)
    axes.plot(zenith, light, color="tab:blue", lw=2)
    axes.set(
        xlabel="zenith of a mirror on the axis (deg)",
        title=f"response, known from {zenith.min():.1f}° to {zenith.max():.1f}°",
        xlim=(0, 50),
    )
    axes.set_ylabel("light (share of full light)", color="tab:blue")
    axes.axvspan(0, zenith.min(), color=MISSING, alpha=0.5, lw=0)
    axes.axvspan(zenith.max(), 50, color=MISSING, alpha=0.5, lw=0)
    axes.grid(alpha=0.3)
    slope = axes.twinx()
    steep = 100 * np.gradient(light, zenith)
    slope.plot(zenith, steep, color="tab:orange", lw=1.5, ls="--")
    slope.set_ylim(1.15 * min(0.0, float(steep.min())), 1.15 * max(0.01, float(steep.max())))
    slope.set_ylabel("slope (% of full light per deg)", color="tab:orange")


def _draw_section(axes: Axes, response: WallResponse) -> None:
    """Draw a cross-section of the body, and the rays to the ends of the calibrated range."""
    radius, rim = response.radius, response.rim
    for side in (-1, 1):
        axes.plot([side * radius] * 2, [0, rim], color="black", lw=4, solid_capstyle="butt")
        for q in response.reach:
            height = radius * math.tan(2 * math.atan(q))
            axes.plot([0, side * radius], [0, height], color="tab:orange", lw=1.2)
            align, name = "left" if side > 0 else "right", f"{float(_central_zenith(q)):.1f}°"
            axes.text(1.06 * side * radius, height, name, ha=align, va="center", color="tab:orange")
    axes.plot([-radius, radius], [0, 0], color="tab:blue", lw=3)
    axes.text(0, -0.03 * rim, "sheet", ha="center", va="top", color="tab:blue")
    axes.axvline(0, color="0.6", lw=0.8, ls=":")
    axes.set(
        xlim=(-1.5 * radius, 1.5 * radius),
        ylim=(-0.12 * rim, 1.08 * rim),
        aspect="equal",
        xlabel="from the axis (mm)",
        ylabel="height (mm)",
        title=f"wall: radius {radius:.2f} mm, height {rim:.2f} mm\n"
        "angles: zenith of a mirror on the axis that shows this",
    )


def _draw_shade(axes: Axes, response: WallResponse) -> None:
    """Draw the shading relative to the references, and the direction of the brighter lamps."""
    radius = response.radius
    across = np.linspace(-1, 1, _FINE)
    x, y = np.meshgrid(across, across[::-1])
    percent = 100 * (shade(response, radius * x, radius * y) - 1)
    percent[np.hypot(x, y) > 1] = np.nan
    reach = max(float(np.nanmax(np.abs(percent))), 0.01)
    picture = axes.imshow(
        percent,
        cmap=DIVERGING,
        vmin=-reach,
        vmax=reach,
        extent=(-radius, radius, -radius, radius),
        interpolation="nearest",
    )
    explain_colours(axes, picture, "shading (%)")
    lamps = np.asarray(response.lamps)
    strength = float(np.hypot(*lamps))
    if strength > 0:
        x1, y1 = 0.6 * radius * lamps / strength
        axes.annotate("", (x1, y1), (0, 0), arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 2})
    axes.set(
        xlim=(-radius, radius),
        ylim=(-radius, radius),
        xlabel="x from the axis (mm)",
        ylabel="y from the axis (mm)",
        title=f"shading beyond the references\narrow: lamps are {100 * strength:.1f} % brighter there",
    )


def _draw_correlation(axes: Axes, response: WallResponse) -> None:
    """Draw the correlation of the errors of the parameters that were not fixed."""
    free = np.flatnonzero(np.diag(response.covariance) > 0)
    if not free.size:
        axes.set_axis_off()
        return
    covariance = response.covariance[np.ix_(free, free)]
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    picture = axes.imshow(correlation, cmap=DIVERGING, vmin=-1, vmax=1, interpolation="nearest")
    explain_colours(axes, picture, "correlation")
    residual = math.degrees(response.error)
    axes.set_title(f"errors of the {len(sigma)} parameters\nleft of the zenith: {residual:.3f}° RMS")
    names = [response.parameters[number] for number in free] if len(free) <= _NAMED else []
    size = 7 if len(names) > 12 else 9
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=size)
    axes.set_yticks(range(len(names)), names, fontsize=size)


_BALL = 2.0  # radius of the ball in the figure, mm
_RADII = 2.0, 3.0, 5.0  # of the balls pressed into the gel, mm
_DEEPEST = 1.0  # mm
_NEAR = 3.0  # distance for a wall that is infinitely far away, mm


def draw_gel(gel: Gel) -> Figure:
    """Draw where on a ball pixels turn bright, this zenith by azimuth, and the stage's flexure."""
    figure = new_sheet(17, 5.2)
    grid = figure.add_gridspec(1, 3)
    _draw_threshold(figure.add_subplot(grid[0]), gel)
    polar = cast("PolarAxes", figure.add_subplot(grid[1], projection="polar"))
    away = _OFF_AXIS / gel.curvature if gel.curvature else _NEAR
    _draw_by_azimuth(polar, lambda x, y: threshold_at(gel, x, y, AZIMUTHS), gel.axis, away)
    polar.set_title("zenith at which pixels turn bright, by azimuth")
    _draw_give(figure.add_subplot(grid[2]), gel)
    return figure


def _draw_threshold(axes: Axes, gel: Gel) -> None:
    """Draw the upper side of a ball: dark where it is too flat to turn bright."""
    angle = np.linspace(-math.radians(60), math.radians(60), _FINE)
    lit = np.abs(angle) >= gel.threshold
    x, z = _BALL * np.sin(angle), _BALL * (np.cos(angle) - 1)
    axes.plot(x, np.where(lit, z, np.nan), color="tab:orange", lw=4, label="light")
    axes.plot(x, np.where(lit, np.nan, z), color="0.25", lw=4, label="too flat: dark")
    for side in (-1, 1):
        across, up = side * math.sin(gel.threshold), math.cos(gel.threshold)
        start = _BALL * across, _BALL * (up - 1)
        tip = start[0] + 0.5 * across, start[1] + 0.5 * up
        axes.annotate("", tip, start, arrowprops={"arrowstyle": "-|>", "color": "tab:blue", "lw": 1.5})
        axes.plot([start[0]] * 2, [start[1], start[1] + 0.5], color="0.6", lw=1, ls=":")
    words = _with_error(math.degrees(gel.threshold), math.degrees(gel.sigma.get("threshold", math.nan)), "°")
    axes.set(
        xlabel="x (mm)",
        ylabel="height above the top (mm)",
        aspect="equal",
        ylim=(-1.15, 0.75),
        title=f"a ball of {2 * _BALL:g} mm, on the wall's axis:\nlight begins at a zenith of {words}",
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", frameon=False)


def _draw_give(axes: Axes, gel: Gel) -> None:
    """Draw the deflection of the stage under balls (Hertz, for an incompressible gel)."""
    depth = np.linspace(0, _DEEPEST, _FINE)
    for radius in _RADII:
        force = 16 / 9 * math.sqrt(radius) * depth**1.5  # over Young's modulus, mm^2
        axes.plot(depth, 1000 * gel.compliance * force, lw=2, label=f"ball of {2 * radius:g} mm")
    words = _with_error(gel.compliance, gel.sigma.get("compliance", math.nan), " per mm")
    axes.set(
        xlabel="depth in the gel (mm)",
        ylabel="the stage gives way by (µm)",
        xlim=(0, _DEEPEST),
        title=f"flexure times modulus {words}\nleft on the ball: {1000 * gel.error:.3g} µm RMS",
    )
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", frameon=False)


def draw_stiffness(stiffness: Stiffness) -> Figure:
    """Draw the force of balls pressed into the gel (Hertz), and its standard deviation."""
    figure = new_sheet(8, 5.2)
    axes = figure.add_subplot()
    depth = np.linspace(0, _DEEPEST, _FINE)
    relative_sigma = math.hypot(stiffness.scatter, stiffness.modulus_sigma / stiffness.modulus)
    for radius in _RADII:
        force = 16 / 9 * math.sqrt(radius) * stiffness.modulus * depth**1.5
        axes.plot(depth, force, lw=2, label=f"ball of {2 * radius:g} mm")
        axes.fill_between(depth, force * (1 - relative_sigma), force * (1 + relative_sigma), alpha=0.3)
    words = _with_error(1000 * stiffness.modulus, 1000 * stiffness.modulus_sigma, " kPa")
    axes.set(
        xlabel="depth in the gel (mm)",
        ylabel="force (N)",
        xlim=(0, _DEEPEST),
        title=f"modulus {words} of {stiffness.presses} presses\nscatter {100 * stiffness.scatter:.2g} %",
    )
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", frameon=False)
    return figure


def _with_error(value: float, sigma: float, unit: str) -> str:
    """Return a value with its standard error, if that is known."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.4g}{unit}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}{unit}"
