"""The pane of a result: its maps next to those of the previous result, a section, and measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from html import escape
from io import StringIO
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, HoverTool
from bokeh.plotting import figure
from numpy.typing import NDArray

from mirrorskin.engine.metrology import Measures, Section, group_of, section
from mirrorskin.io import InputError, Region
from mirrorskin.io.model.result import display_order
from mirrorskin.view.app.look import hint, plain_axes, problem, table, text
from mirrorskin.view.app.picture import (
    Dragging,
    Picture,
    Point,
    Shown,
    edges_of,
    filled_marks,
    hex_of,
    pixel_at,
    recoloured,
    region_between,
    show_change,
    show_map,
)
from mirrorskin.view.app.session import Computed, Ends, Session
from mirrorskin.view.drawing.colours import FILLED_RGB, MISSING_RGB
from mirrorskin.view.result.scale import labelled, title_of_height
from mirrorskin.view.result.sheet import Sheet, percent

_PICTURE = 410, 350  # largest size, CSS pixels
_SECTION = 270  # height, CSS pixels
_DRAG = {"Section": "section", "Region to measure": "region", "Dust": "mask", "Move the picture": "move"}
_NEXT = {"the map of B": "before", "the change, A minus B": "change", "nothing": ""}
_PREVIOUS = "previous result"
_BAND = 2  # standard deviations
_PALETTES = ("viridis", "cividis", "magma", "gray", "turbo", "RdBu_r")
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9")  # for all eyes
_FRESH, _STALE = {"opacity": "1", "filter": "none"}, {"opacity": "0.35", "filter": "grayscale(1)"}
_PRESSED = ".bk-btn.bk-active { outline: 2px solid light-dark(#1f6f78, #66c2cb); outline-offset: -2px; }"
_COPY = "navigator.clipboard.writeText(source.data.text[0])"


_Colours = tuple[str, float | None, float | None]
"""A colour map, and the values at its ends; the map's own where there is none."""
_Drawing = tuple[Shown, NDArray[np.uint32] | None, str]
"""A map with marks, and what its title adds."""


@dataclass(frozen=True)
class _Drawn:
    """What is drawn: a map with marks of filled heights, or its change; and what the title adds."""

    sheet: Sheet
    name: str
    about: str
    marked: bool
    change: bool = False

    def drawing(self, shown: Shown) -> _Drawing:
        """Return a drawing of the map with marks of filled heights, if the map has them."""
        heights = self.marked and self.name == self.sheet.result.name_of("height")
        marks = filled_marks(self.sheet) if heights and self.sheet.filled.any() else None
        return shown, marks, self.about


@dataclass(frozen=True)
class _Drawings:
    """The map of the result and what is next to it, with a caption and a legend."""

    caption: str
    now: _Drawing
    before: _Drawing | None = None


def _drawings(
    drawn: _Drawn, other: _Drawn | None, colours: tuple[str, float | None, float | None]
) -> _Drawings:
    """Prepare drawings; the work of a thread, as maps may be large."""
    now = recoloured(show_map(drawn.sheet, drawn.name), *colours)
    caption = f"<p>{escape(now.caption)}</p>{_legend(drawn.sheet, now, drawn.marked)}"
    if other is None:
        return _Drawings(caption, drawn.drawing(now))
    shown = show_map(other.sheet, other.name, now)
    shown = replace(shown, palette=now.palette) if now.palette else shown
    if other.change and now.values.dtype.kind == "f":  # codes and directions have none
        return _Drawings(caption, drawn.drawing(now), (show_change(now, shown), None, ""))
    return _Drawings(caption, drawn.drawing(now), other.drawing(shown))


