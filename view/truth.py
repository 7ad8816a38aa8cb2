"""Figures that compare heights with the truth of a simulation: maps, surfaces, sections, errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.base.types import Floats
from mirrorskin.view.drawing.canvas import (
    Extent,
    draw_image,
    exceeded,
    explain_colours,
    explain_heights,
    extent,
    filled_colours,
    new_figure,
    round_length,
    save_figure,
)
from mirrorskin.view.drawing.colours import DIVERGING, SEQUENTIAL, apart, span
from mirrorskin.view.result.maps import outlined
from mirrorskin.view.result.section import stretched
from mirrorskin.view.result.sheet import SMALL, TEXT, entitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

WIDTH = 10.0
"""Width of a figure, inches: two columns of a journal, with letters that are read at three quarters of it."""
RESOLUTION = 1.3
"""Pixels per inch, relative to other figures."""
WORST = 98
"""Percentile of the errors at the end of the colour scale."""

_MESH = 160  # samples of a surface along its longer side
_TALL = 0.55  # greatest height of a surface, relative to its width
_FACING = 30, -60  # elevation and azimuth of the view of a surface, degrees
_SHADE = 0.7  # darkest shade of a surface's colours
_MARGIN = 0.06  # around what is drawn, relative to its width
_BAR = 0.07  # width of a column for colour bars, relative to that of a map
_NEAR = 0.6  # from the middle of the heights, relative to their range without outliers
_DWARFED = 5.0  # ratio of errors above which the axis does not hold the larger ones
_ABOVE = 1.4  # end of the axis of errors, relative to the largest one
_SIDE, _TOP = 2.85, 0.31  # square around a surface, and its distance from the upper edge, inches
_TITLED = 0.81  # height of the title in that square
_LEAST = 1e-6  # end of a scale of errors that are all 0, mm
_MICROMETRES = 1e3  # per millimetre

# Distinct for colour-blind eyes, and none is the orange of filled heights.
_COLOURS = "#0072b2", "#882255", "#009e73", "#56b4e9"
_MARKERS = "o", "s", "^", "D"
_TRUTH = "0.7"

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
        """Return notes on the share of filled heights, undefined pixels, and the level."""
        percentage = 100 * float(self.filled.sum()) / max(1.0, float(np.isfinite(self.height).sum()))
        filled = [f"filled: {percentage:.0f} %"] if self.filled.any() else []
        holes = [f"{missing}: no answer"] if missing and not np.isfinite(self.height).all() else []
        return "; ".join([*filled, *holes, *(["mean height set to the true one"] if self.levelled else [])])

    @property
    def measured(self) -> Relief:
        """The same without filled heights."""
        height = np.where(self.filled, np.float32(np.nan), self.height)
        return replace(self, height=height, filled=np.zeros_like(self.filled))

    def errors(self, truth: Truth) -> Floats:
        """Return the differences from the truth, mm, (H, W)."""
        return np.asarray(self.height.astype(np.float64) - truth.height)


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


def check_same_size(shape: tuple[int, ...], truth: NDArray[np.float32]) -> None:
    """Raise InputError if a result and the truth have different sizes."""
    if truth.shape != shape:
        raise InputError(f"the result is {shape} pixels, the truth {truth.shape}: not of one stack")


def window(shown: NDArray[np.bool_], x: Floats, y: Floats) -> Extent:
    """Return the part of the field with pixels to show: left, right, bottom and top, with a margin."""
    whole = extent(x, y)
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if not rows.size:
        return whole
    left, right, bottom, top = x[columns[0]], x[columns[-1]], y[rows[-1]], y[rows[0]]
    margin = _MARGIN * max(right - left, top - bottom) + abs(x[1] - x[0])
    return (
        max(whole[0], float(left - margin)),
        min(whole[1], float(right + margin)),
        max(whole[2], float(bottom - margin)),
        min(whole[3], float(top + margin)),
    )


def lay_out(axes: Axes, place: Extent | None = None) -> None:
    """Set the axes of a panel, and of a map to a part of the field."""
    if place is not None:
        axes.set(xlim=place[:2], ylim=place[2:], aspect="equal")
        axes.set_ylabel("y (mm)")
    axes.set_xlabel("x (mm)")
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_fontsize(TEXT)
    axes.tick_params(labelsize=SMALL)


def draw_map(axes: Axes, relief: Relief, limits: Range, place: Extent) -> None:
    """Draw heights between limits by colour, filled ones in shades of orange, and the middle row."""
    for filled, shades in ((False, SEQUENTIAL), (True, filled_colours())):
        shown = np.where(relief.filled == filled, relief.height, np.nan)
        if not filled or relief.filled.any():
            colours: dict[str, Any] = {"cmap": shades, "vmin": limits[0], "vmax": limits[1]}
            draw_image(axes, shown, extent(relief.x, relief.y), interpolation="antialiased", **colours)
    row = float(relief.y[len(relief.y) // 2])
    axes.axhline(row, color="black", lw=1, ls=(0, (6, 3)), path_effects=outlined(2.5))
    lay_out(axes, place)


def draw_surface(axes: Axes3D, relief: Relief, limits: Range, place: Extent) -> str:
    """Draw heights between limits as a surface; filled ones are orange. Return a note on its scale."""
    inside = [
        slice(*(np.flatnonzero((along >= low) & (along <= high))[[0, -1]] + (0, 1)))
        for along, low, high in ((relief.y, *place[2:]), (relief.x, *place[:2]))
    ]
    rows, columns = inside
    step = max(1, max(along.stop - along.start for along in inside) // _MESH)
    height = relief.height[rows, columns][::step, ::step]
    filled = relief.filled[rows, columns][::step, ::step]
    beyond = (height < limits[0]) | (height > limits[1])
    shown = np.where(beyond, np.nan, height)
    across, up = np.meshgrid(relief.x[columns][::step], relief.y[rows][::step])
    # A single surface with two colour maps, because Matplotlib does not sort two surfaces by depth.
    colours = _colours(shown, filled, limits, across[0], up[:, 0])
    style = {"rstride": 1, "cstride": 1, "linewidth": 0, "antialiased": False, "shade": False}
    axes.plot_surface(across, up, shown, facecolors=colours, **style)
    sides = place[1] - place[0], place[3] - place[2]
    depth = limits[1] - limits[0]
    times = round_length(_TALL * max(sides) / depth)
    axes.set_box_aspect((*sides, times * depth), zoom=0.9)
    axes.view_init(*_FACING)
    axes.set(xlim=place[:2], ylim=place[2:], zlim=limits)
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis), ("z", axes.zaxis)):
        axis.set_label_text(f"{name} (mm)", fontsize=TEXT)
        axis.labelpad = -4
        axes.tick_params(axis=name, labelsize=SMALL, pad=-2)
        axes.locator_params(axis=name, nbins=4)
        axis.set_pane_color((1, 1, 1, 0))
        axis._axinfo["grid"].update(color="0.85", linewidth=0.6)
    notes = [stretched(times)]
    for where, far in (("below", relief.height < limits[0]), ("above", relief.height > limits[1])):
        if far.any():
            notes.append(f"{np.count_nonzero(far)} px {where} the axis")
    return "; ".join(notes)


def _colours(
    height: NDArray[np.float32], filled: NDArray[np.bool_], limits: Range, x: Floats, y: Floats
) -> Floats:
    """Return the colours of a surface, (H, W, 4): by height, orange if filled, with light from the left."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource, Normalize

    level = Normalize(*limits, clip=True)(np.nan_to_num(height, nan=limits[0]))
    colours = np.where(filled[..., np.newaxis], filled_colours()(level), colormaps[SEQUENTIAL](level))
    light = LightSource(135, 45).hillshade(height, dx=abs(x[1] - x[0]), dy=-abs(y[1] - y[0]))
    colours[..., :3] *= _SHADE + (1 - _SHADE) * np.nan_to_num(np.ma.filled(light, 1), nan=1)[..., np.newaxis]
    return np.asarray(colours)


