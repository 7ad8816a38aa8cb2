"""Figures of a calibration, and of what is left of its errors on a ball."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from mirrorskin.engine.calibration.check import Check, Errors
from mirrorskin.engine.calibration.wall_response import threshold_zenith
from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.io import Calibration, InputError
from mirrorskin.io.calibration.types import (
    DEAD,
    GROUPS,
    HOT,
    SATURATED,
    Gel,
    Lens,
    Precession,
    References,
    WallResponse,
)
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import (
    check_drawing,
    draw_classes,
    draw_image,
    exceeded,
    explain_colours,
    extent,
    new_figure,
    round_length,
    save_figure,
)
from mirrorskin.view.colours import MISSING

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
    """Draw a map of all pixels, with its colours explained."""
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
    """Draw zeniths over all azimuths of the normal."""
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


_LINES = 16  # of the grid, about, along the longer side
_GRID = 96  # samples of a map along the longer side
_FINE = 200  # places along a line
_BEYOND = 0.75  # of the picture's size from its middle: farther off distortion says nothing


def draw_lens(lens: Lens) -> Figure:
    """Draw a grid of millimetres as the camera sees it, the distortion, and how large pixels are."""
    figure = new_sheet(17, 5.2)
    axes = figure.subplots(1, 3)
    _draw_grid(axes[0], lens)
    rows, columns = _samples(lens.shape)
    ideal = np.stack([columns, rows], axis=-1)
    moved = _distort(ideal, lens) - ideal
    extent = (-0.5, lens.shape[1] - 0.5, lens.shape[0] - 0.5, -0.5)
    draw_pixels(axes[1], np.hypot(moved[..., 0], moved[..., 1]), "distortion", "px", "viridis")
    draw_pixels(
        axes[2],
        100 * (_sizes(ideal, lens) - 1),
        "size of a pixel on the sheet",
        "% from the map's",
        "RdBu_r",
        even=True,
    )
    for one in axes[1:]:
        one.images[0].set_extent(extent)
    each = slice(None, None, max(1, len(rows) // 10))
    axes[1].quiver(
        columns[each, each],
        rows[each, each],
        moved[each, each, 0],
        moved[each, each, 1],
        angles="xy",
        color="white",
        width=0.004,
    )
    return figure


def _samples(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return rows and columns of places spread over the picture, pixels."""
    step = max(1.0, max(shape) / _GRID)
    along = [np.arange(0.5 * step, size, step) - 0.5 for size in shape]
    rows, columns = np.meshgrid(*along, indexing="ij")
    return rows, columns


def _distort(ideal: Floats, lens: Lens) -> Floats:
    """Return where a picture has what lies at (column, row) without distortion, (..., 2) (OpenCV)."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = _project(np.asarray(np.linalg.inv(lens.matrix)), ideal)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    return np.stack(_project(lens.matrix, np.stack(bent, axis=-1)), axis=-1)


def _project(matrix: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Apply a homography to places (..., 2)."""
    x, y, w = np.moveaxis(places @ matrix[:, :2].T + matrix[:, 2], -1, 0)
    return x / w, y / w


def _sizes(ideal: Floats, lens: Lens) -> Floats:
    """Return the size of a pixel on the sheet, as a share of that of the map."""
    sides = [
        np.stack(_project(lens.camera, ideal + shift), axis=-1)
        - np.stack(_project(lens.camera, ideal - shift), axis=-1)
        for shift in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
    ]
    area = np.abs(sides[0][..., 0] * sides[1][..., 1] - sides[0][..., 1] * sides[1][..., 0])
    return np.asarray(np.sqrt(area / (lens.pixel_size[0] * lens.pixel_size[1])))


