"""Graphs of the heights of a result: a section, and a histogram."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.view.drawing.canvas import BESIDE, round_length
from mirrorskin.view.drawing.colours import FILLED, apart, span
from mirrorskin.view.result.maps import outlined
from mirrorskin.view.result.scale import title_of_height
from mirrorskin.view.result.sheet import BOX, SMALL, TEXT, Sheet, entitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mirrorskin.engine.metrology import Section

_ROOM = 1.15  # range of the axis, relative to the range of the heights
_TIMES = 2  # standard deviations on either side: the expanded uncertainty, k = 2
_AT_APEX = 2.0  # pixels from the highest point within which a section passes through it
_TAIL = 0.1  # excess of the histogram's range over the range of the colours
_NEAR = 0.1  # of the width: labels closer to a side are aligned inwards


def draw_section(axes: Axes, sheet: Sheet, profile: Section) -> None:
    """Draw heights along a section, with a band of two standard deviations, whose width the legend states.

    Filled heights are dashed; a hole is a gap; the highest point is marked.
    """
    scale = sheet.of_height.figure_scale
    height, sigma = scale * profile.height, scale * profile.sigma
    measured = np.where(profile.filled, np.nan, height)
    if np.isfinite(measured).any():
        axes.plot(profile.distance, measured, color="tab:blue", lw=1.5, label="measured")
        _draw_apex(axes, sheet, profile)
    if profile.filled.any():
        axes.plot(
            profile.distance,
            _joined(height, profile.filled),
            color=FILLED,
            ls=(0, (2, 1)),
            lw=1.5,
            label="filled",
        )
    if np.isfinite(profile.sigma).any():
        band = measured - _TIMES * sigma, measured + _TIMES * sigma
        width, unit = sheet.height_text(_TIMES * float(np.nanmedian(profile.sigma))).split(" ", 1)
        label = f"± {_TIMES} sigma: {float(width):.2g} {unit}"
        axes.fill_between(profile.distance, *band, color="tab:blue", alpha=0.25, lw=0, label=label)
    note = _stretch(axes, sheet, profile)
    for name, end in (("A", 0), ("B", 1)):
        axes.annotate(
            name,
            (end, 0),
            (0, -17),
            "axes fraction",
            "offset points",
            fontsize=TEXT,
            weight="bold",
            ha="center",
            va="top",
        )
    axes.set_xlabel(f"distance from A ({sheet.unit})", fontsize=TEXT)
    axes.set_ylabel(f"{title_of_height(sheet)} ({sheet.of_height.figure_unit})", fontsize=TEXT)
    axes.tick_params(labelsize=SMALL)
    axes.grid(alpha=0.3)
    if np.isfinite(profile.height).any():
        axes.legend(fontsize=SMALL, **BESIDE)
    entitle(axes, "Section", f"{_ends(profile, sheet.unit)}{note}")


def _joined(height: Floats, filled: NDArray[np.bool_]) -> Floats:
    """Return the filled heights, and the adjacent measured ones, so that the lines connect."""
    near: NDArray[np.bool_] = filled.copy()
    near[1:] |= filled[:-1]
    near[:-1] |= filled[1:]
    return np.where(near, height, np.nan)


def _draw_apex(axes: Axes, sheet: Sheet, profile: Section) -> None:
    """Mark the highest point of the surface, if the section has it, or that of the section."""
    distance = profile.distance
    top, height, label = _highest_point(sheet, profile)
    drawn = sheet.of_height.figure_scale * height
    axes.plot(distance[top], drawn, "v", color="tab:red", ms=5, label=label)
    position = (distance[top] - distance[0]) / (distance[-1] - distance[0] or 1.0)
    axes.annotate(
        sheet.height_text(height),
        (float(distance[top]), drawn),
        (0, 6),
        textcoords="offset points",
        ha="left" if position < _NEAR else "right" if position > 1 - _NEAR else "center",
        fontsize=SMALL,
        color="tab:red",
        path_effects=outlined(2.5),
    )


def _highest_point(sheet: Sheet, profile: Section) -> tuple[int, float, str]:
    """Return the sample, the height in mm and the name of the point to mark."""
    from mirrorskin.engine.metrology import highest_point

    top = int(np.nanargmax(np.where(profile.filled, np.nan, profile.height)))
    if profile.unit == "mm":
        point = highest_point(sheet.result)
        near = np.hypot(profile.x - point.x, profile.y - point.y)
        if np.min(near) <= _AT_APEX * float(profile.distance[1] - profile.distance[0]):
            return int(np.argmin(near)), point.height.value, "highest point"
    return top, float(profile.height[top]), "highest on A-B"


def _stretch(axes: Axes, sheet: Sheet, profile: Section) -> str:
    """Set the limits of the panel so that the vertical exaggeration is a round number; return it as text.

    Equal heights are drawn to scale.
    """
    axes.set_box_aspect(BOX)
    length = float(profile.distance[-1] - profile.distance[0]) or 1.0
    axes.set_xlim(float(profile.distance[0]), float(profile.distance[0]) + length)
    finite = profile.height[np.isfinite(profile.height)]
    scale = sheet.of_height.figure_scale
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    equal = apart(low, high) != (low, high)
    if sheet.unit != sheet.of_height.unit or not finite.size:
        axes.margins(y=0.2)
        if equal:
            axes.set_ylim(*(scale * end for end in apart(low, high)))
        return ""
    times = 1.0 if equal else round_length(BOX * length / max(_ROOM * (high - low), 1e-6))
    half = BOX * length / times / 2
    middle = (low + high) / 2
    axes.set_ylim(scale * (middle - half), scale * (middle + half))
    return f"; {stretched(times)}"


def stretched(times: float) -> str:
    """Return a vertical exaggeration as text."""
    if times == 1:
        return "true to scale"
    return f"heights stretched {times:g} times" if times > 1 else f"heights shrunk {1 / times:g} times"


def _ends(profile: Section, unit: str) -> str:
    """Return the ends of the section as text."""
    a, b = (f"({profile.x[place]:.3g}, {profile.y[place]:.3g})" for place in (0, -1))
    return f"A {a} to B {b} {unit}"


_BINS = 60


def draw_histogram(axes: Axes, sheet: Sheet) -> None:
    """Draw a histogram of heights, filled ones stacked on measured ones."""
    height = sheet.result.height
    assert height is not None
    scale = sheet.of_height.figure_scale
    parts = [height[np.isfinite(height) & (sheet.filled == filled)] for filled in (False, True)]
    finite = np.concatenate(parts)
    low, high = _shown(finite)
    beyond = int(np.count_nonzero((finite < low) | (finite > high)))
    shown = finite[(finite >= low) & (finite <= high)]
    ends = (float(shown.min()), float(shown.max())) if shown.size else (0.0, 1.0)
    bins = np.histogram_bin_edges(shown, _BINS, apart(*ends))
    counts = [np.histogram(part, bins)[0] for part in parts]
    names = ("measured", "tab:blue"), ("filled", FILLED)
    below = np.zeros(_BINS)
    for count, (name, colour) in zip(counts, names, strict=True):
        if count.any():
            axes.stairs(below + count, scale * bins, baseline=below, fill=True, color=colour, label=name)
        below = below + count
    axes.set_xlabel(f"{title_of_height(sheet)} ({sheet.of_height.figure_unit})", fontsize=TEXT)
    axes.set_ylabel("pixels", fontsize=TEXT)
    axes.tick_params(labelsize=SMALL)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_box_aspect(BOX)
    if finite.size:
        axes.legend(fontsize=SMALL, **BESIDE)
    sigma = sheet.result.height_sigma
    notes = [f"median {sheet.height_text(float(np.median(finite)))}"] if finite.size else ["no answer"]
    if sigma is not None and np.isfinite(sigma).any():
        declared = sheet.result.declaration(sheet.result.name_of("height_sigma") or "height_sigma")
        error = declared.figure_scale * np.nanmedian(sigma)
        notes.append(f"median expected error {error:.3g} {declared.figure_unit}")
    if beyond:
        notes.append(f"{beyond} pixels beyond")
    entitle(axes, "Distribution of heights", "; ".join(notes))


def _shown(finite: Floats) -> tuple[float, float]:
    """Return the range of heights, except for a few pixels far from all others."""
    low, high = apart(*span(finite))
    margin = _TAIL * (high - low)
    return low - margin, high + margin