def draw_height_bars(
    axes: Axes, limits: Range, reliefs: Sequence[Relief], place: tuple[float, float] = (1.04, 0.08)
) -> None:
    """Draw the colours of measured and of filled heights, on one scale."""
    beyond = exceeded(np.concatenate([relief.height.ravel() for relief in reliefs]), *limits)
    filled = any(relief.filled.any() for relief in reliefs)
    explain_heights(axes, limits, "height (mm)", beyond, filled=filled, text=SMALL, place=place)
    for bar in axes.child_axes:
        bar.tick_params(labelsize=SMALL)
        bar.yaxis.label.set_fontsize(TEXT)


def _draw_height_errors(
    axes: Axes, relief: Relief, truth: Truth, place: Extent, worst: float, bar: bool = True
) -> str:
    """Draw differences from the truth up to the worst, mm; return a note on their size."""
    factor, unit = _unit(worst)
    error = factor * relief.errors(truth)
    end = factor * worst
    picture = draw_image(axes, error, extent(relief.x, relief.y), cmap=DIVERGING, vmin=-end, vmax=end)
    if bar:
        explain_colours(axes, picture, f"height \N{MINUS SIGN} truth ({unit})", exceeded(error, -end, end))
        axes.child_axes[-1].tick_params(labelsize=SMALL)
        axes.child_axes[-1].yaxis.label.set_fontsize(TEXT)
    notes = []
    for filled, name in ((False, "RMS"), (True, "filled")):
        part = relief.errors(truth)[np.isfinite(error) & (relief.filled == filled)]
        if part.size:
            notes.append(f"{name} {_rms(part)}")
    if relief.filled.any():
        marks = relief.filled.astype(float)
        axes.contour(relief.x, relief.y, marks, levels=[0.5], colors="black", linewidths=0.6)
        notes[-1] += " (outlined)"
    lay_out(axes, place)
    return ", ".join(notes) or "no pixel answered"


