"""The figure of a precession: where the body's axis leans."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.io.calibration.types import Precession
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TURN = np.linspace(0, math.tau, 361)
_MARKS = np.arange(8) * math.pi / 4


def draw_precession(precession: Precession) -> Figure:
    """Draw the lean over a turn, its half-angle, and how far its azimuth is from the phase."""
    figure = new_figure(13.5, 6.4)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1])
    _draw_path(figure.add_subplot(grid[:, 0]), precession)
    angle, azimuth = (figure.add_subplot(grid[row, 1]) for row in range(2))
    lean = np.degrees(precession.lean(_TURN) - np.asarray(precession.centre))
    angle.plot(np.degrees(_TURN), np.hypot(*lean.T), color="tab:blue")
    angle.axhline(math.degrees(precession.tilt), color="0.5", ls=":", label="mean half-angle")
    angle.set(ylabel="lean from the mean (deg)", title="half-angle over a turn")
    even = precession.direction * _TURN + precession.phase_offset
    ahead = np.degrees(precession.phase(_TURN) - even)
    azimuth.plot(np.degrees(_TURN), ahead, color="tab:blue")
    azimuth.axhline(0, color="0.5", ls=":", label="an even turn")
    azimuth.set(ylabel="azimuth, less even turn (deg)", title="how evenly it goes round")
    for axes in (angle, azimuth):
        low, high = axes.get_ylim()
        if high - low < 1e-3:
            middle = (low + high) / 2
            axes.set_ylim(middle - 0.01, middle + 0.01)
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.set(xlabel="phase of the recording (deg)", xlim=(0, 360), xticks=range(0, 361, 45))
        axes.grid(alpha=0.3)
        axes.legend(loc="best", frameon=False)
    return figure


def _draw_path(axes: Axes, precession: Precession) -> None:
    """Draw where the axis leans, with the phases written beside it."""
    centre = np.degrees(precession.centre)
    tilt = math.degrees(precession.tilt)
    path, marks = (np.degrees(precession.lean(phases)) for phases in (_TURN, _MARKS))
    axes.plot(
        *(centre[:, None] + tilt * np.array([np.cos(_TURN), np.sin(_TURN)])),
        color="0.7",
        ls="--",
        lw=1,
        label="circle",
    )
    axes.plot(*path.T, color="tab:blue", lw=2, label="lean")
    axes.plot(*marks.T, "o", color="tab:blue", ms=7)
    for phase, place in zip(_MARKS, marks, strict=True):
        outward = centre + 1.16 * (place - centre)
        axes.text(
            float(outward[0]), float(outward[1]), f"{math.degrees(phase):.0f}°", ha="center", va="center"
        )
    axis = precession.tilt * (1 + abs(precession.ellipticity))
    along = np.degrees(axis) * np.array([math.cos(precession.major_axis), math.sin(precession.major_axis)])
    axes.plot(
        *np.array([centre - along, centre + along]).T, color="tab:red", lw=1, ls=":", label="major axis"
    )
    axes.plot(*centre, "x", color="tab:red", ms=9, mew=2, label="mean lean")
    axes.plot(0, 0, "+", color="black", ms=12, label="upright")
    _draw_direction(axes, centre, precession)
    reach = 1.35 * max(tilt * (1 + abs(precession.ellipticity)), 1e-6)
    axes.set(
        xlim=(min(centre[0] - reach, -reach / 9), max(centre[0] + reach, reach / 9)),
        ylim=(min(centre[1] - reach, -reach / 9), max(centre[1] + reach, reach / 9)),
        xlabel="lean along x (deg)",
        ylabel="lean along y (deg)",
        title="where the body leans; numbers: phase of the recording",
        aspect="equal",
    )
    axes.grid(alpha=0.3)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(0, -0.1),
        ncols=5,
        frameon=False,
        columnspacing=1.2,
        handlelength=1.5,
    )


def _draw_direction(axes: Axes, centre: Floats, precession: Precession) -> None:
    """Draw an arrow that goes round as the body does."""
    angles = precession.phase_offset + precession.direction * np.radians(np.linspace(5, 75, 30))
    arc = centre[:, None] + 0.6 * math.degrees(precession.tilt) * np.array([np.cos(angles), np.sin(angles)])
    (x0, y0), (x1, y1) = arc[:, -3], arc[:, -1]
    axes.plot(*arc[:, :-1], color="tab:green", lw=2)
    axes.annotate("", (x1, y1), (x0, y0), arrowprops={"arrowstyle": "-|>", "color": "tab:green", "lw": 2})
