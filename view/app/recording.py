"""The pane of a recording: its frames, the part that is used, and the brightness of one pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import BoxAnnotation, ColumnDataSource, HoverTool, Label, Range1d, Span
from bokeh.plotting import figure

from mirrorskin.io.base.types import axes_with_unit
from mirrorskin.view.app.look import hint, plain_axes, table, text
from mirrorskin.view.app.picture import (
    Dragging,
    Picture,
    Point,
    edges_of,
    pixel_at,
    region_between,
    show_frame,
)
from mirrorskin.view.app.session import Session
from mirrorskin.view.app.trace import Trace, trace_of
from mirrorskin.view.drawing.canvas import extent

_PICTURE = 400, 440  # largest size, CSS pixels
_GRAPH = 480, 330
_COLOURS = {"Dark": "#56606b", "Threshold": "#d55e00", "Bright": "#8a6d00"}
_LINE, _FIT = "#0072b2", "#d55e00"
_HINT = "Click a pixel to see its brightness. Drag to draw the region that is used."


class RecordingPane:
    """Frames with a slider, and the brightness of the pixel that was clicked."""

    def __init__(self, session: Session) -> None:
        assert session.whole is not None
        self._session = session
        count, rows, columns = session.whole.shape
        x, y, unit = axes_with_unit((rows, columns), session.whole.header.pixel_size)
        self._place = extent(x, y)
        self._shape = rows, columns
        self.picture = Picture(self._place, unit, _PICTURE)
        self._cross = ColumnDataSource(data={"x": [], "y": []})
        for width, colour in ((4, "white"), (2, "black")):
            self.picture.figure.scatter(
                "x", "y", source=self._cross, marker="cross", size=16, line_width=width, line_color=colour
            )
        self.dragging = Dragging(self.picture, self._drawn)
        self.picture.figure.on_event(Tap, self._tapped)
        self.frame = pn.widgets.IntSlider(
            label="Frame", start=0, end=count - 1, value=count // 2, width=_PICTURE[0] + 60
        )
        self.automatic = pn.widgets.Checkbox(label="Scale grey levels to this frame", value=True)
        self.frames = pn.widgets.IntRangeSlider(
            label="Frames used, from the first to the one after the last",
            start=0,
            end=count,
            step=1,
            value=(0, count),
            width=300,
            disabled=not session.can_cut,
        )
        self.whole = pn.widgets.Button(label="Use the whole picture", width=180, disabled=True)
        self._follows = False  # whether the fields show what was clicked
        self.row = pn.widgets.IntInput(label="Row", start=0, end=rows - 1, width=90)
        self.column = pn.widgets.IntInput(label="Column", start=0, end=columns - 1, width=90)
        for field in (self.row, self.column):
            field.param.watch(lambda _: self._type_pixel(), "value")
        self.graph = _Graph()
        self.facts = text(width=_GRAPH[0])
        self.frame.param.watch(lambda _: self._show_frame(), "value")
        self.automatic.param.watch(lambda _: self._show_frame(), "value")
        self.frames.param.watch(lambda _: self._choose_frames(), "value_throttled")
        self.whole.on_click(lambda _: session.choose_part(None, session.frames))
        session.watch("pixel", "result", "part", callback=self._show_pixel)
        session.watch("part", callback=self._show_part)
        self._show_frame()
        self._show_part()
        self._show_pixel()
        self.view = pn.FlexBox(
            pn.Column(
                self.frame,
                pn.pane.Bokeh(self.picture.figure),
                pn.Row(self.automatic, self.whole),
                text(hint(_HINT)),
            ),
            pn.Column(
                self.frames,
                pn.Row(self.row, self.column),
                pn.pane.Bokeh(self.graph.figure),
                self.facts,
                width=_GRAPH[0] + 20,
            ),
        )

    def _show_frame(self) -> None:
        assert self._session.whole is not None
        number = self.frame.value
        self.picture.show(show_frame(self._session.whole.frame(number), "", self.automatic.value))
        axis = self._where(number)
        self.frame.label = f"Frame{axis}"

    def _where(self, number: int) -> str:
        """Return the position of the body in a frame, in words."""
        whole = self._session.whole
        assert whole is not None
        if whole.motion == "axial" and whole.phase is not None:
            return f" at a phase of {math.degrees(whole.phase[number]):.1f} deg"
        if whole.travel is not None:
            return f" at a travel of {whole.travel[number]:.4g} mm"
        if whole.displacement is not None:
            return f" displaced by {np.hypot(*whole.displacement[number]):.4g} mm"
        if whole.twist is not None:
            return f" at a twist of {math.degrees(whole.twist[number]):.4g} deg"
        return ""

    def _tapped(self, event: Any) -> None:
        row, column = pixel_at(self._place, self._shape, event.x, event.y)
        self._session.point_at(math.floor(row), math.floor(column))

    def _type_pixel(self) -> None:
        """Choose the pixel of the fields, without a pointer."""
        if not self._follows:
            self._session.point_at(self.row.value or 0, self.column.value or 0)

    def _drawn(self, _: str, start: Point, end: Point) -> None:
        """Use the rectangle that was drawn."""
        region = region_between(self._place, self._shape, start, end)
        if region is not None and self._session.can_cut:
            self._session.choose_part(region, self._session.frames)
        else:
            self._show_part()

    def _choose_frames(self) -> None:
        first, end = self.frames.value
        whole = (first, end) == (0, self.frames.end)
        if end - first >= 1:
            self._session.choose_part(self._session.region, None if whole else (first, end))

    def _show_part(self) -> None:
        region = self._session.region
        self.whole.disabled = region is None
        self.dragging.outline(None if region is None else edges_of(self._place, self._shape, region))
        if self._session.frames is not None:
            first, end = self._session.frames
            self.frames.value = first, self.frames.end if end is None else end

    def _show_pixel(self) -> None:
        pixel = self._session.pixel
        if pixel is None:
            self.facts.object = hint("No pixel is chosen: click one in the picture.")
            return
        left, right, bottom, top = self._place
        (row, column), (rows, columns) = pixel, self._shape
        x = left + (column + 0.5) * (right - left) / columns
        y = top - (row + 0.5) * (top - bottom) / rows
        self._cross.data = {"x": [x], "y": [y]}
        self._follows = True
        self.row.value, self.column.value = pixel
        self._follows = False
        trace = trace_of(self._session)
        if trace is None:
            self.facts.object = hint("This pixel is outside of the region that is used.")
            return
        self.graph.show(trace, "Brightness of the pixel")
        self.facts.object = table({"Pixel": f"row {row}, column {column}", **trace.facts})


class _Graph:
    """The brightness of a pixel with levels, and the event or the fit."""

    def __init__(self) -> None:
        self.figure = figure(
            width=_GRAPH[0],
            height=_GRAPH[1],
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 255),
            tools="pan,wheel_zoom,box_zoom,reset",
            toolbar_location="above",
        )
        plain_axes(self.figure)
        self.source = ColumnDataSource(data={"x": [], "y": []})
        self.fit = ColumnDataSource(data={"x": [], "y": []})
        self.figure.line("x", "y", source=self.source, line_color=_LINE, line_alpha=0.5)
        points = self.figure.scatter("x", "y", source=self.source, size=6, color=_LINE)
        self.figure.line("x", "y", source=self.fit, line_color=_FIT, line_width=2)
        self.figure.add_tools(
            HoverTool(renderers=[points], tooltips=[("Position", "@x"), ("Brightness", "@y counts")])
        )
        self.figure.yaxis.axis_label = "brightness (counts)"
        self.spans, self.labels = {}, {}
        for name, colour in _COLOURS.items():
            self.spans[name] = Span(
                dimension="width", line_color=colour, line_dash="dashed", line_width=1.5, visible=False
            )
            self.labels[name] = Label(
                x=6, x_units="screen", y=0, y_offset=2, text=name.lower(), text_color=colour,
                text_font_size="12px", visible=False,
            )  # fmt: skip
        self.event = Span(dimension="height", line_color="#009e73", line_width=2, visible=False)
        self.band = BoxAnnotation(fill_color="#009e73", fill_alpha=0.2, line_alpha=0, visible=False)
        for item in (*self.spans.values(), *self.labels.values(), self.event, self.band):
            self.figure.add_layout(item)

    def show(self, trace: Trace, title: str) -> None:
        """Draw the brightness of a pixel."""
        self.figure.title.text = title
        self.figure.xaxis.axis_label = f"{trace.axis} ({trace.unit})" if trace.unit else trace.axis
        self.source.data = {"x": trace.position, "y": trace.brightness}
        x, y = ([], []) if trace.curve is None else trace.curve
        self.fit.data = {"x": x, "y": y}
        for name in _COLOURS:
            level = trace.levels.get(name)
            self.spans[name].visible = self.labels[name].visible = level is not None
            if level is not None:
                self.spans[name].location = self.labels[name].y = level
        shown = np.array([*trace.brightness, *trace.levels.values()])
        margin = 0.06 * (float(np.ptp(shown)) or 1.0)
        self.figure.y_range.update(start=float(shown.min()) - margin, end=float(shown.max()) + margin)
        aside = 0.03 * (float(np.ptp(trace.position)) or 1.0)
        self.figure.x_range.update(
            start=float(trace.position.min()) - aside, end=float(trace.position.max()) + aside
        )
        has_event = math.isfinite(trace.event)
        self.event.visible = has_event
        self.band.visible = has_event and math.isfinite(trace.event_sigma)
        if has_event:
            self.event.location = trace.event
        if self.band.visible:
            self.band.left, self.band.right = (
                trace.event - trace.event_sigma,
                trace.event + trace.event_sigma,
            )
