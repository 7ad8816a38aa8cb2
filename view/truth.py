"""Figures that compare results with the truth of a simulation: heights, normals, surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.scoring import angle_between, true_normals
from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.base.types import Floats
from mirrorskin.view.drawing.canvas import (
    draw_image,
    exceeded,
    extent,
    filled_colours,
    new_figure,
    save_figure,
)
from mirrorskin.view.drawing.colours import DIVERGING, ERROR, FILLED, SEQUENTIAL, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_MESH = 120  # samples of a surface along its longer side
Range = tuple[float, float]
"""Lowest and highest, mm."""


@dataclass(frozen=True, slots=True)
class Relief:
    """Heights to be drawn in figures.

    Attributes
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN where undefined.
    filled : ndarray, (H, W), bool
        Where it was filled, not measured.
    x, y : ndarray, (W,) and (H,), float64
        Millimetres.
    levelled : bool
        Whether a component of unknown offset was moved to the mean height of the truth.
    """

    height: NDArray[np.float32]
    filled: NDArray[np.bool_]
    x: Floats
    y: Floats
    levelled: bool

    def notes(self, missing: str) -> str:
        """Return notes on the colours, the share of filled heights, and the level."""
        percentage = 100 * float(self.filled.sum()) / max(1.0, float(np.isfinite(self.height).sum()))
        filled = [f"orange: filled, {percentage:.0f} % of the heights"] if self.filled.any() else []
        return "\n".join([*filled, missing, *(["truth's level"] if self.levelled else [])])

    @property
    def measured(self) -> Relief:
        """The same without filled heights."""
        height = np.where(self.filled, np.float32(np.nan), self.height)
        return replace(self, height=height, filled=np.zeros_like(self.filled))

    @property
    def ends(self) -> Range:
        """The lowest and the highest height."""
        finite = self.height[np.isfinite(self.height)]
        return (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 0.0)


def relief_of(result: Result, truth: Truth) -> Relief:
    """Return the heights of a result; components of unknown offset are moved to the truth's mean height."""
    height, x, y = result.height, result.x, result.y
    if height is None or x is None or y is None or height.ndim != 2 or min(height.shape) < 2:
        raise InputError("a figure needs heights and the pixel size, of 2 x 2 pixels at least")
    check_same_size(height.shape, truth.height)
    filled = np.zeros(height.shape, bool) if result.filled is None else result.filled.astype(bool)
    levelled = result.offset_unknown is not None and bool(result.offset_unknown.any())
    return Relief(_level(result, height, truth.height) if levelled else height, filled, x, y, levelled)


