"""Figures that compare normals with the truth of a simulation: colours, arrows, angles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.scoring import angle_between, true_normals
from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.base.types import Floats
from mirrorskin.view.drawing.canvas import Extent, draw_image, explain_colours, extent, new_sheet, save_figure
from mirrorskin.view.drawing.colours import ERROR, normal_colours
from mirrorskin.view.result.maps import ball_colours
from mirrorskin.view.result.sheet import SMALL, TEXT, entitle
from mirrorskin.view.truth import RESOLUTION, WIDTH, WORST, check_same_size, lay_out, window

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.quiver import Quiver

_NEEDLES = 18  # arrows along the longer side of the part that is shown
_LONGEST = 0.9  # arrow of a horizontal normal, in distances between arrows, is this over the sine of _STEEP
_STEEP = 45.0  # degrees
_CIRCLES = 30, 60  # zeniths marked in the key, degrees


def normal_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw normals, a column for each result, into a PNG.

    From above: the usual colours, red, green and blue for x, y and z from -1 to 1, with black edges
    and a half-ball as a key; the normals projected on the sheet as arrows, as in Fig. 10 (a) of the
    paper; the angle to the true normal where the sheet was in contact in every frame. The medians printed
    are over the pixels with a normal in all results, so that they can be compared.

    Parameters
    ----------
    results : mapping
        Results with ``normals``, ``x`` and ``y`` by name.
    truth : Truth
        Truth of the same size.
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
    shared = np.logical_and.reduce([np.isfinite(error) for error in errors.values()])
    errors_shared = np.concatenate([error[shared] for error in errors.values()])
    worst = float(np.percentile(errors_shared, WORST)) if errors_shared.size else 1.0
    _, x, y = _maps(next(iter(results.values())))
    place = window(np.logical_or.reduce([np.isfinite(error) for error in errors.values()]), x, y)
    figure = new_sheet(WIDTH, 10.0)
    axes = figure.subplots(3, len(results), squeeze=False, sharex=True, sharey=True)
    for column, (name, result) in enumerate(results.items()):
        top, middle, below = axes[:, column]
        letters = "abcdefghi"[column :: len(results)] if len(results) <= 3 else [""] * 3
        entitle(top, f"{letters[0]}  {name}", _draw_normals(top, result, place))
        arrows, note = _draw_arrows(middle, result, place)
        entitle(middle, f"{letters[1]}  projection on x and y", note)
        picture = draw_image(below, errors[name], extent(x, y), cmap=ERROR, vmin=0, vmax=worst)
        lay_out(below, place)
        entitle(below, f"{letters[2]}  error", _note(errors[name], shared))
    for panel in axes.flat:
        panel.label_outer()
    _draw_key(axes[0, -1].inset_axes((1.1, 0.26, 0.4, 0.4)))
    _explain_arrows(axes[1, -1], arrows)
    explain_colours(axes[2, -1], picture, "angle to the true normal (\N{DEGREE SIGN})", "max")
    bar = axes[2, -1].child_axes[-1]
    bar.tick_params(labelsize=SMALL)
    bar.yaxis.label.set_fontsize(TEXT)
    save_figure(figure, title, path, RESOLUTION)


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
    """Return the angles to the true normals, degrees; NaN where contact was lost in some frame."""
    normals, _, _ = _maps(result)
    angle = np.degrees(angle_between(normals, true_normals(truth)))
    valid = truth.contact.astype(bool)
    if result.contact is not None:
        valid = valid & result.contact.astype(bool)
    return np.where(valid, angle, np.nan)


def _draw_normals(axes: Axes, result: Result, place: Extent) -> str:
    """Draw normals as colours; return a note on what has other colours."""
    normals, x, y = _maps(result)
    colours = normal_colours(normals, result.edges)
    draw_image(axes, colours, extent(x, y))
    lay_out(axes, place)
    edges = result.edges is not None and bool(result.edges.any())
    missing = not np.isfinite(normals).all()
    return "; ".join(["black: edges"] * edges + ["light blue: no answer"] * missing)


def _draw_key(axes: Axes) -> None:
    """Draw the colours of all normals, on a half-ball seen from above, with circles of equal zenith."""
    from matplotlib.patches import Circle

    axes.imshow(ball_colours(), extent=(-1, 1, -1, 1), interpolation="antialiased")
    axes.set_axis_off()
    axes.set_title("normal", fontsize=TEXT, pad=20)
    for zenith in _CIRCLES:
        radius = np.sin(np.radians(zenith))
        axes.add_patch(Circle((0, 0), radius, fill=False, color="white", lw=0.8))
        axes.text(
            0, -radius, f"{zenith}\N{DEGREE SIGN}", color="white", ha="center", va="bottom", fontsize=SMALL
        )
    for name, x, y in (("x", 1.15, 0), ("y", 0, 1.15)):
        axes.text(x, y, name, ha="center", va="center", fontsize=TEXT)
    axes.text(0, -1.1, "circles: zenith", ha="center", va="top", fontsize=SMALL)


def _draw_arrows(axes: Axes, result: Result, place: Extent) -> tuple[Quiver, str]:
    """Draw normals in contact, projected on the sheet, as arrows; return a note on their number too."""
    normals, x, y = _maps(result)
    pixel = abs(x[1] - x[0])
    step = max(1, int(max(place[1] - place[0], place[3] - place[2]) / pixel / _NEEDLES))
    shown = normals[step // 2 :: step, step // 2 :: step]
    valid = np.isfinite(shown).all(axis=-1)
    if result.contact is not None:
        valid &= result.contact[step // 2 :: step, step // 2 :: step].astype(bool)
    across, up = np.meshgrid(x[step // 2 :: step], y[step // 2 :: step])
    arrows = axes.quiver(
        *(across[valid], up[valid], shown[valid][:, 0], shown[valid][:, 1]),
        angles="xy",
        scale_units="xy",
        scale=np.sin(np.radians(_STEEP)) / (_LONGEST * step * pixel),
        width=0.006,
        headwidth=3.5,
        headlength=4,
        headaxislength=3.5,
        color="#0072b2",
    )
    axes.update_datalim([place[::2], place[1::2]])  # by which keys are scaled, even without any arrow
    lay_out(axes, place)
    return arrows, f"one of {step} \N{MULTIPLICATION SIGN} {step} pixels in contact"


def _explain_arrows(axes: Axes, arrows: Quiver) -> None:
    """Draw arrows of two zeniths adjacent to the panel."""
    axes.text(1.1, 0.68, "zenith of\nthe normal", transform=axes.transAxes, fontsize=TEXT)
    for zenith, height in ((15, 0.6), (30, 0.52), (45, 0.44)):
        axes.quiverkey(
            *(arrows, 1.2, height, np.sin(np.radians(zenith)), f"{zenith}\N{DEGREE SIGN}"),
            labelpos="E",
            fontproperties={"size": SMALL},
        )


def _note(error: Floats, shared: NDArray[np.bool_]) -> str:
    """Return the median error, where all results have a normal, and of all pixels."""
    finite, common = error[np.isfinite(error)], error[shared]
    if not finite.size:
        return "no pixel in contact"
    note = f"median {np.median(finite):.2f}\N{DEGREE SIGN}"
    return f"{note} ({np.median(common):.2f}\N{DEGREE SIGN} where all answer)" if common.size else note