def _worst(reliefs: Sequence[Relief], truth: Truth) -> float:
    """Return the error at the ends of the colour scale, mm."""
    return _high(np.concatenate([relief.errors(truth).ravel() for relief in reliefs]))


def _high(errors: Floats) -> float:
    """Return a high percentile of the sizes of errors, mm, above 0."""
    sizes = np.abs(errors[np.isfinite(errors)])
    return (float(np.percentile(sizes, WORST)) if sizes.size else 0.0) or _LEAST


def _unit(length: float) -> tuple[float, str]:
    """Return the factor and the unit in which lengths of that size, mm, are drawn."""
    return (1.0, "mm") if length >= 1 else (_MICROMETRES, "\N{MICRO SIGN}m")


def _draw_section(
    axes: Axes,
    reliefs: Mapping[str, Relief],
    truth: Truth,
    limits: Range | None,
    place: Extent,
    first_travel: float | None,
) -> None:
    """Draw heights on the middle row with the truth, and the height that the first frame touches."""
    row = len(truth.height) // 2
    any_relief = next(iter(reliefs.values()))
    axes.plot(any_relief.x, truth.height[row], color=_TRUTH, lw=3, label="truth")
    _draw_on_row(axes, {name: relief.height[row] for name, relief in reliefs.items()}, reliefs)
    low, high = limits or _range(list(reliefs.values()))
    if limits is None:
        high = max(high, float(truth.height[row].max()))
    margin = _MARGIN * (high - low)
    axes.set(xlim=place[:2], ylim=(low - margin * (limits is None), high + 2 * margin))
    axes.set_ylabel("height (mm)")
    lay_out(axes)
    axes.grid(alpha=0.3)
    if first_travel is not None:
        axes.axhline(-first_travel, color="black", lw=1, ls=":")


def _style(number: int) -> dict[str, Any]:
    """Return the marker and colour of a result."""
    return {"marker": _MARKERS[number % len(_MARKERS)], "color": _COLOURS[number % len(_COLOURS)], "ls": ""}


