"""Results with everything that a picture can show, and the contents of figures."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from mirrorskin import io
from mirrorskin.io.model.maps import PressStatus, status_of


def ball(shape=(24, 32), pixel_size=(0.1, 0.12), radius=2.0, **maps):
    """Return all maps of a ball's upper side that is not there in one corner; its top was filled."""
    x, y = io.pixel_axes(shape, pixel_size)
    across, up = np.meshgrid(x, y)
    height = np.sqrt(np.maximum(radius**2 - across**2 - up**2, 0)) - radius
    normals = np.stack([across, up, height + radius], axis=-1) / radius
    hole = (np.arange(shape[0])[:, np.newaxis] < shape[0] // 4) & (np.arange(shape[1]) >= 3 * shape[1] // 4)
    hole |= across**2 + up**2 > 0.8 * radius**2
    filled = (across**2 + up**2 < (0.1 * radius) ** 2).astype(np.uint8)
    height[hole], normals[hole] = np.nan, np.nan
    edges = np.zeros(shape, np.uint8)
    edges[shape[0] // 2] = 1
    arrays = {
        "height": height.astype(np.float32),
        "height_sigma": np.where(hole | (filled == 1), np.nan, 0.002).astype(np.float32),
        "status": np.where(hole, 2, 1).astype(np.uint8),
        "normals": normals.astype(np.float32),
        "normals_sigma": np.where(hole, np.nan, np.radians(0.5)).astype(np.float32),
        "azimuth": np.arctan2(up, across).astype(np.float32),
        "modulation": np.full(shape, 40, np.float32),
        "edges": edges,
        "filled": filled,
        "contact": (~hole).astype(np.uint8),
        "component": np.where(hole, -1, 0).astype(np.int32),
        "offset_unknown": np.zeros(1, np.uint8),
        "x": x,
        "y": y,
        "declarations": {"status": status_of(PressStatus)},
    }
    return io.Result(**(arrays | maps))


def rendered(figure):
    """Return a figure's pixels from the bottom row upwards, red, green and blue."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[::-1, :, :3]


def colours_at(axes, places):
    """Return the colours that a figure has at places of a panel, (x, y)."""
    pixels = rendered(axes.figure)
    column, row = axes.transData.transform(places).astype(int).T
    return pixels[row, column].astype(int)


def panel(figure, title):
    """Return the panel whose title begins like this."""
    matches = [axes for axes in figure.axes if axes.get_title("left").startswith(title)]
    assert len(matches) == 1, [one.get_title("left") for one in figure.axes]
    return matches[0]