class ResultPane:
    """A map of the result (A), next to the same map of another one (B), sections, and measures.

    Parameters
    ----------
    session : Session
    others : callable, optional
        Returns names of other results, by which `take` gives them.
    take : callable, optional
        Calls a function with a result of the list, when it has been read.
    """

    def __init__(
        self,
        session: Session,
        others: Callable[[], Mapping[str, int]] | None = None,
        take: Callable[[int, Callable[[Computed], object]], object] | None = None,
    ) -> None:
        self._session, self._others, self._take = session, others, take
        widgets = pn.widgets
        self.map = widgets.Select(label="Map", width=190)
        self.other = widgets.Select(label="B", options={_PREVIOUS: ""}, value="", width=190)
        self.compared = widgets.Select(label="Next to it", options=_NEXT, value="before", width=170)
        self.marked = widgets.Checkbox(label="Mark filled heights", value=True)
        self.drag = widgets.RadioButtonGroup(
            label="The pointer", options=_DRAG, value="section", color="default", stylesheets=[_PRESSED]
        )
        self.turn = widgets.IntInput(label="Turn", start=0, width=80, visible=False)
        self.palette = widgets.Select(
            label="Colours", options={"of the map": "", **{name: name for name in _PALETTES}}, width=110
        )
        self.low = widgets.FloatInput(label="From", value=None, placeholder="automatic", width=115)
        self.high = widgets.FloatInput(label="To", value=None, placeholder="automatic", width=115)
        self._follows = False  # whether the fields show what was chosen for another map before
        self._colours: dict[str, _Colours] = {}  # by map
        self._pictures: dict[str, Picture] = {}
        self._dragging: Dragging | None = None
        self._pair = pn.FlexBox(styles={"flex": "0 1 auto"})
        self.caption = text(sizing_mode="stretch_width")
        self.section = _SectionGraph()
        self.where = text()
        self.measures = text(sizing_mode="stretch_width")
        self.restart = widgets.Button(label="Measure the whole map", width=190)
        self.unmask = widgets.Button(label="Forget the dust", width=140, visible=False)
        self.uncut = widgets.Button(label="Remove the last section", width=190, visible=False)
        self.copy = widgets.Button(label="Copy measures", width=140, disabled=True)
        self.table = widgets.FileDownload(
            callback=self._csv, filename="measures.csv", label="Save measures.csv", width=180, disabled=True,
        )  # fmt: skip
        self._text = ColumnDataSource(data={"text": [""]})
        self.copy.js_on_click(args={"source": self._text}, code=_COPY)
        self._measured: Measures | None = None
        self._place: tuple[Any, ...] = ()
        self._asked = self._drawn_last = self._cuts = 0  # count drawings, and sections, that were asked for
        self._body = pn.Column(sizing_mode="stretch_width")
        self.map.param.watch(lambda _: self._choose_map(), "value")
        for field in (self.palette, self.low, self.high):
            field.param.watch(lambda _: self._recolour(), "value")
        for field in (self.compared, self.marked):
            field.param.watch(lambda _: self._show_maps(), "value")
        self.other.param.watch(lambda event: self._compare(event.new), "value")
        self.drag.param.watch(lambda event: self._choose_mode(event.new), "value")
        self.turn.param.watch(lambda event: session.choose_turn(event.new), "value")
        self.restart.on_click(lambda _: session.measure_in(None))
        self.unmask.on_click(lambda _: session.mask([]))
        self.uncut.on_click(lambda _: session.cut(*session.sections[:-1]))
        session.watch("result", callback=self._show)
        session.watch("problem", callback=self._fade)
        session.watch("measured", callback=self._show_measures)
        session.watch("ends", callback=self._show_section)
        session.watch("compared", callback=self._show_compared)
        self.update_others()
        self._show()
        section = pn.Column(
            pn.Row(self.where, self.uncut),
            pn.pane.Bokeh(self.section.figure, sizing_mode="stretch_width", min_width=380),
            styles={"flex": "1 1 420px"},
            min_width=380,
        )
        buttons = pn.FlexBox(self.restart, self.unmask, self.copy, self.table)
        self._body[:] = [pn.FlexBox(self._pair, section), self.caption, self.measures, buttons]
        self.view = pn.Column(
            pn.FlexBox(
                self.map, self.turn, self.palette, self.low, self.high, self.other, self.compared,
                pn.Column(self.drag, self.marked),
            ),
            self._body,
            sizing_mode="stretch_width",
        )  # fmt: skip
        self._fade()

    def update_others(self) -> None:
        """Offer the other results of the list."""
        self.other.options = {_PREVIOUS: "", **(self._others() if self._others else {})}
        self.other.visible = len(self.other.options) > 1

    def _compare(self, number: int | str) -> None:
        if isinstance(number, int) and self._take is not None:
            self._take(number, self._session.compare)
        else:
            self._session.compare(None)

    def _choose_mode(self, mode: str) -> None:
        if self._dragging is not None:
            self._dragging.mode = mode

    def _choose_map(self) -> None:
        if self._follows:
            return
        palette, low, high = self._colours.get(self.map.value, ("", None, None))
        self._follows = True
        self.palette.value, self.low.value, self.high.value = palette, low, high
        self._follows = False
        self._show_maps()

    def _recolour(self) -> None:
        if self._follows:
            return
        self._colours[self.map.value] = self.palette.value, self.low.value, self.high.value
        self._show_maps()

    def _fade(self) -> None:
        """Grey what does not belong to the options, until it does."""
        stale = self._session.computing or self._drawn_last != self._asked
        self._body.styles = dict(_STALE if stale else _FRESH)

    def _show(self) -> None:
        """Show a new result."""
        sheet = self._session.sheet(self._session.now)
        if sheet is None:
            return
        names = {sheet.result.declaration(name).title_of(name): name for name in sheet.result.maps()}
        height = sheet.result.name_of("height")
        if list(self.map.options or {}) != list(names):
            chosen = self.map.value
            self._follows = True
            self.map.options = names
            self.map.value = chosen if chosen in names.values() else display_order(sheet.result)[0]
            self._follows = False
        turns = self._session.turns
        self.turn.visible, self.turn.end = turns > 0, max(turns - 1, 0)
        self.section.figure.visible = height is not None
        self._show_maps()
        self._show_section()
        self._show_measures()

    def _show_compared(self) -> None:
        self._show_maps()
        self._show_section()

    def _show_maps(self) -> None:
        name, session = self.map.value, self._session
        sheet = session.sheet(session.now)
        if sheet is None or name not in sheet.result:
            return
        self._prepare(sheet)
        before = session.sheet(session.compared) if self.compared.value else None
        about_a, about_b = (one.label if one else "" for one in (session.now, session.compared))
        drawn = _Drawn(sheet, name, f"A: {about_a}", self.marked.value)
        other = None
        if before is not None and name in before.result and before.place == sheet.place:
            other = replace(
                drawn, sheet=before, about=f"B: {about_b}", change=self.compared.value == "change"
            )
        colours = self._colours.get(name, ("", None, None))
        self._asked += 1
        asked, missing = self._asked, before is not None and other is None

        def draw(drawings: _Drawings) -> None:
            if asked == self._asked:
                self._drawn_last = asked
                self._draw(drawings, missing)

        self._fade()
        session.run(lambda: _drawings(drawn, other, colours), draw)

    def _draw(self, drawings: _Drawings, missing: bool) -> None:
        """Draw the map of the result, and what is next to it."""
        other: list[Any] = []
        if drawings.before is not None:
            other = [self._panes["before"]]
        elif missing:
            other = [text(hint("B has no such map of the same place and size."), margin=(160, 60))]
        for which, drawing in (("now", drawings.now), ("before", drawings.before)):
            if drawing is not None:
                self._pictures[which].show(*drawing)
        self._pair[:] = [self._panes["now"], *other]
        self.caption.object = drawings.caption
        self._fade()

    def _prepare(self, sheet: Sheet) -> None:
        """Make pictures of the size of the maps, if their size has changed."""
        if self._place == (sheet.place, sheet.unit):
            return
        self._place = sheet.place, sheet.unit
        now = Picture(sheet.place, sheet.unit, _PICTURE)
        self._pictures = {"now": now, "before": Picture(sheet.place, sheet.unit, _PICTURE, like=now)}
        self._lines = ColumnDataSource(data={"x": [], "y": [], "colour": []})
        self._dust = ColumnDataSource(data={"x": [], "y": []})
        for width, colour in ((5, "white"), (3, "colour")):
            now.figure.multi_line("x", "y", source=self._lines, line_width=width, line_color=colour)
        now.figure.patches(
            "x", "y", source=self._dust, fill_color="white", fill_alpha=0.5, hatch_pattern="/",
            line_color="black", line_width=1.5,
        )  # fmt: skip
        self._dragging = Dragging(now, self._drawn, self.drag.value)
        now.figure.on_event(Tap, self._tapped)
        self._panes = {name: pn.pane.Bokeh(picture.figure) for name, picture in self._pictures.items()}

    def _tapped(self, event: Any) -> None:
        """Choose the pixel whose brightness the recording shows."""
        sheet = self._session.sheet(self._session.now)
        if sheet is None or self._session.whole is None:
            return
        row, column = pixel_at(sheet.place, (len(sheet.y), len(sheet.x)), event.x, event.y)
        first = self._session.part().origin
        self._session.point_at(int(row) + first[0], int(column) + first[1])

    def _drawn(self, mode: str, *points: Point) -> None:
        sheet = self._session.sheet(self._session.now)
        if sheet is None:
            return
        if mode == "section":
            kept = self._session.sections[: len(_COLOURS) - 1]
            self._session.cut(*kept, (points[0], points[-1]))
        elif mode == "mask":
            self._session.mask([*self._session.masks, points])
        else:
            start, end = points
            self._session.measure_in(region_between(sheet.place, (len(sheet.y), len(sheet.x)), start, end))

    def _show_section(self) -> None:
        session = self._session
        sheet = session.sheet(session.now)
        self.uncut.visible = bool(session.sections)
        if sheet is None or sheet.result.height is None:
            self.where.object = ""
            return
        before = session.sheet(session.compared)
        if before is not None and (before.result.height is None or before.place != sheet.place):
            before = None
        self._cuts += 1
        cuts, ends = self._cuts, [*session.sections]

        def draw(profiles: _Profiles) -> None:
            if cuts == self._cuts:
                for wrong in profiles.wrong:
                    session.sections.remove(wrong)
                self._draw_section(sheet, profiles)

        session.run(lambda: _profiles(sheet, ends, before), draw)

    def _draw_section(self, sheet: Sheet, drawn: _Profiles) -> None:
        """Draw sections, and where they are."""
        profiles = drawn.now
        if not profiles:
            self.where.object = hint("No section can be drawn there.")
            return
        if self._dragging is not None:
            self._dragging.line.data = {"x": [], "y": []}
            self._lines.data = {
                "x": [profile.x[[0, -1]] for profile in profiles],
                "y": [profile.y[[0, -1]] for profile in profiles],
                "colour": [*_COLOURS[: len(profiles)]],
            }
        self.section.show(sheet, profiles, drawn.before)
        ends_of = [f"({profiles[-1].x[end]:.3g}, {profiles[-1].y[end]:.3g})" for end in (0, -1)]
        count = f"Section {len(profiles)}" if len(profiles) > 1 else "Section"
        self.where.object = f"<p>{count} from {ends_of[0]} to {ends_of[1]} {sheet.unit}</p>"

    def _show_measures(self) -> None:
        session = self._session
        sheet, region, masks = session.sheet(session.now), session.measured, session.masks
        self.restart.disabled, self.unmask.visible = region is None, bool(masks)
        if sheet is None:
            return
        if sheet.result.height is None:
            self.measures.object = hint("This result has no heights to measure.")
            self.restart.visible = self.copy.visible = self.table.visible = False
            return
        self.restart.visible = self.copy.visible = self.table.visible = True
        if self._dragging is not None:
            shape = len(sheet.y), len(sheet.x)
            self._dragging.outline(None if region is None else edges_of(sheet.place, shape, region))
            corners = [np.transpose(polygon) for polygon in masks]
            self._dust.data = {"x": [x for x, _ in corners], "y": [y for _, y in corners]}
        now, turn, where = session.now, session.turn, _words(region, masks)
        found, measure = session.measures()

        def show(measures: Measures | InputError | None) -> None:
            shown = session.now, session.turn, session.measured, session.masks
            if measures is None or shown != (now, turn, region, masks):
                return
            self.measures.styles = dict(_FRESH)
            self._measured = None if isinstance(measures, InputError) else measures
            self.copy.disabled = self.table.disabled = self._measured is None
            self._text.data = {"text": [as_text(self._measured, "\t")]}
            if isinstance(measures, InputError):
                self.measures.object = problem(str(measures))
                return
            self.measures.object = f"<h3>Measures of {where}</h3>{_grouped(measures)}"

        if found is not None:
            show(found)
            return
        self.measures.styles = dict(_STALE)
        self.copy.disabled = self.table.disabled = True
        session.run_aside(measure, show)

    def _csv(self) -> StringIO:
        return StringIO(as_text(self._measured, ","))