def _level(result: Result, height: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Subtract its mean error from each component of unknown offset."""
    assert result.component is not None
    assert result.offset_unknown is not None
    error = height.astype(np.float64) - truth
    valid = np.isfinite(error) & (result.component >= 0)
    count, label = result.offset_unknown.size, result.component[valid]
    mean = np.bincount(label, error[valid], count) / np.maximum(np.bincount(label, minlength=count), 1)
    # The last element is for pixels without a component.
    shift = np.append(np.where(result.offset_unknown, mean, 0.0), 0.0)[result.component]
    return np.asarray(height - shift, np.float32)


def draw_map(axes: Axes, name: str, relief: Relief, limits: Range | None = None) -> None:
    """Draw heights between limits by colour, filled ones in shades of orange."""
    lowest, highest = limits or span(relief.height)
    beyond = exceeded(relief.height, lowest, highest)
    shades: list[str | Colormap] = [SEQUENTIAL, filled_colours()]
    for filled in (False, True) if relief.filled.any() else (False,):
        shown, place = np.where(relief.filled == filled, relief.height, np.nan), extent(relief.x, relief.y)
        label = "" if filled else "height (mm)"
        draw_image(axes, shown, place, label, beyond, cmap=shades[filled], vmin=lowest, vmax=highest)
    axes.axhline(0, color="tab:red", lw=0.8, ls=":")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}\n{relief.notes('blue: no answer')}")


def draw_surface(axes: Axes3D, name: str, relief: Relief, limits: Range | None = None) -> None:
    """Draw heights as a 3D surface, within limits along z; filled ones have their own colour."""
    step = max(1, max(relief.height.shape) // _MESH)
    limits = limits or relief.ends
    shown, filled = relief.height[::step, ::step], relief.filled[::step, ::step]
    across, up = np.meshgrid(relief.x[::step], relief.y[::step])
    # A single surface with two colour maps, because Matplotlib does not sort two surfaces by depth.
    colours = _colours(shown, filled, limits)
    style = {"rstride": 1, "cstride": 1, "linewidth": 0, "antialiased": True, "shade": False}
    axes.plot_surface(across, up, shown, facecolors=colours, **style)
    axes.set_box_aspect((np.ptp(relief.x), np.ptp(relief.y), 0.45 * np.ptp(relief.x)), zoom=1.15)
    axes.set_zlim(*limits)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name} (mm)\n{relief.notes('holes: no answer')}")


def _colours(height: NDArray[np.float32], filled: NDArray[np.bool_], limits: Range) -> Floats:
    """Return the colours of a surface, (H, W, 4): by height, and orange for filled heights."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize, to_rgba

    colours = np.array(colormaps[SEQUENTIAL](Normalize(*limits)(np.nan_to_num(height))))
    colours[filled] = to_rgba(FILLED)
    return colours


def draw_cuts(axes: Axes, reliefs: Mapping[str, Relief], truth: Truth, limits: Range | None = None) -> None:
    """Draw heights on the middle row with the truth; filled ones are open circles."""
    row = len(truth.height) // 2
    any_relief = next(iter(reliefs.values()))
    axes.plot(any_relief.x, truth.height[row], color="0.6", lw=3, label="truth")
    dots_on_row(axes, {name: relief.height[row] for name, relief in reliefs.items()}, reliefs)
    opened = any(relief.filled[row].any() for relief in reliefs.values())
    title = "cut across the middle" + ("; open circles: filled" if opened else "")
    axes.set(xlabel="x (mm)", ylabel="height (mm)", title=title)
    if limits is None:
        lowest = min(relief.ends[0] for relief in reliefs.values())
        limits = 1.04 * lowest - 0.02, -0.04 * lowest + 0.02
    axes.set_ylim(*limits)
    axes.grid(alpha=0.3)
    # Outside of the panel, where it hides no curve.
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        ncols=2,
        markerscale=2,
        frameon=False,
        fontsize="small",
    )


