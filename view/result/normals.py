"""The picture of normals, in the customary colours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.view.colours import normal_colours
from mirrorskin.view.result.sheet import SMALL, Sheet, draw_map, entitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_KEY = 129  # pixels of the key along a side


def draw_normals(axes: Axes, sheet: Sheet) -> None:
    """Draw normals as colours, edges black, and beside them a half-ball that explains the colours."""
    result = sheet.result
    assert result.normals is not None
    colours = normal_colours(result.normals, result.edges)
    draw_map(axes, sheet, colours, interpolation="antialiased")
    _draw_key(axes)
    missing = bool(np.isnan(result.normals[..., 2]).any())
    edges = result.edges is not None and bool(result.edges.any())
    notes = (["black: edges"] if edges else []) + (["blue: no answer"] if missing else [])
    entitle(axes, "Normals", "; ".join(notes))


def _draw_key(axes: Axes) -> None:
    """Draw the colours of all normals there are, on a half-ball seen from above."""
    across = np.linspace(-1, 1, _KEY, dtype=np.float32)
    right, up = np.meshgrid(across, across[::-1])
    rest = 1 - right**2 - up**2
    ball = np.stack([right, up, np.sqrt(np.maximum(rest, 0))], axis=-1)
    colours = np.full((_KEY, _KEY, 4), 255, np.uint8)
    colours[..., :3] = normal_colours(ball)
    colours[rest < 0, 3] = 0
    key = axes.inset_axes((1.03, 0.75, 0.2, 0.2))
    key.imshow(colours, extent=(-1, 1, -1, 1), interpolation="antialiased")
    key.set_axis_off()
    for name, x, y in (("x", 1.25, 0), ("y", 0, 1.25)):
        key.text(x, y, name, ha="center", va="center", fontsize=SMALL)
    key.text(0, -1.2, "a ball's colours", ha="center", va="top", fontsize=SMALL)