def as_text(measures: Measures | None, separator: str) -> str:
    """Return measures as lines of a table: name, value, standard uncertainty, and unit."""
    lines = [("quantity", "value", "standard uncertainty", "unit")]
    for name, value in (measures.quantities if measures else {}).items():
        lines.append((name, repr(float(value.value)), repr(float(value.sigma)), value.unit))
    return "".join(separator.join(line) + "\n" for line in lines)


def _words(region: Region | None, masks: Sequence[Any]) -> str:
    """Return what is measured, in words."""
    where = "the whole map" if region is None else f"the region {region.text}"
    areas = f"{len(masks)} areas" if len(masks) > 1 else "one area"
    return f"{where} without {areas} of dust" if masks else where


def _grouped(measures: Measures) -> str:
    """Return measures as tables, one for each group, in columns."""
    groups: dict[str, dict[str, str]] = {}
    for name, value in measures.quantities.items():
        groups.setdefault(group_of(name), {})[name] = str(value)
    tables = (f"<section><h4>{escape(name)}</h4>{table(rows)}</section>" for name, rows in groups.items())
    return f'<div class="groups">{"".join(tables)}</div>'


def _legend(sheet: Sheet, shown: Shown, marked: bool) -> str:
    """Return what colours mean that have no place on the bar."""
    rows = list(shown.legend)
    values = shown.values
    if values.dtype.kind == "f":
        missing = int(np.count_nonzero(~np.isfinite(values)))
        if missing:
            rows.append((hex_of(MISSING_RGB), f"no answer {percent(missing, values.size)}"))
        filled = sheet.result.height is not None and int(np.count_nonzero(sheet.filled))
        if marked and filled:
            rows.append((hex_of(FILLED_RGB), f"filled, not measured {percent(filled, values.size)}"))
    keys = "".join(
        f'<span class="key"><i style="background:{colour}"></i>{escape(words)}</span>'
        for colour, words in rows
    )
    return f'<div class="keys">{keys}{shown.key}</div>'


