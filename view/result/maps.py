"""Maps of a result: heights, normals, expected errors, modulation, edges, status."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.result import unit_of
from mirrorskin.io.types import Floats
from mirrorskin.view.canvas import draw_classes, exceeded, explain_colours, filled_colours, round_length
from mirrorskin.view.colours import (
    CYCLIC,
    DIVERGING,
    ERROR,
    MISSING,
    MISSING_RGB,
    SEQUENTIAL,
    Colours,
    normal_colours,
    span,
)
from mirrorskin.view.result.sheet import SMALL, TEXT, Sheet, draw_map, entitle, lay_out, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mirrorskin.engine.metrology import Section

_BAR = 0.3  # of the picture's width: the longest scale bar
_MARGIN = 0.05
_EDGE = 0.1  # of the picture's width: room for a letter


def draw_height(axes: Axes, sheet: Sheet, cut: Section | None = None) -> None:
    """Draw heights by colour, with a scale bar, and where the section runs."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    height = sheet.result.height
    assert height is not None
    ends = span(height)
    draw_map(axes, sheet, height_picture(height, sheet.filled, ends), interpolation="antialiased")
    colours = ScalarMappable(Normalize(*_apart(*ends)), SEQUENTIAL)
    explain_colours(axes, colours, f"{quantity(sheet)} (mm)", exceeded(height, *ends))
    if sheet.true_to_scale and sheet.unit == "mm" and height.size > 1:
        _draw_scale(axes, sheet)
    if cut is not None:
        _draw_line(axes, sheet, cut)
    lay_out(axes, sheet)
    entitle(axes, quantity(sheet).capitalize(), "; ".join(_notes(sheet)))


def quantity(sheet: Sheet) -> str:
    """Return the quantity's name: relative height if the absolute offset is unknown."""
    unknown = sheet.result.offset_unknown
    return "relative height" if unknown is not None and unknown.size and unknown.all() else "height"


def _notes(sheet: Sheet) -> Iterator[str]:
    """Tell what colours mean, and what a level is worth."""
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


def _apart(low: float, high: float) -> tuple[float, float]:
    """Part the ends of a scale that lie together."""
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def outlined(width: float) -> list[Any]:
    """Return what keeps black lines and letters readable on any colour."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground="white")]


def _draw_scale(axes: Axes, sheet: Sheet) -> None:
    """Draw a bar of a round length in the lower left corner."""
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


def _draw_line(axes: Axes, sheet: Sheet, cut: Section) -> None:
    """Draw the line of a section, and its ends A and B beyond it, or within where it ends at the edge."""
    (line,) = axes.plot(cut.x[[0, -1]], cut.y[[0, -1]], color="black", lw=1, ls=(0, (6, 3)))
    line.set_path_effects(outlined(2.5))
    left, right, _, top = sheet.place
    edge = _EDGE * (right - left)
    to_left = cut.x[0] <= cut.x[-1]
    for name, place, beyond in (("A", 0, to_left), ("B", -1, not to_left)):
        room = (cut.x[place] - left if beyond else right - cut.x[place]) > edge
        align = "right" if beyond == room else "left"
        above = top - cut.y[place] > edge
        axes.annotate(
            name,
            (float(cut.x[place]), float(cut.y[place])),
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
    """Return the colours of heights, (H, W, 3): those of the scale, and what was filled in orange."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    known = np.isfinite(height)
    level = Normalize(*span, clip=True)(np.where(known, height, span[0]))
    colours = np.where(
        filled[..., np.newaxis],
        filled_colours()(level, bytes=True)[..., :3],
        colormaps[SEQUENTIAL](level, bytes=True)[..., :3],
    )
    return np.asarray(np.where(known[..., np.newaxis], colours, MISSING_RGB), np.uint8)


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
    key.text(0, -1.2, "on a ball", ha="center", va="top", fontsize=SMALL)


_ARROWS = 12  # along a side
_MICROMETRES = 1e3  # in a millimetre
_SHOWN = 1, 99  # percentiles at the ends of the colour scale
_DECADES = 30.0  # times between these, from which on colours are of the logarithm