def dots_on_row(axes: Axes, values: Mapping[str, NDArray[np.float32]], reliefs: Mapping[str, Relief]) -> None:
    """Draw values along the middle row, (W,), with the colours and names of the reliefs."""
    for number, (name, relief) in enumerate(reliefs.items()):
        filled = relief.filled[len(relief.filled) // 2]
        # The first one is on top, and small enough not to hide the others.
        style: dict[str, Any] = {"ms": 3 + number, "zorder": 9 - number, "color": f"C{number}", "ls": ""}
        axes.plot(relief.x, np.where(filled, np.nan, values[name]), marker=".", label=name, **style)
        if filled.any():
            axes.plot(relief.x, np.where(filled, values[name], np.nan), marker="o", mfc="none", **style)


def check_same_size(shape: tuple[int, ...], truth: NDArray[np.float32]) -> None:
    """Raise InputError if a result and the truth have different sizes."""
    if truth.shape != shape:
        raise InputError(f"the result is {shape} pixels, the truth {truth.shape}: not of one stack")


def height_figure(
    results: Mapping[str, Result],
    truth: Truth,
    title: str,
    path: Path,
    *,
    surface: bool = False,
    detail: Range | None = None,
) -> None:
    """Draw heights, and cuts across the middle with the truth, into a PNG.

    Parameters
    ----------
    results : mapping
        Results with ``height``, ``x`` and ``y`` by name. The first and the last are drawn as maps, all
        are cut. ``filled`` heights have their own colour; components of unknown
        offset are moved to the mean of the truth.
    truth : Truth
        Truth of the same size.
    title : str
    path : Path
        PNG to write.
    surface : bool
        Draw 3D surfaces, as in Fig. 5 (a) of the paper, instead of maps as in its Fig. 6,
        with one vertical scale; the first also without filled heights.
    detail : (float, float), optional
        Heights, mm, between which maps and cuts are drawn again, with their own scale.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no heights or axes, or the file cannot be written.
    """
    save_figure(_draw_heights(results, truth, surface, detail), title, path)


def _draw_heights(
    results: Mapping[str, Result], truth: Truth, surface: bool, detail: Range | None = None
) -> Figure:
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    names = list(reliefs)
    whole = {name: reliefs[name] for name in (names[0], names[-1])}
    if surface:
        return _draw_in_space(whole, reliefs, truth)
    scales: list[Range | None] = [None] if detail is None else [None, detail]
    figure = new_figure(14, 4.8 * len(scales))
    grid = figure.add_gridspec(len(scales), len(whole) + 1, width_ratios=[1] * len(whole) + [1.2])
    for row, limits in enumerate(scales):
        for column, (name, relief) in enumerate(whole.items()):
            draw_map(figure.add_subplot(grid[row, column]), name, relief, limits)
        draw_cuts(figure.add_subplot(grid[row, -1]), reliefs, truth, limits)
    return figure


def _draw_in_space(whole: Mapping[str, Relief], reliefs: Mapping[str, Relief], truth: Truth) -> Figure:
    """Draw surfaces on one scale, the first also without filled heights, and all cuts."""
    first, relief = next(iter(whole.items()))
    if relief.filled.any():
        whole = {f"{first}, measured": relief.measured, **whole}
    ends = [relief.ends for relief in whole.values()]
    limits = min(low for low, _ in ends), max(high for _, high in ends)
    columns = 2 if len(whole) > 2 else len(whole) + 1
    rows = -(-(len(whole) + 1) // columns)
    figure = new_figure(14, 4.8 * rows)
    grid = figure.add_gridspec(rows, columns)
    for number, (name, relief) in enumerate(whole.items()):
        place = grid[divmod(number, columns)]
        draw_surface(figure.add_subplot(place, projection="3d"), name, relief, limits)
    draw_cuts(figure.add_subplot(grid[-1, -1]), reliefs, truth)
    return figure


_NEEDLES = 36  # along the longer side
_WORST = 98  # percentile of the errors at the end of the colour scale


def normal_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw normals, a row for each result, into a PNG.

    From left to right: the usual colours, red, green and blue for x, y and z from -1 to 1, with black edges
    and a half-sphere as a key; the normals projected on the sheet as needles, as in Fig. 10 (a) of the
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
    worst = float(np.percentile(errors_shared, _WORST)) if errors_shared.size else 1.0
    figure = new_figure(14, 4.4 * len(results))
    axes = figure.subplots(len(results), 3, squeeze=False)
    _draw_key(axes[0, 0].inset_axes((1.05, 0.3, 0.4, 0.4)))
    for row, (name, result) in zip(axes, results.items(), strict=True):
        _draw_normals(row[0], name, result)
        _draw_needles(row[1], result)
        _draw_angles(row[2], result, errors[name], shared, worst)
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
    """Return the angles to the true normals, degrees; NaN where contact was lost in some frame."""
    normals, _, _ = _maps(result)
    angle = np.degrees(angle_between(normals, true_normals(truth)))
    valid = truth.contact.astype(bool)
    if result.contact is not None:
        valid = valid & result.contact.astype(bool)
    return np.where(valid, angle, np.nan)


def _draw_normals(axes: Axes, name: str, result: Result) -> None:
    normals, x, y = _maps(result)
    finite = np.asarray(np.isfinite(normals).all(axis=-1))
    colours = np.ones((*finite.shape, 4))
    colours[..., :3] = np.where(finite[..., np.newaxis], (np.nan_to_num(normals) + 1) / 2, 0)
    if result.edges is not None:
        colours[result.edges.astype(bool)] = 0, 0, 0, 1
        finite = finite | result.edges.astype(bool)
    colours[~finite, 3] = 0
    draw_image(axes, colours, extent(x, y))
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{name}; black: edges, blue: no answer")


def _draw_key(axes: Axes) -> None:
    """Draw the colours of a half-sphere seen from above, as a key."""
    across, up = np.meshgrid(*2 * [np.linspace(-1, 1, 101)])
    height = np.sqrt(np.maximum(0, 1 - across**2 - up**2))
    colours = (np.stack([across, up, height, np.ones_like(up)], axis=-1) + 1) / 2
    colours[across**2 + up**2 > 1, 3] = 0
    axes.imshow(colours, extent=(-1, 1, -1, 1), origin="lower")
    axes.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], xlabel="n_x", ylabel="n_y", title="normal")
    axes.yaxis.tick_right()
    axes.yaxis.set_label_position("right")
    axes.spines[:].set_visible(False)