class _SectionGraph:
    """Heights along lines, with a band of standard deviations, and those of B."""

    def __init__(self) -> None:
        self.figure = figure(
            height=_SECTION,
            min_width=380,
            sizing_mode="stretch_width",
            tools="pan,wheel_zoom,reset",
            toolbar_location=None,
        )
        plain_axes(self.figure)
        empty: dict[str, list[float]] = {"x": [], "y": [], "low": [], "high": [], "sigma": []}
        numbers = [f"section {number}" for number in range(2, len(_COLOURS) + 1)]
        self.sources = {name: ColumnDataSource(data=empty) for name in ("now", "filled", "before", *numbers)}
        self._band = self.figure.vbar(
            "x", 1.0, "high", "low", source=self.sources["now"], color=_COLOURS[0], alpha=0.25, line_width=0
        )
        looks = {
            "before": ("#8d99a6", "solid", "B"),
            "now": (_COLOURS[0], "solid", f"measured, ± {_BAND} standard deviations"),
            "filled": (hex_of(FILLED_RGB), "dashed", "filled"),
        }
        looks |= {name: (colour, "solid", name) for name, colour in zip(numbers, _COLOURS[1:], strict=True)}
        lines = {}
        for name, (colour, dash, label) in looks.items():
            lines[name] = self.figure.line(
                "x", "y", source=self.sources[name], line_color=colour, line_width=2, line_dash=dash,
                legend_label=label,
            )  # fmt: skip
        self.figure.legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=3, background_fill_alpha=0.0,
            border_line_alpha=0.0,
        )  # fmt: skip
        self._legend = {item.label.value: item for item in self.figure.legend[0].items}
        self.figure.add_layout(self.figure.legend[0], "above")
        self.hover = HoverTool(renderers=[lines["now"]], mode="vline")
        self.figure.add_tools(self.hover)

    def show(self, sheet: Sheet, profiles: Sequence[Section], before: Section | None) -> None:
        """Draw sections, and the first one of B."""
        profile = profiles[0]
        factor, unit = sheet.of_height.figure_scale, sheet.of_height.figure_unit
        error = sheet.of_height.deviation("height")
        measured = np.where(profile.filled, np.nan, factor * profile.height)
        band = _BAND * factor * profile.sigma
        self._band.glyph.width = float(np.ptp(profile.distance)) / max(len(profile.distance) - 1, 1)
        self.sources["now"].data = {
            "x": profile.distance,
            "y": measured,
            "low": measured - band,
            "high": measured + band,
            "sigma": error.figure_scale * profile.sigma,
        }
        self.sources["filled"].data = _line(
            profile, np.where(profile.filled, factor * profile.height, np.nan)
        )
        self.sources["before"].data = _line(before or profile, factor * before.height if before else None)
        self._legend["B"].visible = before is not None
        self._legend["filled"].visible = bool(profile.filled.any())
        for number in range(2, len(_COLOURS) + 1):
            name = f"section {number}"
            other = profiles[number - 1] if number <= len(profiles) else None
            self.sources[name].data = _line(other or profile, factor * other.height if other else None)
            self._legend[name].visible = other is not None
        title = title_of_height(sheet)
        self.figure.xaxis.axis_label = f"distance along the section ({sheet.unit})"
        self.figure.yaxis.axis_label = labelled(title, sheet.of_height)
        self.hover.tooltips = [
            ("Distance", f"@x{{0.000}} {sheet.unit}"),
            (title.capitalize(), f"@y{{0.0000}} {unit}"),
            ("Standard deviation", f"@sigma{{0.00}} {error.figure_unit}"),
        ]


