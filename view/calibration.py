"""Figures of a calibration, and of its residual errors on a ball."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.undistort import distorted
from mirrorskin.io import Calibration, InputError
from mirrorskin.io.base.types import Floats
from mirrorskin.io.model.calibration import BITS, Lens, LinearResponse, Precession, References
from mirrorskin.view.drawing.canvas import (
    check_drawing,
    draw_classes,
    draw_image,
    draw_parameter,
    draw_pixels,
    extent,
    new_figure,
    new_sheet,
    round_length,
    save_figure,
)
from mirrorskin.view.drawing.colours import DIVERGING, ERROR, SEQUENTIAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mirrorskin.engine.calibration.check import Check, ErrorMap

_COLOURS = {
    "sound": "0.9",
    "hot": "tab:red",
    "dead": "black",
    "saturated": "tab:orange",
    "several": "tab:purple",
}
_VISIBLE = 100  # number of dots along a side that can be distinguished


def draw_references(references: References) -> Figure:
    """Draw both levels, their difference, both standard errors, and the defects."""
    figure = new_sheet(17, 8.2)
    axes = figure.subplots(2, 3)
    light = references.bright - references.dark
    draw_parameter(axes[0, 0], references, "dark")
    draw_parameter(axes[0, 1], references, "bright")
    draw_pixels(axes[0, 2], light, "light: bright less dark", "counts")
    draw_parameter(axes[1, 0], references, "dark_sigma", ERROR)
    draw_parameter(axes[1, 1], references, "bright_sigma", ERROR)
    _draw_defects(axes[1, 2], references.defects)
    return figure


def _draw_defects(axes: Axes, defects: NDArray[np.uint8]) -> None:
    """Draw defects by colour, each large enough to be visible."""
    names = list(_COLOURS)
    kind = np.full(defects.shape, names.index("several"), np.uint8)
    for name, bits in ({"sound": 0} | BITS).items():
        kind[defects == bits] = names.index(name)
    from scipy.ndimage import maximum_filter

    size = max(1, max(defects.shape) // _VISIBLE)
    counts = np.bincount(kind.ravel(), minlength=len(names))
    labels = {number: f"{names[number]}: {count}" for number, count in enumerate(counts) if count}
    draw_classes(axes, maximum_filter(kind, size), list(_COLOURS.values()), labels)
    axes.set(title="defects\ndrawn larger than they are", xlabel="column (px)", ylabel="row (px)")
    if size == 1:
        axes.set_title("defects\n")


_LINES = 16  # approximate number of grid lines along the longer side
_GRID = 96  # samples of a map along the longer side
_FINE = 200  # points along a line
_BEYOND = 0.75  # of the picture's size from its centre: the distortion model is not valid farther away


def draw_lens(lens: Lens) -> Figure:
    """Draw a millimetre grid as seen by the camera, the distortion, and the sizes of pixels."""
    figure = new_sheet(17, 5.2)
    axes = figure.subplots(1, 3)
    _draw_grid(axes[0], lens)
    rows, columns = _samples(lens.shape)
    ideal = np.stack([columns, rows], axis=-1)
    moved = _distort(ideal, lens) - ideal
    extent = (-0.5, lens.shape[1] - 0.5, lens.shape[0] - 0.5, -0.5)
    draw_pixels(axes[1], np.hypot(moved[..., 0], moved[..., 1]), "distortion", "px", SEQUENTIAL)
    draw_pixels(
        axes[2],
        100 * (_sizes(ideal, lens) - 1),
        "size of a pixel on the sheet",
        "% from the map's",
        DIVERGING,
        even=True,
    )
    for panel in axes[1:]:
        panel.images[0].set_extent(extent)
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


def draw_linear_response(response: LinearResponse) -> Figure:
    """Draw gain and offset of the pixels, and the brightness of a usual one by the zenith."""
    figure = new_sheet(17, 5.2)
    axes = figure.subplots(1, 3)
    draw_pixels(axes[0], response.gain, "zenith gain", "counts/rad", SEQUENTIAL)
    draw_pixels(axes[1], response.offset, "zenith offset", "counts", SEQUENTIAL)
    zenith = np.linspace(0, math.pi / 4, _FINE)
    gain, offset = (float(np.nanmedian(values)) for values in (response.gain, response.offset))
    sigma = np.hypot(response.sigma["gain"] * zenith, response.sigma["offset"])
    light = offset + gain * zenith
    axes[2].plot(np.degrees(zenith), light, lw=2)
    axes[2].fill_between(np.degrees(zenith), light - sigma, light + sigma, alpha=0.3)
    title = f"median of the pixels, {response.touches} touches\ngamma {response.gamma:.3f}"
    axes[2].set(xlabel="zenith (deg)", ylabel="brightness (counts)", title=title)
    axes[2].grid(alpha=0.3)
    return figure


def _samples(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return rows and columns of points spread over the picture, pixels."""
    step = max(1.0, max(shape) / _GRID)
    along = [np.arange(0.5 * step, size, step) - 0.5 for size in shape]
    rows, columns = np.meshgrid(*along, indexing="ij")
    return rows, columns


