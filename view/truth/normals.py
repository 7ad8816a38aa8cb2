"""Figures of normals: colours, the needles of the paper's Fig. 10 (a), and the angles to the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.angles import angle_between, true_normals
from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_image, extent, new_figure, save_figure
from mirrorskin.view.truth.relief import check_same_size

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NEEDLES = 36  # along the longer side
_WORST = 98  # per cent of the errors that the colours tell apart


def normal_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw normals, a row for each result, into a PNG.

    From left to right: the customary colours, red, green and blue for x, y and z from -1 to 1, with edges
    black; the normals projected on the sheet as needles, as Fig. 10 (a) of the paper; the angle to the
    true normal where the sheet was in contact in every frame.

    Parameters
    ----------
    results : mapping
        Names and results with ``normals``, ``x`` and ``y``.
    truth : Truth
        Of the same size.
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no normals of one turn or no axes, or the file cannot be
        written.
    """
    for result in results.values():
        _check(result, truth)
    errors = {name: _errors(result, truth) for name, result in results.items()}
    known = np.concatenate([error[np.isfinite(error)] for error in errors.values()])
    worst = float(np.percentile(known, _WORST)) if known.size else 1.0
    figure = new_figure(14, 4.4 * len(results))
    axes = figure.subplots(len(results), 3, squeeze=False)
    for row, (name, result) in zip(axes, results.items(), strict=True):
        _draw_colours(row[0], name, result)
        _draw_needles(row[1], result)
        _draw_errors(row[2], result, errors[name], worst)
    save_figure(figure, title, path)


def _check(result: Result, truth: Truth) -> None:
    normals = result.normals
    if normals is None or normals.ndim != 3 or result.x is None or result.y is None or min(normals.shape) < 2:
        raise InputError("a figure needs normals of one turn and the pixel size, of 2 x 2 pixels at least")
    check_same_size(normals.shape[:2], truth.height)


def _maps(result: Result) -> tuple[NDArray[np.float32], Floats, Floats]:
    assert result.normals is not None
    assert result.x is not None
    assert result.y is not None
    return result.normals, result.x, result.y


def _errors(result: Result, truth: Truth) -> Floats:
    """Return the angles to the true normals, degrees, where there was contact in every frame, else NaN."""
    normals, _, _ = _maps(result)
    angle = np.degrees(angle_between(normals, true_normals(truth)))
    told = truth.contact.astype(bool)
    if result.contact is not None:
        told = told & result.contact.astype(bool)
    return np.where(told, angle, np.nan)


def _draw_colours(axes: Axes, name: str, result: Result) -> None:
    normals, x, y = _maps(result)
    known = np.asarray(np.isfinite(normals).all(axis=-1))
    colours = np.ones((*known.shape, 4))
    colours[..., :3] = np.where(known[..., np.newaxis], (np.nan_to_num(normals) + 1) / 2, 0)
    if result.edges is not None:
        colours[result.edges.astype(bool)] = 0, 0, 0, 1
        known = known | result.edges.astype(bool)
    colours[~known, 3] = 0
    draw_image(axes, colours, extent(x, y))
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}; black: edges, blue: no answer")


def _draw_needles(axes: Axes, result: Result) -> None:
    normals, x, y = _maps(result)
    step = max(1, max(normals.shape[:2]) // _NEEDLES)
    shown = normals[step // 2 :: step, step // 2 :: step]
    told = np.isfinite(shown).all(axis=-1)
    if result.contact is not None:
        told &= result.contact[step // 2 :: step, step // 2 :: step].astype(bool)
    across, up = np.meshgrid(x[step // 2 :: step], y[step // 2 :: step])
    pixel = step * abs(x[1] - x[0])
    axes.plot(across[told], up[told], ".", ms=2.5, color="tab:red")
    axes.quiver(
        across[told],
        up[told],
        shown[told][:, 0],
        shown[told][:, 1],
        angles="xy",
        scale_units="xy",
        scale=0.6 / pixel,
        width=0.0025,
        headwidth=1,
        headlength=0,
        headaxislength=0,
    )
    left, right, bottom, top = extent(x, y)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title="normals, projected on x and y")


def _draw_errors(axes: Axes, result: Result, error: Floats, worst: float) -> None:
    _, x, y = _maps(result)
    known = error[np.isfinite(error)]
    told = f"median {np.median(known):.2f} deg" if known.size else "no pixel in contact"
    draw_image(axes, error, extent(x, y), "angle to the truth (deg)", cmap="magma", vmin=0, vmax=worst)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{told}; blue: no lasting contact")