def _draw_needles(axes: Axes, result: Result) -> None:
    normals, x, y = _maps(result)
    step = max(1, max(normals.shape[:2]) // _NEEDLES)
    shown = normals[step // 2 :: step, step // 2 :: step]
    valid = np.isfinite(shown).all(axis=-1)
    if result.contact is not None:
        valid &= result.contact[step // 2 :: step, step // 2 :: step].astype(bool)
    across, up = np.meshgrid(x[step // 2 :: step], y[step // 2 :: step])
    pixel = step * abs(x[1] - x[0])
    axes.plot(across[valid], up[valid], ".", ms=2.5, color="tab:red")
    axes.quiver(
        across[valid],
        up[valid],
        shown[valid][:, 0],
        shown[valid][:, 1],
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


def _draw_angles(axes: Axes, result: Result, error: Floats, shared: NDArray[np.bool_], worst: float) -> None:
    _, x, y = _maps(result)
    finite, common = error[np.isfinite(error)], error[shared]
    note = (
        f"median {np.median(finite):.2f} deg of all {finite.size} px"
        if finite.size
        else "no pixel in contact"
    )
    if common.size:
        note = f"median {np.median(common):.2f} deg of the {common.size} px that all answer\n{note}"
    draw_image(axes, error, extent(x, y), "angle to the truth (deg)", "max", cmap=ERROR, vmin=0, vmax=worst)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{note}; blue: no answer")


_MICROMETRES = 1e3  # per millimetre


def surface_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw a surface, and the results that lead to it, into a PNG.

    The last result is drawn in 3D, as in Fig. 10 (b) of the paper, as shaded heights, and as the difference
    from the truth; all are cut across the middle, with the errors of these cuts below. Filled
    heights are orange or open; undefined pixels stay empty.

    Parameters
    ----------
    results : mapping
        Results with ``height``, ``x`` and ``y`` by name. A component of unknown offset is moved to the
        mean height of the truth.
    truth : Truth
        Truth of the same size.
    title : str
    path : Path
        PNG to write.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no heights or axes, or the file cannot be written.
    """
    save_figure(_draw_surfaces(results, truth), title, path)


def _draw_surfaces(results: Mapping[str, Result], truth: Truth) -> Figure:
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    last = list(reliefs)[-1]
    figure = new_figure(13, 10)
    grid = figure.add_gridspec(2, 2)
    draw_surface(figure.add_subplot(grid[0, 0], projection="3d"), last, reliefs[last])
    draw_map(figure.add_subplot(grid[0, 1]), last, reliefs[last])
    _draw_height_errors(figure.add_subplot(grid[1, 0]), reliefs[last], truth)
    cuts = grid[1, 1].subgridspec(2, 1, height_ratios=[2, 1])
    above = figure.add_subplot(cuts[0])
    draw_cuts(above, reliefs, truth)
    above.tick_params(labelbottom=False)
    above.set_xlabel("")
    _draw_errors_on_row(figure.add_subplot(cuts[1], sharex=above), reliefs, truth)
    return figure


def _draw_height_errors(axes: Axes, relief: Relief, truth: Truth) -> None:
    error = _MICROMETRES * (relief.height - truth.height)
    finite = error[np.isfinite(error)]
    worst = float(np.percentile(np.abs(finite), _WORST)) if finite.size else 1.0
    note = f"RMS {np.sqrt(np.mean(finite**2)):.1f} \N{MICRO SIGN}m" if finite.size else "no pixel answered"
    place, label = extent(relief.x, relief.y), "height - truth (\N{MICRO SIGN}m)"
    draw_image(axes, error, place, label, cmap=DIVERGING, vmin=-worst, vmax=worst)
    if relief.filled.any():
        marks = relief.filled.astype(float)
        axes.contour(relief.x, relief.y, marks, levels=[0.5], colors=FILLED, linewidths=1)
        note += ", orange: round what was filled"
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"error: {note}\nblue: no answer")


def _draw_errors_on_row(axes: Axes, reliefs: Mapping[str, Relief], truth: Truth) -> None:
    row = len(truth.height) // 2
    errors = {
        name: _MICROMETRES * (relief.height[row] - truth.height[row]) for name, relief in reliefs.items()
    }
    axes.axhline(0, color="0.6", lw=3)
    dots_on_row(axes, errors, reliefs)
    last = np.abs(list(errors.values())[-1])
    worst = np.percentile(last[np.isfinite(last)], _WORST) if np.isfinite(last).any() else 1.0
    axes.set_ylim(-2.5 * worst - 1, 2.5 * worst + 1)
    axes.set(xlabel="x (mm)", ylabel="error (\N{MICRO SIGN}m)")
    axes.grid(alpha=0.3)
