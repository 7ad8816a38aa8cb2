"""Maps of a result, drawn according to their declarations: heights, normals, vectors, codes, numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.io.model.maps import Map
from mirrorskin.view.drawing.canvas import draw_classes, explain_heights, filled_colours, round_length
from mirrorskin.view.drawing.colours import (
    MISSING,
    MISSING_RGB,
    SEQUENTIAL,
    Colours,
    normal_colours,
)
from mirrorskin.view.result.scale import Scale, displayed_values, scale_of, title_of_height
from mirrorskin.view.result.sheet import SMALL, TEXT, Sheet, draw_map, entitle, lay_out, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mirrorskin.engine.metrology import Section

_BAR = 0.3  # longest scale bar, relative to the picture's width
_MARGIN = 0.05
_EDGE = 0.1  # space for a letter, relative to the picture's width


def draw_height(axes: Axes, sheet: Sheet, profile: Section | None = None) -> None:
    """Draw heights by colour, with a scale bar, and the line of the section."""
    height = sheet.result.height
    assert height is not None
    scale = scale_of(sheet, sheet.result.name_of("height") or "height")
    ends = scale.low / sheet.of_height.figure_scale, scale.high / sheet.of_height.figure_scale
    draw_map(axes, sheet, height_picture(height, sheet.filled, ends), interpolation="antialiased")
    filled = bool(sheet.filled.any())
    place = (1.03, 0.05 if filled else 0.04)
    span = scale.low, scale.high
    explain_heights(axes, span, scale.label, scale.beyond, filled=filled, text=SMALL, place=place)
    if sheet.true_to_scale and sheet.unit == "mm" and height.size > 1:
        _draw_scale(axes, sheet)
    if profile is not None:
        _draw_line(axes, sheet, profile)
    lay_out(axes, sheet)
    title = title_of_height(sheet)
    entitle(axes, f"{title[:1].upper()}{title[1:]}", "; ".join(_notes(sheet)))


def _notes(sheet: Sheet) -> Iterator[str]:
    """Yield notes on the colours, and on the zero of the heights."""
    result, filled = sheet.result, sheet.filled
    assert result.height is not None
    if filled.any():
        yield f"orange: filled ({percent(int(np.count_nonzero(filled)), filled.size)})"
    missing = int(np.count_nonzero(~np.isfinite(result.height)))
    if missing:
        yield f"blue: no answer ({percent(missing, filled.size)})"
    unknown = result.offset_unknown
    if unknown is not None and unknown.any():
        pieces = "each piece" if unknown.all() else f"{np.count_nonzero(unknown)} of {unknown.size} pieces"
        yield "mean 0" if unknown.size == 1 else f"{pieces} about its mean"


def outlined(width: float) -> list[Any]:
    """Return a path effect that keeps black lines and letters readable on any colour."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground="white")]


def _draw_scale(axes: Axes, sheet: Sheet) -> None:
    """Draw a scale bar of a round length in the lower left corner."""
    left, right, bottom, top = sheet.place
    length = round_length(_BAR * (right - left))
    margin = _MARGIN * min(right - left, top - bottom)
    ends = [left + margin, left + margin + length]
    (bar,) = axes.plot(ends, [bottom + margin] * 2, color="black", lw=3, solid_capstyle="butt")
    bar.set_path_effects(outlined(5))
    axes.annotate(
        f"{length:g} mm",
        (sum(ends) / 2, bottom + margin),
        (0, 4),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=TEXT,
        path_effects=outlined(2.5),
    )


def _draw_line(axes: Axes, sheet: Sheet, profile: Section) -> None:
    """Draw the line of a section, with A and B beyond its ends, or inside where an end is near the edge."""
    (line,) = axes.plot(profile.x[[0, -1]], profile.y[[0, -1]], color="black", lw=1, ls=(0, (6, 3)))
    line.set_path_effects(outlined(2.5))
    left, right, _, top = sheet.place
    edge = _EDGE * (right - left)
    to_left = profile.x[0] <= profile.x[-1]
    for name, place, beyond in (("A", 0, to_left), ("B", -1, not to_left)):
        fits = (profile.x[place] - left if beyond else right - profile.x[place]) > edge
        align = "right" if beyond == fits else "left"
        above = top - profile.y[place] > edge
        axes.annotate(
            name,
            (float(profile.x[place]), float(profile.y[place])),
            (3 if align == "left" else -3, 3 if above else -3),
            textcoords="offset points",
            ha=align,
            va="bottom" if above else "top",
            fontsize=SMALL + 2,
            weight="bold",
            path_effects=outlined(2.5),
        )