def _draw_grid(axes: Axes, lens: Lens) -> None:
    """Draw lines of whole millimetres, or tenths of them, as they lie in the picture."""
    rows, columns = lens.shape
    corners = np.array([[0, 0], [columns - 1, 0], [0, rows - 1], [columns - 1, rows - 1]], np.float64)
    x, y = _project(lens.camera, corners)
    step = round_length(max(np.ptp(x), np.ptp(y)) / _LINES, up=True)
    to_picture = np.asarray(np.linalg.inv(lens.camera))
    for across, (low, high), (start, stop) in (
        (True, (x.min(), x.max()), (y.min(), y.max())),
        (False, (y.min(), y.max()), (x.min(), x.max())),
    ):
        along = np.linspace(start - step, stop + step, _FINE)
        for value in step * np.arange(math.floor(low / step), math.ceil(high / step) + 1):
            line = np.stack(
                [np.full(_FINE, value), along] if across else [along, np.full(_FINE, value)], axis=-1
            )
            ideal = np.stack(_project(to_picture, line), axis=-1)
            far = np.abs(ideal / (columns, rows) - 0.5).max(axis=-1) > _BEYOND
            seen = np.where(far[:, np.newaxis], np.nan, _distort(ideal, lens))
            colour = "tab:red" if abs(value) < step / 2 else "tab:blue"
            axes.plot(*seen.T, color=colour, lw=1.4 if colour == "tab:red" else 0.8)
    axes.set(
        xlim=(-0.5, columns - 0.5),
        ylim=(rows - 0.5, -0.5),
        aspect="equal",
        xlabel="column (px)",
        ylabel="row (px)",
        title=f"the sheet as the camera sees it\nlines every {step:g} mm; red: x = 0, y = 0",
    )


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


_FINE_WALL = 300
_NAMED = 30  # parameters that have room for their names
_HALF = 0.5  # of full light
_OFF_WALL = 0.3  # of the radius: how far off the axis the places lie of which more is told


def draw_response(response: WallResponse) -> Figure:
    """Draw what a wall's response says, and its errors.

    Above, the curve of a graded wall or the section of a uniform one, the zenith at which half of the light
    is reached by azimuth, the shading; below, the errors of zenith and azimuth, and how those of the
    parameters depend on each other.
    """
    figure = new_sheet(17, 10)
    grid = figure.add_gridspec(2, 3)
    (_draw_curve if response.pattern == "graded" else _draw_section)(figure.add_subplot(grid[0, 0]), response)
    _draw_half_light(cast("PolarAxes", figure.add_subplot(grid[0, 1], projection="polar")), response)
    _draw_shade(figure.add_subplot(grid[0, 2]), response)
    zenith, azimuth = (figure.add_subplot(grid[1, column]) for column in range(2))
    draw_pixels(zenith, np.degrees(response.zenith_sigma), "standard error of zenith", "deg", "magma")
    title = "standard error of azimuth times sin(zenith)"
    draw_pixels(azimuth, np.degrees(response.azimuth_sigma), title, "deg", "magma")
    _draw_correlation(figure.add_subplot(grid[1, 2]), response)
    return figure


def _central_zenith(q: Floats | float) -> Floats:
    """Return the zenith of a mirror on the axis that shows the wall at q, degrees."""
    return np.asarray(np.degrees(math.pi / 4 - np.arctan(q)))


def _draw_curve(axes: Axes, response: WallResponse) -> None:
    """Draw light, and what a degree changes of it, against the zenith of a mirror on the axis."""
    q = np.linspace(*response.reach, _FINE_WALL)
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
    """Draw the body cut through its axis, and the rays to the ends of what is known."""
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


def _draw_half_light(axes: PolarAxes, response: WallResponse) -> None:
    """Draw by azimuth the zenith at which half of the light is reached, on the axis and off it."""
    x0, y0 = response.axis
    full = 1.0 if response.pattern == "graded" else float(response.curve[0])
    zeniths = {
        name: threshold_zenith(response, x0 + x, y0 + y, AZIMUTHS, _HALF * full)
        for name, (x, y) in places_about(_OFF_WALL * response.radius).items()
    }
    draw_azimuths(axes, zeniths, "zenith of half light, by azimuth")