def _draw_on_row(axes: Axes, values: Mapping[str, NDArray[Any]], reliefs: Mapping[str, Relief]) -> None:
    """Draw values along the middle row, (W,), with a marker and colour for each relief."""
    for number, (name, relief) in enumerate(reliefs.items()):
        filled = relief.filled[len(relief.filled) // 2]
        # The first one is on top, and small enough not to hide the others.
        style = {"ms": 2.2 + 0.9 * number, "zorder": 9 - number, **_style(number)}
        axes.plot(relief.x, np.where(filled, np.nan, values[name]), mew=0, label=name, **style)
        if filled.any():
            axes.plot(relief.x, np.where(filled, values[name], np.nan), mfc="none", mew=0.7, **style)


def _draw_errors_on_row(axes: Axes, reliefs: Mapping[str, Relief], truth: Truth, place: Extent) -> str:
    """Draw errors on the middle row; return a note on those that exceed the axis."""
    row = len(truth.height) // 2
    errors = {name: relief.errors(truth)[row] for name, relief in reliefs.items()}
    worst = {name: _high(error) for name, error in errors.items()}
    last = list(worst.values())[-1]
    side = _ABOVE * max(value for value in worst.values() if value <= _DWARFED * last)
    factor, unit = _unit(side)
    axes.axhline(0, color=_TRUTH, lw=3)
    _draw_on_row(axes, {name: factor * error for name, error in errors.items()}, reliefs)
    axes.set(xlim=place[:2], ylim=(-factor * side, factor * side))
    axes.set_ylabel(f"height \N{MINUS SIGN} truth ({unit})")
    lay_out(axes)
    axes.grid(alpha=0.3)
    counts = {name: int(np.count_nonzero(np.abs(error) > side)) for name, error in errors.items()}
    return "; ".join(f"{name}: {count} px beyond the axis" for name, count in counts.items() if count)


def _draw_legend(
    figure: Figure, reliefs: Mapping[str, Relief], truth: Truth, first_travel: float | None
) -> None:
    """Draw the legend of the sections below all panels, with the RMS error of all measured heights."""
    from matplotlib.lines import Line2D

    handles = []
    for number, (name, relief) in enumerate(reliefs.items()):
        style = _style(number)
        errors = relief.measured.errors(truth)
        label = f"{name}: RMS error {_rms(errors[np.isfinite(errors)])}"
        handles.append(Line2D([], [], ms=6, mew=0, label=label, **style))
    handles.append(Line2D([], [], color=_TRUTH, lw=3, label="truth"))
    if any(relief.filled[len(relief.filled) // 2].any() for relief in reliefs.values()):
        handles.append(Line2D([], [], ls="", marker="o", color="0.3", mfc="none", ms=6, label="open: filled"))
    if first_travel is not None:
        label = f"first frame, at {first_travel:g} mm: nothing higher is measured"
        handles.append(Line2D([], [], color="black", lw=1, ls=":", label=label))
    columns = _columns(len(reliefs))
    by_column = [handle for column in range(columns) for handle in handles[column::columns]]
    figure.legend(
        handles=by_column,
        loc="lower center" if figure.get_layout_engine() is None else "outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=SMALL + 1,
    )


def _columns(count: int) -> int:
    """Return the number of columns of the legend of so many results."""
    return 3 if count < 4 else 2


def _rms(errors: Floats) -> str:
    """Return the root mean square of errors, mm, as text."""
    return _text(float(np.sqrt(np.mean(errors**2)))) if errors.size else "unknown"


def _text(length: float) -> str:
    """Return a length, mm, as text."""
    factor, unit = _unit(length)
    digits = 2 if factor > 1 and factor * length < 10 else 3
    return f"{float(f'{factor * length:.{digits}g}'):g} {unit}"


def _range(reliefs: Sequence[Relief]) -> Range:
    """Return the range of all heights, except for a few outliers."""
    ends = []
    for relief in reliefs:
        low, high = span(relief.height)
        near = np.abs(relief.height - (low + high) / 2) <= _NEAR * (high - low)
        ends += [relief.height[near].min(), relief.height[near].max()] if near.any() else [low, high]
    return apart(float(min(ends)), float(max(ends)))


def height_figure(
    results: Mapping[str, Result],
    truth: Truth,
    title: str,
    path: Path,
    *,
    surface: bool = False,
    detail: Range | None = None,
    first_travel: float | None = None,
) -> None:
    """Draw heights, their errors, and sections through the middle with the truth, into a PNG.

    Parameters
    ----------
    results : mapping
        Results with ``height``, ``x`` and ``y`` by name. The first and the last are drawn whole, the
        sections show all. ``filled`` heights have their own colours; components of unknown offset are moved
        to the mean of the truth.
    truth : Truth
        Truth of the same size.
    title : str
    path : Path
        PNG to write.
    surface : bool
        Draw surfaces in space, as in Fig. 5 (a) of the paper, instead of maps as in its Fig. 6,
        with one vertical scale; the first also without filled heights.
    detail : (float, float), optional
        Heights, mm, at the ends of the colours of maps, and of a second section in place of its errors.
    first_travel : float, optional
        Travel of the press at its first frame, mm, to be marked in sections: nothing higher is measured.

    Raises
    ------
    InputError
        Matplotlib is not installed, a result has no heights or axes, or the file cannot be written.
    """
    draw = _draw_in_space if surface else _draw_maps
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    save_figure(draw(reliefs, truth, detail, first_travel), title, path, RESOLUTION)


def _first_and_last(reliefs: Mapping[str, Relief]) -> dict[str, Relief]:
    names = list(reliefs)
    return {name: reliefs[name] for name in (names[0], names[-1])}


def _place(reliefs: Sequence[Relief]) -> Extent:
    """Return the part of the field in which any height is defined."""
    shown = np.logical_or.reduce([np.isfinite(relief.height) for relief in reliefs])
    return window(shown, reliefs[0].x, reliefs[0].y)


def _draw_maps(
    reliefs: Mapping[str, Relief], truth: Truth, detail: Range | None, first_travel: float | None
) -> Figure:
    """Draw heights, errors below them, and sections to their right."""
    whole = _first_and_last(reliefs)
    every = list(whole.values())
    place, limits, worst = _place(list(reliefs.values())), detail or _range(every), _worst(every, truth)
    figure = new_figure(WIDTH, 6.6)
    grid = figure.add_gridspec(2, len(whole) + 1, width_ratios=[*[1] * len(whole), 1.15])
    letters = iter("abcdef")
    for column, (name, relief) in enumerate(whole.items()):
        axes = figure.add_subplot(grid[0, column])
        draw_map(axes, relief, limits, place)
        if column == len(whole) - 1:
            draw_height_bars(axes, limits, every)
        entitle(axes, f"{next(letters)}  {name}", relief.notes("blue"))
    section = figure.add_subplot(grid[0, -1])
    _draw_section(section, reliefs, truth, None, place, first_travel)
    entitle(section, f"{next(letters)}  section", "along the dashed line")
    for column, relief in enumerate(every):
        axes = figure.add_subplot(grid[1, column])
        note = _draw_height_errors(axes, relief, truth, place, worst, bar=column == len(every) - 1)
        entitle(axes, f"{next(letters)}  error of {'ab'[column]}", note)
    below = figure.add_subplot(grid[1, -1])
    if detail is None:
        note = _draw_errors_on_row(below, reliefs, truth, place)
        entitle(below, f"{next(letters)}  errors on the section", note)
    else:
        _draw_section(below, reliefs, truth, detail, place, first_travel)
        entitle(below, f"{next(letters)}  section, enlarged", "along the dashed line")
    _draw_legend(figure, reliefs, truth, first_travel)
    return figure


def _draw_in_space(
    reliefs: Mapping[str, Relief], truth: Truth, detail: Range | None, first_travel: float | None
) -> Figure:
    """Draw surfaces on one scale, the first also without filled heights; below, sections and their errors."""
    panels = list(_first_and_last(reliefs).items())
    first, relief = panels[0]
    if relief.filled.any():
        panels = [(first, relief.measured), ("the same, holes filled", relief), *panels[1:]]
    every = [relief for _, relief in panels]
    place, limits = _place(list(reliefs.values())), detail or _range(every)
    figure = _new_figure_in_space(len(reliefs))
    letters = iter("abcde")
    for column, (name, relief) in enumerate(panels):
        axes = _add_surface(figure, 0.15 + column * _SIDE)
        note = draw_surface(axes, relief, limits, place)
        holes = "" if relief.filled.any() or np.isfinite(relief.height).all() else "; holes: no answer"
        entitle(axes, f"{next(letters)}  {name}", f"{note}{holes}", _TITLED)
    bars = _add_panel(figure, len(panels) * _SIDE + 0.4, 0.95, 0.15, 1.9)
    bars.set_axis_off()
    draw_height_bars(bars, limits, every, (0, 1))
    _draw_two_sections(figure, reliefs, truth, place, letters, first_travel)
    return figure


def _new_figure_in_space(count: int) -> Figure:
    """Return a figure whose panels are placed in inches: no layout engine knows how far a surface reaches."""
    figure = new_figure(WIDTH, 6.7 if _columns(count) > 2 else 6.95)
    figure.set_layout_engine("none")
    return figure


def _add_panel(figure: Figure, left: float, top: float, width: float, height: float, **options: Any) -> Any:
    """Add a panel, in inches from the upper left corner of the figure."""
    across, up = figure.get_size_inches()
    return figure.add_axes((left / across, 1 - (top + height) / up, width / across, height / up), **options)


def _add_surface(figure: Figure, left: float) -> Axes3D:
    """Add a panel for a surface; what it shows fills the middle of a square that reaches below the row."""
    axes: Axes3D = _add_panel(figure, left, _TOP, _SIDE, _SIDE, projection="3d")
    axes.patch.set_visible(False)
    return axes


def _draw_two_sections(
    figure: Figure,
    reliefs: Mapping[str, Relief],
    truth: Truth,
    place: Extent,
    letters: Iterator[str],
    first_travel: float | None = None,
) -> None:
    """Draw sections and their errors next to each other, and the legend."""
    section, errors = (_add_panel(figure, left, 3.62, 4.05, 2.0) for left in (0.8, 5.8))
    _draw_section(section, reliefs, truth, None, place, first_travel)
    levelled = [name for name, relief in reliefs.items() if relief.levelled]
    whose = "" if len(levelled) == len(reliefs) else f"{', '.join(levelled)}: "
    note = f"through the middle; {whose}mean height set to the true one" if levelled else "through the middle"
    entitle(section, f"{next(letters)}  section", note)
    note = _draw_errors_on_row(errors, reliefs, truth, place)
    entitle(errors, f"{next(letters)}  errors on the section", note)
    _draw_legend(figure, reliefs, truth, first_travel)


def surface_figure(results: Mapping[str, Result], truth: Truth, title: str, path: Path) -> None:
    """Draw a surface, and the results that lead to it, into a PNG.

    The last result is drawn in space, as in Fig. 10 (b) of the paper, as a map, and as the difference from
    the truth; the sections through the middle, and their errors, show all results. Filled heights are orange
    or open; undefined pixels stay empty.

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
    save_figure(_draw_surfaces(results, truth), title, path, RESOLUTION)


def _draw_surfaces(results: Mapping[str, Result], truth: Truth) -> Figure:
    reliefs = {name: relief_of(result, truth) for name, result in results.items()}
    name, last = list(reliefs.items())[-1]
    place, limits = _place([last]), _range([last])
    figure = _new_figure_in_space(len(reliefs))
    surface = _add_surface(figure, 0.15)
    entitle(surface, f"a  {name}", draw_surface(surface, last, limits, place), _TITLED)
    heights, errors = (_add_panel(figure, left, 0.85, 1.95, 1.95) for left in (3.85, 7.2))
    draw_map(heights, last, limits, place)
    draw_height_bars(heights, limits, [last])
    entitle(heights, "b  height", last.notes("blue"))
    note = _draw_height_errors(errors, last, truth, place, _worst([last], truth))
    errors.set_ylabel("")
    entitle(errors, "c  error", note)
    _draw_two_sections(figure, reliefs, truth, place, iter("de"))
    return figure
