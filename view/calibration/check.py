"""Figures of the errors that a calibration leaves on a ball."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.engine.calibration.check import Check, Errors
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WORST = 98  # per cent of the errors that the colours tell apart


def check_figure(check: Check, title: str, path: Path) -> None:
    """Draw the errors before and after a calibration into a PNG: a row for each map, in the same colours.

    Parameters
    ----------
    check : Check
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, or the file cannot be written.
    """
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