def _draw_shade(axes: Axes, response: WallResponse) -> None:
    """Draw by how much the picture is brighter or darker than its references say, and where the lamps are."""
    radius = response.radius
    across = np.linspace(-1, 1, _FINE_WALL)
    x, y = np.meshgrid(across, across[::-1])
    shade = 100 * np.tensordot(response.shade, np.stack([x, y, x * x, x * y, y * y]), 1)
    shade[np.hypot(x, y) > 1] = np.nan
    reach = max(float(np.nanmax(np.abs(shade))), 0.01)
    picture = axes.imshow(
        shade,
        cmap="RdBu_r",
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
    """Draw how the errors of the parameters that were not fixed depend on each other."""
    free = np.flatnonzero(np.diag(response.covariance) > 0)
    if not free.size:
        axes.set_axis_off()
        return
    covariance = response.covariance[np.ix_(free, free)]
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    picture = axes.imshow(correlation, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    explain_colours(axes, picture, "correlation")
    left = math.degrees(response.error)
    axes.set_title(f"errors of the {len(sigma)} parameters\nleft on the balls: {left:.3f}° RMS")
    names = [response.parameters[number] for number in free] if len(free) <= _NAMED else []
    size = 7 if len(names) > 12 else 9
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=size)
    axes.set_yticks(range(len(names)), names, fontsize=size)


_BALL = 2.0  # radius of the ball in the figure, mm
_RADII = 2.0, 3.0, 5.0  # of the balls pressed into the gel, mm
_DEEPEST = 1.0  # mm
_FINE_GEL = 400
_OFF_GEL = 0.3  # of the wall's radius: how far off the axis the places lie of which more is told
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
        for name, (x, y) in places_about(_OFF_GEL / gel.curvature if gel.curvature else _NEAR).items()
    }
    draw_azimuths(polar, zeniths, "zenith at which light begins, by azimuth")
    _draw_give(figure.add_subplot(grid[2]), gel)
    return figure


def _draw_threshold(axes: Axes, gel: Gel) -> None:
    """Draw the upper side of a ball: dark where it is too flat to show light."""
    angle = np.linspace(-math.radians(60), math.radians(60), _FINE_GEL)
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
    depth = np.linspace(0, _DEEPEST, _FINE_GEL)
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


_WORST = 98  # per cent of the errors that the colours tell apart


def check_figure(check: Check, title: str, path: Path) -> None:
    """Draw the errors before and after a calibration into a PNG: a row for each map, in the same colours."""
    columns = [(when, parts) for when, parts in (("before", check.before), ("after", check.after)) if parts]
    figure = new_figure(5.2 * len(columns), 4.4 * len(check.after))
    axes = figure.subplots(len(check.after), len(columns), squeeze=False)
    for row, name in zip(axes, check.after, strict=True):
        shown = [parts[name] for _, parts in columns if name in parts]
        known = np.concatenate([np.abs(part.error[np.isfinite(part.error)]) for part in shown])
        worst = float(np.percentile(known, _WORST)) if known.size else 1.0
        for place, (when, parts) in zip(row, columns, strict=True):
            _draw(place, f"{name}, {when}", parts[name], check, worst)
    save_figure(figure, title, path)


def _draw(axes: Axes, name: str, errors: Errors, check: Check, worst: float) -> None:
    place, label = extent(check.x, check.y), f"found - true ({errors.unit})"
    draw_image(axes, errors.error, place, label, cmap="RdBu_r", vmin=-worst, vmax=worst)
    digits = 3 if errors.unit == "deg" else 4
    rms, bias = (round(float(value), digits) + 0.0 for value in (errors.whole.rms, errors.whole.bias))
    told = f"RMS {rms:.{digits}f}, bias {bias:+.{digits}f} {errors.unit}"
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}\n{told}")


_DRAW: Mapping[str, Callable[[Any], Figure]] = {
    "references": draw_references,
    "lens": draw_lens,
    "zenith": draw_response,
    "precession": draw_precession,
    "gel": draw_gel,
}


def calibration_figures(calibration: Calibration, folder: Path) -> list[Path]:
    """Draw the parts of a calibration into PNGs."""
    check_drawing()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made: {error.strerror}; name another folder with -o") from error
    written = []
    for name, part in calibration.parts().items():
        path = folder / f"{GROUPS[name]}.png"
        save_figure(_DRAW[name](part), f"{Path(calibration.name).name}: {GROUPS[name]}", path)
        written.append(path)
    return written