def height_picture(
    height: NDArray[np.float32], filled: NDArray[np.bool_], span: tuple[float, float]
) -> Colours:
    """Return the colours of heights, (H, W, 3): those of the scale, and orange for filled heights."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    finite = np.isfinite(height)
    level = Normalize(*span, clip=True)(np.where(finite, height, span[0]))
    colours = np.where(
        filled[..., np.newaxis],
        filled_colours()(level, bytes=True)[..., :3],
        colormaps[SEQUENTIAL](level, bytes=True)[..., :3],
    )
    return np.asarray(np.where(finite[..., np.newaxis], colours, MISSING_RGB), np.uint8)


_KEY = 129  # pixels of the key along a side


def draw_normals(axes: Axes, sheet: Sheet, name: str = "normals") -> None:
    """Draw unit vectors as colours, with black edges, and a half-ball next to them as a colour key."""
    result = sheet.result
    normals = result[name]
    colours = normal_colours(normals, result.edges)
    draw_map(axes, sheet, colours, interpolation="antialiased")
    _draw_key(axes)
    missing = bool(np.isnan(normals[..., 2]).any())
    edges = result.edges is not None and bool(result.edges.any())
    notes = (["black: edges"] if edges else []) + (["blue: no answer"] if missing else [])
    entitle(axes, result.declaration(name).title_of(name), "; ".join(notes))


def ball_colours() -> Colours:
    """Return the colours of all normals on a half-ball seen from above, (n, n, 4), with opacity."""
    across = np.linspace(-1, 1, _KEY, dtype=np.float32)
    right, up = np.meshgrid(across, across[::-1])
    rest = 1 - right**2 - up**2
    ball = np.stack([right, up, np.sqrt(np.maximum(rest, 0))], axis=-1)
    colours = np.full((_KEY, _KEY, 4), 255, np.uint8)
    colours[..., :3] = normal_colours(ball)
    colours[rest < 0, 3] = 0
    return colours


def _draw_key(axes: Axes) -> None:
    """Draw the colours of all normals on a half-ball seen from above."""
    colours = ball_colours()
    key = axes.inset_axes((1.03, 0.75, 0.2, 0.2))
    key.imshow(colours, extent=(-1, 1, -1, 1), interpolation="antialiased")
    key.set_axis_off()
    for name, x, y in (("x", 1.25, 0), ("y", 0, 1.25)):
        key.text(x, y, name, ha="center", va="center", fontsize=SMALL)
    key.text(0, -1.2, "on a ball", ha="center", va="top", fontsize=SMALL)


_ARROWS = 12  # along a side
_UNKNOWN_CODE = "unknown number"
_FLAG_COLOURS = "0.85", "black"
_CODE_COLOURS = (
    *("#009e73", "0.25", "#f0e442", "#56b4e9", "#d55e00", "#cc79a7", "#0072b2", "#e69f00"),
    *("#999999", "#661100", "#117733", "#88ccee", "#ddcc77", "#aa4499", "#44aa99", "#332288"),
)
"""Colours of codes, except for the one of undefined pixels; they repeat if there are more codes."""


def draw_declared(axes: Axes, sheet: Sheet, name: str) -> None:
    """Draw a map according to its declaration: heights, directions, vectors, codes, or numbers."""
    result = sheet.result
    declared = result.declaration(name)
    if name == result.name_of("height"):
        draw_height(axes, sheet)
    elif declared.sampling == "direction":
        draw_normals(axes, sheet, name)
    elif declared.codes:
        _draw_codes(axes, sheet, name)
    else:
        _draw_numbers(axes, sheet, name, scale_of(sheet, name))


def _draw_numbers(axes: Axes, sheet: Sheet, name: str, scale: Scale) -> None:
    """Draw numbers by colour; of vectors their length, and arrows if they have the components x and y."""
    from matplotlib.colors import LogNorm, Normalize

    declared = sheet.result.declaration(name)
    norm = (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)
    draw_map(axes, sheet, scale.values, scale.label, extend=scale.beyond, cmap=scale.colours, norm=norm)
    entitle(axes, declared.title_of(name), scale.note)
    if declared.sampling == "angle":
        axes.child_axes[0].set_yticks(range(-180, 181, 90))
    if declared.components[:2] == ("x", "y"):
        _draw_arrows(axes, sheet, displayed_values(sheet, name))


def _draw_arrows(axes: Axes, sheet: Sheet, vectors: Floats) -> None:
    rows, columns = (
        slice(step // 2, None, step) for step in (max(1, n // _ARROWS) for n in vectors.shape[:2])
    )
    x, y = np.meshgrid(sheet.x[columns], sheet.y[rows])
    arrows = vectors[rows, columns]
    axes.quiver(x, y, arrows[..., 0], arrows[..., 1], color="white", edgecolor="black", linewidth=0.3)


def _draw_codes(axes: Axes, sheet: Sheet, name: str) -> None:
    """Draw a categorical map, with a legend and the share of pixels with each code."""
    declared, values = sheet.result.declaration(name), sheet.result[name]
    codes = sorted(declared.codes)
    places = np.clip(np.searchsorted(codes, values), 0, len(codes) - 1)
    classes = np.where(np.asarray(codes)[places] == values, places, len(codes)).astype(np.uint8)
    _draw_shares(axes, sheet, classes, code_colours(declared), (*(declared.codes[code] for code in codes),))
    entitle(axes, declared.title_of(name))


def code_colours(declared: Map) -> tuple[str, ...]:
    """Return the colours of codes in their order, then the colour of numbers missing in the legend."""
    if len(declared.codes) == 2:
        return (*_FLAG_COLOURS, "white")
    others = itertools.cycle(_CODE_COLOURS)
    return (
        *(MISSING if code == declared.undefined else next(others) for code in sorted(declared.codes)),
        "white",
    )


def _draw_shares(
    axes: Axes, sheet: Sheet, classes: NDArray[np.uint8], colours: tuple[str, ...], names: tuple[str, ...]
) -> None:
    """Draw classes with the share of pixels in each."""
    counts = np.bincount(classes.ravel(), minlength=len(names) + 1)
    labels = {
        number: f"{name}\n{percent(int(counts[number]), classes.size)}"
        for number, name in enumerate((*names, _UNKNOWN_CODE))
        if counts[number]
    }
    draw_classes(axes, classes, colours, labels, sheet.place, "antialiased")
    legend = axes.get_legend()
    assert legend is not None
    for text in legend.get_texts():
        text.set_fontsize(SMALL)
        text.set_parse_math(False)
    lay_out(axes, sheet)