def _distort(ideal: Floats, lens: Lens) -> Floats:
    """Return the positions in the distorted picture of undistorted (column, row), (..., 2)."""
    x, y = _project(np.asarray(np.linalg.inv(lens.matrix)), ideal)
    bent = distorted(np.stack([x.ravel(), y.ravel(), np.ones(x.size)]), lens.distortion)
    return np.stack(_project(lens.matrix, bent[:2].T.reshape(ideal.shape)), axis=-1)


def _project(matrix: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Apply a homography to points (..., 2)."""
    x, y, w = np.moveaxis(places @ matrix[:, :2].T + matrix[:, 2], -1, 0)
    return x / w, y / w


def _sizes(ideal: Floats, lens: Lens) -> Floats:
    """Return the size of a pixel on the sheet, relative to that of the map."""
    sides = [
        np.stack(_project(lens.camera, ideal + shift), axis=-1)
        - np.stack(_project(lens.camera, ideal - shift), axis=-1)
        for shift in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
    ]
    area = np.abs(sides[0][..., 0] * sides[1][..., 1] - sides[0][..., 1] * sides[1][..., 0])
    return np.asarray(np.sqrt(area / (lens.pixel_size[0] * lens.pixel_size[1])))


def _draw_grid(axes: Axes, lens: Lens) -> None:
    """Draw lines of whole millimetres, or tenths of them, at their positions in the picture."""
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
            distorted = np.where(far[:, np.newaxis], np.nan, _distort(ideal, lens))
            colour = "tab:red" if abs(value) < step / 2 else "tab:blue"
            axes.plot(*distorted.T, color=colour, lw=1.4 if colour == "tab:red" else 0.8)
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
    """Draw the lean over a turn, its half-angle, and the difference of its azimuth and the phase."""
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
    azimuth.axhline(0, color="0.5", ls=":", label="uniform rotation")
    azimuth.set(ylabel="azimuth - uniform rotation (deg)", title="evenness of the rotation")
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
    """Draw the lean of the axis, labelled with the phases, and the sense of rotation."""
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
    angles = precession.phase_offset + precession.direction * np.radians(np.linspace(5, 75, 30))
    arc = centre[:, None] + 0.6 * tilt * np.array([np.cos(angles), np.sin(angles)])
    axes.plot(*arc[:, :-1], color="tab:green", lw=2)
    arrow = {"arrowstyle": "-|>", "color": "tab:green", "lw": 2}
    axes.annotate("", tuple(arc[:, -1]), tuple(arc[:, -3]), arrowprops=arrow)
    reach = 1.35 * max(tilt * (1 + abs(precession.ellipticity)), 1e-6)
    axes.set(
        xlim=(min(centre[0] - reach, -reach / 9), max(centre[0] + reach, reach / 9)),
        ylim=(min(centre[1] - reach, -reach / 9), max(centre[1] + reach, reach / 9)),
        xlabel="lean along x (deg)",
        ylabel="lean along y (deg)",
        title="lean of the body; numbers: phase of the recording",
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


_WORST = 98  # percentile of the errors at the end of the colour scale


def check_figure(check: Check, title: str, path: Path) -> None:
    """Draw the errors before and after a calibration into a PNG: a row for each map, with common colours."""
    columns = [(when, parts) for when, parts in (("before", check.before), ("after", check.after)) if parts]
    figure = new_figure(5.2 * len(columns), 4.4 * len(check.after))
    axes = figure.subplots(len(check.after), len(columns), squeeze=False)
    for row, name in zip(axes, check.after, strict=True):
        shown = [parts[name] for _, parts in columns if name in parts]
        errors = np.concatenate([np.abs(part.error[np.isfinite(part.error)]) for part in shown])
        worst = float(np.percentile(errors, _WORST)) if errors.size else 1.0
        for place, (when, parts) in zip(row, columns, strict=True):
            _draw(place, f"{name}, {when}", parts[name], check, worst)
    save_figure(figure, title, path)


def _draw(axes: Axes, name: str, errors: ErrorMap, check: Check, worst: float) -> None:
    place, label = extent(check.x, check.y), f"found - true ({errors.unit})"
    signed = bool(np.nanmin(errors.error, initial=0.0) < 0)  # the angle between normals has no sign
    colours = DIVERGING if signed else ERROR
    draw_image(axes, errors.error, place, label, cmap=colours, vmin=-worst if signed else 0.0, vmax=worst)
    digits = 3 if errors.unit == "deg" else 4
    rms, bias = (round(float(value), digits) + 0.0 for value in (errors.whole.rms, errors.whole.bias))
    summary = f"RMS {rms:.{digits}f}, bias {bias:+.{digits}f} {errors.unit}"
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}\n{summary}")


def calibration_figures(calibration: Calibration, folder: Path) -> list[Path]:
    """Draw the parts of a calibration into PNGs."""
    from mirrorskin.view.calibration_wall import draw_gel, draw_response, draw_stiffness

    draw: dict[str, Callable[[Any], Figure]] = {
        "references": draw_references,
        "lens": draw_lens,
        "zenith": draw_response,
        "precession": draw_precession,
        "gel": draw_gel,
        "stiffness": draw_stiffness,
        "response": draw_linear_response,
    }
    check_drawing()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be created: {error.strerror}; name another with -o") from None
    written = []
    for name, part in calibration.parts().items():
        path = folder / f"{part.command}.png"
        save_figure(draw[name](part), f"{Path(calibration.name).name}: {part.command}", path)
        written.append(path)
    return written