def draw_height_sigma(axes: Axes, sheet: Sheet) -> None:
    """Draw the standard deviation that is expected of heights, in micrometres."""
    assert sheet.result.height_sigma is not None
    sigma = _MICROMETRES * sheet.result.height_sigma.astype(np.float64)
    _draw_positive(
        axes, sheet, sigma, "Expected error of heights", "standard deviation", "\N{MICRO SIGN}m", ERROR
    )


def draw_normal_sigma(axes: Axes, sheet: Sheet) -> None:
    """Draw the angular error that is expected of normals, in degrees."""
    assert sheet.result.normal_sigma is not None
    sigma = np.degrees(sheet.result.normal_sigma.astype(np.float64))
    _draw_positive(axes, sheet, sigma, "Expected error of normals", "RMS angle", "deg", ERROR)


def draw_modulation(axes: Axes, sheet: Sheet) -> None:
    """Draw how far the light swings in a turn, in counts."""
    assert sheet.result.modulation is not None
    _draw_positive(
        axes,
        sheet,
        sheet.result.modulation.astype(np.float64),
        "Modulation",
        "swing of the light",
        "counts",
        SEQUENTIAL,
    )


def draw_slip_onset(axes: Axes, sheet: Sheet) -> None:
    """Draw how far the body had come when the skin broke loose, in micrometres or degrees."""
    onset = sheet.result.slip_onset
    assert onset is not None
    turned = unit_of("slip_onset", sheet.result.process) == "rad"
    unit, scale = ("deg", np.degrees(1.0)) if turned else ("\N{MICRO SIGN}m", _MICROMETRES)
    draw_map(axes, sheet, scale * onset.astype(np.float64), f"way of the body ({unit})", cmap=SEQUENTIAL)
    entitle(axes, "Onset of slip", "blue: no slip, or no answer")


