"""A map or a frame as a picture of Bokeh: colours and captions follow from the declarations of maps."""

from __future__ import annotations

import base64
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from bokeh.events import PanEnd, PanStart, RangesUpdate
from bokeh.models import (
    BoxAnnotation,
    ColorBar,
    ColumnDataSource,
    CustomJS,
    CustomJSHover,
    HoverTool,
    LinearColorMapper,
    LogColorMapper,
    Range1d,
    ResetTool,
    WheelZoomTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from mirrorskin.io import Region
from mirrorskin.io.base.opencv import encode
from mirrorskin.io.model.maps import SIGMA, Map
from mirrorskin.view.app.look import plain_axes
from mirrorskin.view.drawing.colours import DIVERGING, FILLED_RGB, MISSING_RGB, apart, normal_colours, span
from mirrorskin.view.result.maps import ball_colours, code_colours
from mirrorskin.view.result.scale import UNDEFINED_NOTE, in_figures, scale_of
from mirrorskin.view.result.sheet import Sheet, percent

Edges = tuple[float, float, float, float]
"""Left, right, bottom and top of a picture."""
Point = tuple[float, float]
Window = tuple[slice, slice]
"""Rows and columns."""

_SHADES = 256
_PIXELS = 1200  # of a side of what is sent, at most
_CHANGE_SHOWN = 99.5  # percentile of the magnitude at the ends of the colours of a change
_READ = "@value0{custom}"
_OPAQUE = 255
_WORD = (
    'const found = words instanceof Map ? words.get(String(value)) : words[value]; return found ?? "unknown"'
)
_UNKNOWN = np.float32(3e38)
"""What stands for NaN, which Bokeh shows as it is."""
_NUMBER = "return value > 1e38 ? 'unknown' : `${Number(value).toPrecision(5)} ${unit}`"


@dataclass(frozen=True)
class Readings:
    """What the pointer reads: values at pixels, lines of text, words of codes, and units.

    The values are functions of the rows and columns that are sent, as few of a large map are.
    """

    columns: dict[str, Callable[[Window], NDArray[Any]]] = field(default_factory=dict)
    tooltips: Sequence[tuple[str, str]] = ()
    words: dict[str, dict[int, str]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Shown:
    """A map as Bokeh draws it.

    Attributes
    ----------
    values : ndarray, (H, W)
        Numbers to colour; or of `rgba`, colours, uint32.
    palette, low, high, logarithmic
        Colours of the numbers.
    label : str
        Title with the unit; empty for codes and colours.
    title, caption : str
    legend : sequence of (str, str)
        Colours and texts of codes, or of marks.
    key : str
        HTML that explains colours of directions.
    readings : Readings
        What the pointer reads.
    """

    values: NDArray[Any]
    title: str
    caption: str
    label: str = ""
    palette: Sequence[str] = ()
    low: float = 0.0
    high: float = 1.0
    logarithmic: bool = False
    legend: Sequence[tuple[str, str]] = ()
    key: str = ""
    readings: Readings = field(default_factory=Readings)


@functools.cache
def palette_of(name: str) -> list[str]:
    """Return the colours of a colour map of Matplotlib."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[name](level)) for level in range(_SHADES)]


def hex_of(colour: Any) -> str:
    """Return a colour as Bokeh understands it."""
    from matplotlib.colors import to_hex

    if isinstance(colour, tuple):
        red, green, blue = (part / 255 for part in colour)
        return to_hex((red, green, blue))
    return to_hex(colour)


def show_map(sheet: Sheet, name: str, like: Shown | None = None) -> Shown:
    """Return how a map is drawn; with the limits of another if one is given.

    Parameters
    ----------
    sheet : Sheet
    name : str
        Name of a map of the result.
    like : Shown, optional
        The drawing with whose colours it is compared.
    """
    declared = sheet.result.declaration(name)
    title, caption = declared.title_of(name), declared.caption
    caption = f"{caption[:1].upper()}{caption[1:]}." if caption else ""
    readings = _read_at_pixels(sheet, name)
    if declared.sampling == "direction":
        colours = normal_colours(sheet.result[name], sheet.result.edges)
        edges = sheet.result.edges is not None and bool(sheet.result.edges.any())
        legend = [("#000000", "edges")] if edges else []
        return Shown(_packed(colours), title, caption, legend=legend, key=_key(), readings=readings)
    if declared.codes:
        classes, palette, legend = _classes(sheet, name)
        high = len(palette) - 0.5
        return Shown(
            classes, title, caption, palette=palette, low=-0.5, high=high, legend=legend, readings=readings
        )  # fmt: skip
    scale = scale_of(sheet, name)
    low, high = (scale.low, scale.high) if like is None or not like.palette else (like.low, like.high)
    note = "; ".join(part for part in scale.note.split("; ") if part not in ("", UNDEFINED_NOTE))
    return Shown(
        scale.values.astype(np.float32),
        title,
        f"{caption} {note[:1].upper()}{note[1:]}." if note else caption,
        f"{scale.label[:1].upper()}{scale.label[1:]}",
        palette_of(scale.colours),
        low,
        high,
        scale.logarithmic,
        readings=readings,
    )


def recoloured(shown: Shown, palette: str, low: float | None, high: float | None) -> Shown:
    """Return a drawing of numbers with another colour map, and other ends of it, where given."""
    if not shown.palette or shown.legend or shown.values.dtype.kind != "f":
        return shown
    low, high = shown.low if low is None else low, shown.high if high is None else high
    if not low < high:
        return shown
    return replace(
        shown, palette=palette_of(palette) if palette else shown.palette, low=low, high=high
    )  # fmt: skip


def show_change(now: Shown, before: Shown) -> Shown:
    """Return how the change from one map of numbers to another is drawn: in diverging colours."""
    change = now.values - before.values
    changes = np.abs(change[np.isfinite(change)])
    side = float(np.percentile(changes, _CHANGE_SHOWN)) if changes.any() else 0.0
    _, side = apart(-side, side)
    tooltips = [("x, y", "$x{0.000}, $y{0.000}"), ("Change", _READ)]
    columns: dict[str, Callable[[Window], NDArray[Any]]] = {"value0": lambda window: _to_read(change[window])}
    readings = Readings(columns, tooltips, units=now.readings.units)
    caption = "The current result minus the previous one."
    label = f"Change of {now.label[:1].lower()}{now.label[1:]}"
    return Shown(
        change, now.title, caption, label, palette_of(DIVERGING), -side, side, readings=readings
    )  # fmt: skip


def _key() -> str:
    """Return a picture of a ball with the colours of normals, x to the right and y up."""
    png = encode(".png", ball_colours()[..., [2, 1, 0, 3]])
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return f'<span class="key"><img alt="" src="{source}">colours on a ball seen from the camera</span>'


def _read_at_pixels(sheet: Sheet, name: str) -> Readings:
    """Return what the pointer reads: position, value with its standard deviation, status, and origin."""
    result, declared = sheet.result, sheet.result.declaration(name)
    columns: dict[str, Callable[[Window], NDArray[Any]]] = {}
    words: dict[str, dict[int, str]] = {}
    units: dict[str, str] = {}
    tooltips = [("x, y", f"$x{{0.000}}, $y{{0.000}} {sheet.unit}")]
    unit = declared.figure_unit
    if declared.codes:
        columns["code"] = result[name].__getitem__
        tooltips.append((declared.title_of(name), "@code{custom}"))
        words["@code"] = declared.codes
    else:
        values = _last(sheet, name)
        parts = declared.components or ("",)
        for number, part in enumerate(parts):
            key = f"value{number}"
            columns[key] = _reader(declared, values, number if part else None)
            units[key] = unit
            tooltips.append((part or declared.title_of(name), f"@{key}{{custom}}"))
    sigma = f"{name}{SIGMA}"
    if sigma in result and result[sigma].ndim == 2:
        error = result.declaration(sigma)
        columns["sigma"] = _reader(error, result[sigma])
        units["sigma"] = error.figure_unit
        tooltips.append(("Standard deviation", "@sigma{custom}"))
    status = "status"
    if status in result and name != status and result.declaration(status).codes:
        columns["status"] = result[status].__getitem__
        tooltips.append(("Status", "@status{custom}"))
        words["@status"] = result.declaration(status).codes
    if result.filled is not None and name == result.name_of("height"):
        columns["filled"] = result.filled.__getitem__
        tooltips.append(("Origin", "@filled{custom}"))
        words["@filled"] = result.declaration("filled").codes
    return Readings(columns, tooltips, words, units)


def _last(sheet: Sheet, name: str) -> NDArray[Any]:
    """Return a map; of frames, the last one."""
    declared = sheet.result.declaration(name)
    values: NDArray[Any] = sheet.result[name]
    return values[-1] if declared.per_frame and values.ndim > 2 + bool(declared.components) else values


def _reader(
    declared: Map, values: NDArray[Any], component: int | None = None
) -> Callable[[Window], NDArray[np.float32]]:
    def read(window: Window) -> NDArray[np.float32]:
        shown = in_figures(declared, values[window])
        return _to_read(shown if component is None else shown[..., component])

    return read


def _to_read(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.where(np.isfinite(values), values, _UNKNOWN).astype(np.float32)


def _classes(sheet: Sheet, name: str) -> tuple[NDArray[np.uint8], list[str], list[tuple[str, str]]]:
    """Return the places of the codes of a map in its legend, their colours, and the legend with shares."""
    declared, values = sheet.result.declaration(name), sheet.result[name]
    codes, colours = sorted(declared.codes), [hex_of(colour) for colour in code_colours(declared)]
    places = np.clip(np.searchsorted(codes, values), 0, len(codes) - 1)
    classes = np.where(np.asarray(codes)[places] == values, places, len(codes)).astype(np.uint8)
    counts = np.bincount(classes.ravel(), minlength=len(codes) + 1)
    names = [*(declared.codes[code] for code in codes), "unknown number"]
    legend = [
        (colours[place], f"{names[place]} {percent(int(count), classes.size)}")
        for place, count in enumerate(counts)
        if count
    ]
    return classes, colours, legend


def _packed(colours: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return red, green and blue as Bokeh's pixels."""
    rgba = np.full((*colours.shape[:2], 4), _OPAQUE, np.uint8)
    rgba[..., :3] = colours
    return np.ascontiguousarray(rgba).view(np.uint32)[..., 0]


class Picture:
    """A figure with a picture, whose rows go down as those of the camera.

    Parameters
    ----------
    place : (float, float, float, float)
        Left, right, bottom and top edge.
    unit : str
        Unit of the axes.
    size : (int, int)
        Largest width and height of the picture, CSS pixels.
    like : Picture, optional
        A picture that it is moved and enlarged together with.
    """

    def __init__(
        self,
        place: Edges,
        unit: str,
        size: tuple[int, int] = (480, 480),
        like: Picture | None = None,
        bar: bool = True,
    ) -> None:
        left, right, bottom, top = place
        self.place = place
        x = like.figure.x_range if like else Range1d(left, right)
        y = like.figure.y_range if like else Range1d(bottom, top)
        wheel = WheelZoomTool()
        self.figure: Any = figure(
            x_range=x,
            y_range=y,
            tools=[wheel, ResetTool()],
            toolbar_location="above",
            match_aspect=True,
            aspect_scale=1,
            background_fill_color=hex_of(MISSING_RGB),
            **_frame(place, size, bar),
        )
        plain_axes(self.figure)
        self.figure.toolbar.active_scroll = wheel
        self.figure.grid.visible = False
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = f"x ({unit})", f"y ({unit})"
        edges = {"x": [left], "y": [bottom], "dw": [right - left], "dh": [top - bottom]}
        self.source = ColumnDataSource(data={"image": [np.full((1, 1), np.nan, np.float32)], **edges})
        self.marks = ColumnDataSource(data={"image": [np.zeros((1, 1), np.uint32)], **edges})
        self.mapper = LinearColorMapper(palette=["#000000", "#ffffff"], nan_color=hex_of(MISSING_RGB))
        self.logarithmic = LogColorMapper(palette=["#000000"], low=1, high=10, nan_color=hex_of(MISSING_RGB))
        where = {"x": "x", "y": "y", "dw": "dw", "dh": "dh", "origin": "top_left"}
        self._shown: Shown | None = None
        self._drawn_marks: NDArray[np.uint32] | None = None
        self._plain = self.figure.image("image", source=self.source, color_mapper=self.mapper, **where)
        self._log = self.figure.image("image", source=self.source, color_mapper=self.logarithmic, **where)
        self._rgba = self.figure.image_rgba("image", source=self.source, **where)
        self._marks = self.figure.image_rgba("image", source=self.marks, **where)
        self._bars = [
            ColorBar(
                color_mapper=mapper,
                background_fill_color=None,
                width=14,
                padding=0,
                margin=8,
                major_label_text_font_size="12px",
            )
            for mapper in (self.mapper, self.logarithmic)
        ]
        if bar:
            for item in self._bars:
                self.figure.add_layout(item, "right")
        for item in (self._log, self._rgba, *self._bars):  # until a map is shown
            item.visible = False
        self.hover = HoverTool(renderers=[self._plain], tooltips=[], attachment="above")
        self._about_hover: tuple[Any, ...] = ()  # what the hover tool has been told
        self.figure.add_tools(self.hover)
        self.figure.on_event(RangesUpdate, self._look_again)

    def show(self, shown: Shown, marks: NDArray[np.uint32] | None = None, about: str = "") -> None:
        """Draw a map, and marks above it; the title has the unit of the map, and a text about it."""
        self.figure.title.text = ", ".join(filter(None, [shown.label or shown.title, about]))
        colours = shown.values.dtype == np.uint32
        self._rgba.visible = colours
        self._log.visible = not colours and shown.logarithmic
        self._plain.visible = not colours and not shown.logarithmic
        drawn = self._rgba if colours else self._log if shown.logarithmic else self._plain
        if not colours:
            mapper = self.logarithmic if shown.logarithmic else self.mapper
            mapper.update(palette=[*shown.palette], low=shown.low, high=shown.high)
        for bar, renderer in zip(self._bars, (self._plain, self._log), strict=True):
            bar.visible = renderer.visible and not shown.legend
        self._shown, self._drawn_marks = shown, marks
        self._send()
        read = shown.readings
        about_hover = drawn, [*read.tooltips], read.units, read.words
        if about_hover == self._about_hover:  # other models would have Bokeh search all for references
            return
        self._about_hover = about_hover
        formats = {
            f"@{name}": CustomJSHover(args={"unit": unit}, code=_NUMBER) for name, unit in read.units.items()
        }
        for column, codes in read.words.items():
            words = {str(code): text for code, text in codes.items()}
            formats[column] = CustomJSHover(args={"words": words}, code=_WORD)
        self.hover.update(renderers=[drawn], tooltips=[*read.tooltips], formatters=formats)

    def _send(self) -> None:
        """Send the pixels that are in view, no more of them than a screen has."""
        shown, marks = self._shown, self._drawn_marks
        assert shown is not None
        window, edges = self._window(shown.values.shape)
        self.source.data = {
            "image": [shown.values[window]],
            **{name: [read(window)] for name, read in shown.readings.columns.items()},
            **edges,
        }
        empty = np.zeros((1, 1), np.uint32)
        self.marks.data = {"image": [empty if marks is None else marks[window]], **edges}

    def _window(self, shape: tuple[int, ...]) -> tuple[Window, dict[str, list[float]]]:
        """Return rows and columns to send, and where they are."""
        left, right, bottom, top = self.place
        rows, columns = shape[:2]
        across, down = (right - left) / columns, (top - bottom) / rows
        ranges = self.figure.x_range, self.figure.y_range
        if max(rows, columns) <= _PIXELS:
            ends = (0, rows), (0, columns)
        else:
            ends = (
                _between((top - ranges[1].end) / down, (top - ranges[1].start) / down, rows),
                _between((ranges[0].start - left) / across, (ranges[0].end - left) / across, columns),
            )
        step = max(1, -(-max(end - first for first, end in ends) // _PIXELS))
        window = slice(*ends[0], step), slice(*ends[1], step)
        counts = [-(-(end - first) // step) * step for first, end in ends]
        edges = {
            "x": left + ends[1][0] * across,
            "y": top - (ends[0][0] + counts[0]) * down,
            "dw": counts[1] * across,
            "dh": counts[0] * down,
        }
        return window, {name: [edge] for name, edge in edges.items()}

    def _look_again(self, _: Any) -> None:
        """Send what came into view."""
        if self._shown is not None and max(self._shown.values.shape[:2]) > _PIXELS:
            self._send()


def _between(low: float, high: float, count: int) -> tuple[int, int]:
    """Return the pixels from one place to another, with a margin, of a number of pixels."""
    margin = 0.25 * (high - low)
    first = max(0, min(count - 1, int(low - margin)))
    return first, max(first + 1, min(count, int(high + margin) + 1))


def _frame(place: Edges, size: tuple[int, int], bar: bool) -> dict[str, Any]:
    """Return the size of a picture that is drawn to scale, within a width and a height."""
    left, right, bottom, top = place
    proportion = (right - left) / (top - bottom)
    width = min(size[0], round(size[1] * proportion))
    height = min(size[1], round(width / proportion))
    return {"frame_width": width, "frame_height": height}


def filled_marks(sheet: Sheet) -> NDArray[np.uint32]:
    """Return marks of heights that were filled, not measured."""
    filled = sheet.filled
    rgba = np.zeros((*filled.shape, 4), np.uint8)
    rgba[filled] = (*FILLED_RGB, 230)
    return np.ascontiguousarray(rgba).view(np.uint32)[..., 0]


def show_frame(frame: NDArray[Any], title: str, automatic: bool) -> Shown:
    """Return how a frame is drawn: from black to white, between its ends or those of its type."""
    if automatic:
        low, high = apart(*span(frame.astype(np.float32)))
    else:
        low, high = (0.0, float(np.iinfo(frame.dtype).max)) if frame.dtype.kind == "u" else (0.0, 1.0)
    tooltips = [("x, y", "$x{0.000}, $y{0.000}"), ("Brightness", "@image counts")]
    values = frame if frame.dtype in (np.uint8, np.uint16) else frame.astype(np.float32)
    return Shown(
        values, title, "", "Brightness (counts)", palette_of("gray"), low, high,
        readings=Readings(tooltips=tooltips),
    )  # fmt: skip


_RUBBER = """
const at = [cb_obj.x, cb_obj.y]
const ended = cb_obj.event_name == "panend"
if (cb_obj.event_name == "panstart") {
  origin.data = {x: [at[0]], y: [at[1]]}
  figure.lasso = {x: [], y: []}
}
const from = [origin.data.x[0], origin.data.y[0]]
const mode = modes.data.mode[0]
if (mode == "move") {
  for (const [range, place] of [[figure.x_range, 0], [figure.y_range, 1]]) {
    const shift = from[place] - at[place]
    range.setv({start: range.start + shift, end: range.end + shift})
  }
} else if (mode == "section") {
  line.data = {x: [from[0], at[0]], y: [from[1], at[1]]}
} else if (mode == "mask") {
  figure.lasso.x.push(at[0]), figure.lasso.y.push(at[1])
  const {x, y} = figure.lasso
  if (ended) lasso.data = {x, y}
  else line.setv({data: {x: [...x], y: [...y]}}, {sync: false})
} else if (mode == "region") {
  const [left, right] = [Math.min(from[0], at[0]), Math.max(from[0], at[0])]
  const [bottom, top] = [Math.min(from[1], at[1]), Math.max(from[1], at[1])]
  for (const drawn of [halo, box]) drawn.setv({left, right, bottom, top, visible: true})
}
"""


class Dragging:
    """What the pointer draws on a picture: a section, a region, or nothing where it moves the picture.

    Parameters
    ----------
    picture : Picture
    drawn : callable
        Called with the mode, and x and y of start and end; of a mask, of each corner.
    mode : {"section", "region", "mask", "move"}
    """

    def __init__(self, picture: Picture, drawn: Callable[..., None], mode: str = "region") -> None:
        self._drawn, self._start = drawn, (0.0, 0.0)
        self._modes = ColumnDataSource(data={"mode": [mode]})
        self.line = ColumnDataSource(data={"x": [], "y": []})
        self.lasso = ColumnDataSource(data={"x": [], "y": []})
        plot = picture.figure
        for width, colour in ((4, "white"), (1.5, "black")):
            plot.line("x", "y", source=self.line, line_width=width, line_color=colour)
        # Black on white is visible on all colours, to all eyes.
        self.halo = BoxAnnotation(fill_alpha=0, line_color="white", line_width=5, visible=False)
        self.box = BoxAnnotation(
            fill_alpha=0, line_color="black", line_width=2.5, line_dash="dashed", visible=False
        )
        plot.add_layout(self.halo)
        plot.add_layout(self.box)
        origin = ColumnDataSource(data={"x": [0.0], "y": [0.0]})
        used = {"line": self.line, "lasso": self.lasso, "halo": self.halo, "box": self.box}
        rubber = CustomJS(args={"origin": origin, "modes": self._modes, "figure": plot, **used}, code=_RUBBER)
        for event in ("panstart", "pan", "panend"):
            plot.js_on_event(event, rubber)
        plot.on_event(PanStart, self._started)
        plot.on_event(PanEnd, self._ended)
        self.lasso.on_change("data", lambda attr, old, new: self._masked())

    @property
    def mode(self) -> str:
        """What is drawn: "section", "region", "mask", or "move"."""
        return str(self._modes.data["mode"][0])

    @mode.setter
    def mode(self, mode: str) -> None:
        self._modes.data = {"mode": [mode]}

    def outline(self, edges: Mapping[str, float] | None) -> None:
        """Draw the outline of a region; None for no region."""
        for drawn in (self.halo, self.box):
            drawn.visible = edges is not None
            drawn.update(**(edges or {}))

    def _started(self, event: Any) -> None:
        self._start = event.x, event.y

    def _ended(self, event: Any) -> None:
        if self.mode in ("section", "region"):
            self._drawn(self.mode, self._start, (event.x, event.y))

    def _masked(self) -> None:
        corners = list(zip(self.lasso.data["x"], self.lasso.data["y"], strict=True))
        if len(corners) > 2:
            self._drawn("mask", *corners)


def pixel_at(place: Edges, shape: tuple[int, int], x: float, y: float) -> tuple[float, float]:
    """Return row and column at a place in a picture with these edges, with fractions."""
    left, right, bottom, top = place
    return (top - y) / (top - bottom) * shape[0], (x - left) / (right - left) * shape[1]


def region_between(place: Edges, shape: tuple[int, int], first: Point, other: Point) -> Region | None:
    """Return the pixels of a rectangle between two corners; None if it has less than two rows or columns."""
    corners = np.array([pixel_at(place, shape, *first), pixel_at(place, shape, *other)])
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    rows = max(0, round(top)), min(shape[0], round(bottom))
    columns = max(0, round(left)), min(shape[1], round(right))
    if rows[1] - rows[0] < 2 or columns[1] - columns[0] < 2:
        return None
    return Region(rows, columns)


def edges_of(place: Edges, shape: tuple[int, int], region: Region) -> dict[str, float]:
    """Return left, right, bottom and top of a region of a picture with these edges."""
    left, right, bottom, top = place
    across, down = (right - left) / shape[1], (top - bottom) / shape[0]
    return {
        "left": left + region.columns[0] * across,
        "right": left + region.columns[1] * across,
        "bottom": top - region.rows[1] * down,
        "top": top - region.rows[0] * down,
    }
