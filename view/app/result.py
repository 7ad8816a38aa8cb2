"""The pane of a result: its maps next to those of the previous result, a section, and measures."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, HoverTool
from bokeh.plotting import figure

from mirrorskin import engine
from mirrorskin.engine.metrology import Measures, Section, section
from mirrorskin.io import InputError
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
    region_between,
    show_change,
    show_map,
)
from mirrorskin.view.app.session import Computed, Session
from mirrorskin.view.drawing.colours import FILLED_RGB, MISSING_RGB
from mirrorskin.view.result.scale import labelled, title_of_height
from mirrorskin.view.result.sheet import Sheet, percent

_PICTURE = 410, 350  # largest size, CSS pixels
_SECTION = 600, 230
_DRAG = {"Draw a section": "section", "Draw a region to measure": "region", "Move the picture": "move"}
_NEXT = {"previous result": "before", "change since then": "change", "nothing": ""}
_BAND = 2  # standard deviations


class ResultPane:
    """A map of the result, next to the same map of the previous one."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.map = pn.widgets.Select(label="Map", width=230)
        self.compared = pn.widgets.Select(label="Next to it", options=_NEXT, value="before", width=170)
        self.marked = pn.widgets.Checkbox(label="Mark filled heights", value=True)
        self.drag = pn.widgets.RadioButtonGroup(options=_DRAG, value="section", color="default")
        self.turn = pn.widgets.IntInput(label="Turn", start=0, width=80, visible=False)
        self._pictures: dict[str, Picture] = {}
        self._dragging: Dragging | None = None
        self._pair = pn.Row()
        self.caption = text(width=1100)
        self.section = _SectionGraph()
        self.where = text()
        self.measures = text(width=500)
        self.restart = pn.widgets.Button(label="Measure the whole map", width=190)
        self._place: tuple[Any, ...] = ()
        self.map.param.watch(lambda _: self._show_maps(), "value")
        self.compared.param.watch(lambda _: self._show_maps(), "value")
        self.marked.param.watch(lambda _: self._show_maps(), "value")
        self.drag.param.watch(lambda event: self._choose_mode(event.new), "value")
        self.turn.param.watch(lambda event: session.choose_turn(event.new), "value")
        self.restart.on_click(lambda _: session.measure_in(None))
        session.watch("result", callback=self._show)
        session.watch("measured", callback=self._show_measures)
        session.watch("ends", callback=self._show_section)
        self._show()
        self.view = pn.Column(
            pn.Row(self.map, self.turn, self.compared, pn.Column(self.drag, self.marked)),
            self._pair,
            self.caption,
            pn.Row(
                pn.Column(self.where, pn.pane.Bokeh(self.section.figure)),
                pn.Column(self.measures, self.restart),
            ),
        )

    def _choose_mode(self, mode: str) -> None:
        if self._dragging is not None:
            self._dragging.mode = mode

    def _show(self) -> None:
        """Show a new result."""
        sheet = self._session.sheet(self._session.now)
        if sheet is None:
            return
        names = {sheet.result.declaration(name).title_of(name): name for name in sheet.result.maps()}
        height = sheet.result.name_of("height")
        if list(self.map.options or {}) != list(names):
            chosen = self.map.value
            self.map.options = names
            self.map.value = chosen if chosen in names.values() else display_order(sheet.result)[0]
        turns = self._session.turns
        self.turn.visible, self.turn.end = turns > 0, max(turns - 1, 0)
        self.section.figure.visible = height is not None
        self._show_maps()
        self._show_section()
        self._show_measures()

    def _show_maps(self) -> None:
        name = self.map.value
        sheet = self._session.sheet(self._session.now)
        if sheet is None or name not in sheet.result:
            return
        self._prepare(sheet)
        now = show_map(sheet, name)
        self._draw("now", sheet, now, self._session.now)
        before = self._session.sheet(self._session.before) if self.compared.value else None
        fits = before is not None and name in before.result and before.place == sheet.place
        if before is not None and fits:
            self._draw_next(before, show_map(before, name, now), now)
        other = [self._panes["before"]] if fits else []
        if self._session.before is None and self._session.whole is not None:
            other = [
                text(
                    hint("After a change of an option, the previous result is shown here."), margin=(160, 60)
                )
            ]
        self._pair[:] = [self._panes["now"], *other]
        self.caption.object = f"<p>{escape(now.caption)}</p>{_legend(sheet, now, self.marked.value)}"

    def _prepare(self, sheet: Sheet) -> None:
        """Make pictures of the size of the maps, if their size has changed."""
        if self._place == (sheet.place, sheet.unit):
            return
        self._place = sheet.place, sheet.unit
        now = Picture(sheet.place, sheet.unit, _PICTURE)
        self._pictures = {"now": now, "before": Picture(sheet.place, sheet.unit, _PICTURE, like=now)}
        self._dragging = Dragging(now, self._drawn, self.drag.value)
        now.figure.on_event(Tap, self._tapped)
        self._panes = {name: pn.pane.Bokeh(picture.figure) for name, picture in self._pictures.items()}

    def _draw_next(self, before: Sheet, shown: Shown, now: Shown) -> None:
        """Draw the previous map, or the change since then, which codes and directions do not have."""
        if self.compared.value == "change" and now.values.dtype.kind == "f":
            self._pictures["before"].show(show_change(now, shown))
        else:
            self._draw("before", before, shown, self._session.before)

    def _draw(self, which: str, sheet: Sheet, shown: Shown, computed: Computed | None) -> None:
        assert computed is not None
        picture = self._pictures[which]
        heights = self.map.value == sheet.result.name_of("height")
        marks = filled_marks(sheet) if heights and self.marked.value else None
        name = "previous" if which == "before" else "now"
        picture.show(shown, marks, f"{name}: {computed.label}")

    def _tapped(self, event: Any) -> None:
        """Choose the pixel whose brightness the recording shows."""
        sheet = self._session.sheet(self._session.now)
        if sheet is None or self._session.whole is None:
            return
        row, column = pixel_at(sheet.place, (len(sheet.y), len(sheet.x)), event.x, event.y)
        first = self._session.part().origin
        self._session.point_at(int(row) + first[0], int(column) + first[1])

    def _drawn(self, mode: str, start: Point, end: Point) -> None:
        sheet = self._session.sheet(self._session.now)
        if sheet is None:
            return
        if mode == "section":
            self._session.cut((start, end))
            return
        self._session.measure_in(region_between(sheet.place, (len(sheet.y), len(sheet.x)), start, end))

    def _show_section(self) -> None:
        sheet = self._session.sheet(self._session.now)
        if sheet is None or sheet.result.height is None:
            self.where.object = ""
            return
        try:
            profile = section(sheet.result, *(self._session.ends or ()))
        except InputError:
            self._session.ends = None
            return
        if self._dragging is not None:
            self._dragging.line.data = {"x": profile.x[[0, -1]], "y": profile.y[[0, -1]]}
        before = self._session.sheet(self._session.before)
        other = None
        if before is not None and before.result.height is not None and before.place == sheet.place:
            other = section(before.result, (profile.x[0], profile.y[0]), (profile.x[-1], profile.y[-1]))
        self.section.show(sheet, profile, other)
        ends = [f"({profile.x[end]:.3g}, {profile.y[end]:.3g})" for end in (0, -1)]
        self.where.object = f"<p>Section from {ends[0]} to {ends[1]} {sheet.unit}</p>"

    def _show_measures(self) -> None:
        sheet = self._session.sheet(self._session.now)
        region = self._session.measured
        self.restart.disabled = region is None
        if sheet is None:
            return
        if sheet.result.height is None:
            self.measures.object, self.restart.visible = hint("This result has no heights to measure."), False
            return
        self.restart.visible = True
        if self._dragging is not None:
            self._dragging.box.visible = region is not None
            if region is not None:
                shape = len(sheet.y), len(sheet.x)
                self._dragging.box.update(**edges_of(sheet.place, shape, region))
        now = self._session.now

        def measure() -> Measures | InputError:
            try:
                return engine.measure(sheet.result, region=region)
            except InputError as error:
                return error

        def show(measures: Measures | InputError) -> None:
            if (now, region) != (self._session.now, self._session.measured):
                return
            if isinstance(measures, InputError):
                self.measures.object = problem(str(measures))
                return
            rows = {name: str(value) for name, value in measures.quantities.items()}
            where = "the whole map" if region is None else f"the region {region.text}"
            self.measures.object = f"<h3>Measures of {where}</h3>{table(rows, _SECTION[1] - 60)}"

        self._session.run(measure, show)


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
    """Heights along a line, with a band of standard deviations, and those of the previous result."""

    def __init__(self) -> None:
        self.figure = figure(
            width=_SECTION[0],
            height=_SECTION[1],
            tools="pan,wheel_zoom,reset",
            toolbar_location=None,
        )
        plain_axes(self.figure)
        empty: dict[str, list[float]] = {"x": [], "y": [], "low": [], "high": [], "sigma": []}
        self.sources = {name: ColumnDataSource(data=empty) for name in ("now", "filled", "before")}
        self._band = self.figure.vbar(
            "x", 1.0, "high", "low", source=self.sources["now"], color="#0072b2", alpha=0.25, line_width=0
        )
        looks = {
            "before": ("#8d99a6", "solid", "previous"),
            "now": ("#0072b2", "solid", f"measured, ± {_BAND} standard deviations"),
            "filled": (hex_of(FILLED_RGB), "dashed", "filled"),
        }
        lines = {}
        for name, (colour, dash, label) in looks.items():
            lines[name] = self.figure.line(
                "x", "y", source=self.sources[name], line_color=colour, line_width=2, line_dash=dash,
                legend_label=label,
            )  # fmt: skip
        self.figure.legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=3, background_fill_alpha=0.7
        )
        self._legend = {item.label.value: item for item in self.figure.legend[0].items}
        self.figure.add_layout(self.figure.legend[0], "above")
        self.hover = HoverTool(renderers=[lines["now"]], mode="vline")
        self.figure.add_tools(self.hover)

    def show(self, sheet: Sheet, profile: Section, before: Section | None) -> None:
        """Draw a section, and that of the previous result."""
        factor, unit = sheet.of_height.figure_scale, sheet.of_height.figure_unit
        measured = np.where(profile.filled, np.nan, factor * profile.height)
        band = _BAND * factor * profile.sigma
        self._band.glyph.width = float(np.ptp(profile.distance)) / max(len(profile.distance) - 1, 1)
        self.sources["now"].data = {
            "x": profile.distance,
            "y": measured,
            "low": measured - band,
            "high": measured + band,
            "sigma": 1e3 * profile.sigma,
        }
        self.sources["filled"].data = _line(
            profile, np.where(profile.filled, factor * profile.height, np.nan)
        )
        self.sources["before"].data = _line(before or profile, factor * before.height if before else None)
        self._legend["previous"].visible = before is not None
        self._legend["filled"].visible = bool(profile.filled.any())
        title = title_of_height(sheet)
        self.figure.xaxis.axis_label = f"distance along the section ({sheet.unit})"
        self.figure.yaxis.axis_label = labelled(title, sheet.of_height)
        self.hover.tooltips = [
            ("Distance", f"@x{{0.000}} {sheet.unit}"),
            (title.capitalize(), f"@y{{0.0000}} {unit}"),
            ("Standard deviation", "@sigma{0.00} µm"),
        ]


def _line(profile: Section, height: Any) -> dict[str, Any]:
    x: Any = [] if height is None else profile.distance
    none = np.full(len(x), np.nan)
    return {"x": x, "y": [] if height is None else height, "low": none, "high": none, "sigma": none}