def draw_displacement(axes: Axes, sheet: Sheet) -> None:
    """Draw how far the skin has moved in the last frame, with arrows along its way."""
    moved = sheet.result.displacement
    assert moved is not None
    last = _MICROMETRES * (moved if moved.ndim == 3 else moved[-1]).astype(np.float64)
    length = np.sqrt(np.sum(last**2, axis=-1))
    draw_map(axes, sheet, length, "length (\N{MICRO SIGN}m)", cmap=SEQUENTIAL)
    rows, columns = (slice(step // 2, None, step) for step in (max(1, n // _ARROWS) for n in length.shape))
    x, y = np.meshgrid(sheet.x[columns], sheet.y[rows])
    arrows = last[rows, columns]
    axes.quiver(x, y, arrows[..., 0], arrows[..., 1], color="white", edgecolor="black", linewidth=0.3)
    entitle(axes, "Displacement of the skin", "since the first frame")


def draw_signed(axes: Axes, sheet: Sheet, name: str) -> None:
    """Draw a map whose values may be of either sign: a slope, a hysteresis or a growth."""
    title, label, unit = _SIGNED[name]
    values = unit * getattr(sheet.result, name).astype(np.float64)
    known = np.abs(values[np.isfinite(values)])
    side = float(np.percentile(known, _SPAN)) if known.any() else 1.0
    ends = exceeded(values, -side, side)
    draw_map(axes, sheet, values, label, extend=ends, cmap=DIVERGING, vmin=-side, vmax=side)
    entitle(axes, title.capitalize())


def draw_own(axes: Axes, sheet: Sheet, name: str) -> None:
    """Draw a map of a user's own estimator."""
    values = sheet.result.own_maps[name].astype(np.float64)
    draw_map(axes, sheet, values, name, cmap=SEQUENTIAL)
    entitle(axes, name, "" if np.isfinite(values).all() else "blue: no answer")


def draw_azimuth(axes: Axes, sheet: Sheet) -> None:
    """Draw the azimuth of the normal, in degrees, in colours that go round as it does."""
    assert sheet.result.azimuth is not None
    azimuth = np.degrees(np.angle(np.exp(1j * sheet.result.azimuth.astype(np.float64))))
    draw_map(axes, sheet, azimuth, "azimuth (deg)", cmap=CYCLIC, vmin=-180, vmax=180)
    axes.child_axes[0].set_yticks(range(-180, 181, 90))
    entitle(axes, "Azimuth of the normal", "0: to the right; 90: up")


def _draw_positive(
    axes: Axes, sheet: Sheet, values: Floats, title: str, quantity: str, unit: str, colours: str
) -> None:
    """Draw numbers above zero; where they span decades, by their logarithm."""
    from matplotlib.colors import LogNorm, Normalize

    values = np.where(np.isfinite(values), values, np.nan)
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(known, _SHOWN)) if known.size else (0.0, 1.0)
    scale = LogNorm if low > 0 and high > _DECADES * low else Normalize
    if not high > low:
        low, high = low - 0.5, high + 0.5
    beyond = exceeded(known, low, high)
    label = f"{quantity} ({unit})"
    draw_map(axes, sheet, values, label, extend=beyond, cmap=colours, norm=scale(low, high))
    missing = "; blue: no answer" if 0 < known.size < values.size else ""
    entitle(axes, title, f"median {np.median(known):.3g} {unit}{missing}" if known.size else "no answer")


_ONSET = "invalid input", "onset", "never light", "light at start"
_RELEASE = "invalid input", "release", "dark at start", "light to the end"
_POSES = "invalid input", "normal", "none", "", "slope only"
_FOCUS = "invalid input", "in focus", "no peak", "peak at an end"
_SLIP = "unknown", "slipped", "sticks", "no contact", "no texture"
_UNKNOWN = "unknown number"
_STATUS_COLOURS = "#d55e00", "#009e73", "0.25", "#f0e442", "white"
_POSE_COLOURS = *_STATUS_COLOURS[:4], "#56b4e9", "white"
_SLIP_COLOURS = "#f0e442", "#d55e00", "#009e73", "0.85", "#56b4e9", "white"
_SIGNED = {  # what colours say, in a unit of so many
    "slope": ("slope along the rocking", "slope", 1.0),
    "hysteresis": ("hysteresis", "release less onset (µm)", 1e3),
    "growth": ("growth of the light", "growth (1/mm)", 1.0),
}
_SPAN = 99.0  # per cent of the values that colours tell apart
_EDGE_COLOURS = "0.85", "black", MISSING


def draw_edges(axes: Axes, sheet: Sheet) -> None:
    """Draw edges, and where the sheet was in contact in every frame, if known."""
    edges, contact = sheet.result.edges, sheet.result.contact
    assert edges is not None
    classes = np.zeros(edges.shape, np.uint8)
    if contact is not None:
        classes[contact == 0] = 2
    classes[edges > 0] = 1
    names = ("no edge" if contact is None else "in contact", "edge", "no lasting contact")
    _draw_shares(axes, sheet, classes, _EDGE_COLOURS, names)
    entitle(axes, "Edges" if contact is None else "Edges and contact")


def draw_status(axes: Axes, sheet: Sheet) -> None:
    """Draw what became of each pixel in a press or a release, or of what poses determine."""
    status = sheet.result.status
    assert status is not None
    released = sheet.result.process.get("event") == "release"
    names: tuple[str, ...] = _RELEASE if released else _ONSET
    colours: tuple[str, ...] = _STATUS_COLOURS
    if sheet.result.slip_onset is not None:
        names, colours = _SLIP, _SLIP_COLOURS
    elif sheet.result.zenith is not None:
        names, colours = _POSES, _POSE_COLOURS
    elif "sharpness" in sheet.result.own_maps:
        names = _FOCUS
    classes = np.minimum(status, len(names)).astype(np.uint8)
    _draw_shares(axes, sheet, classes, colours, (*names, _UNKNOWN))
    entitle(axes, "Status")


def _draw_shares(
    axes: Axes, sheet: Sheet, classes: NDArray[np.uint8], colours: tuple[str, ...], names: tuple[str, ...]
) -> None:
    """Draw classes with the share of pixels that each has."""
    counts = np.bincount(classes.ravel(), minlength=len(names))
    labels = {
        number: f"{name}\n{percent(int(counts[number]), classes.size)}"
        for number, name in enumerate(names)
        if counts[number]
    }
    draw_classes(axes, classes, colours, labels, sheet.place, "antialiased")
    legend = axes.get_legend()
    assert legend is not None
    for text in legend.get_texts():
        text.set_fontsize(SMALL)
    lay_out(axes, sheet)
