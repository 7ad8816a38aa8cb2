"""The figure of a lens: where the sheet's millimetres lie in the picture, and what moves them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.io.calibration.types import Lens
from mirrorskin.io.types import Floats
from mirrorskin.view.calibration.maps import draw_pixels, new_sheet
from mirrorskin.view.canvas import round_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