@dataclass(frozen=True)
class _Profiles:
    """Sections of the result, the first one of B, and the ends between which there is none."""

    now: list[Section]
    before: Section | None
    wrong: list[Ends]


def _profiles(sheet: Sheet, ends: Sequence[Ends], before: Sheet | None) -> _Profiles:
    """Cut along ends, by default the row through the highest point; the work of a thread."""
    profiles, wrong = [], []
    for pair in ends:
        try:
            profiles.append(_section(sheet, *pair))
        except InputError:
            wrong.append(pair)
    if not profiles:
        with suppress(InputError):
            profiles.append(_section(sheet))
    other = None
    if before is not None and profiles:
        first = profiles[0]
        other = _section(before, (first.x[0], first.y[0]), (first.x[-1], first.y[-1]))
    return _Profiles(profiles, other, wrong)


def _section(sheet: Sheet, *ends: Point) -> Section:
    """Return a section whose places are in the unit of the sheet."""
    return section(sheet.result.assign(x=sheet.x, y=sheet.y), *ends)


def _line(profile: Section, height: Any) -> dict[str, Any]:
    x: Any = [] if height is None else profile.distance
    none = np.full(len(x), np.nan)
    return {"x": x, "y": [] if height is None else height, "low": none, "high": none, "sigma": none}
