"""The pane of a rig: its live picture, moves by hand, and a run that shows its maps while they grow."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, CustomJS, Range1d
from bokeh.plotting import figure

from mirrorskin.io import InputError
from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.types import axes_with_unit
from mirrorskin.view.app.look import heading, hint, plain_axes, problem, table, text
from mirrorskin.view.app.picture import Picture, show_frame, show_map
from mirrorskin.view.app.rig_control import (
    RigControl,
    axial_plan,
    judge,
    rock_plan,
    slide_plan,
    twist_plan,
    vertical_plan,
)
from mirrorskin.view.drawing.canvas import extent
from mirrorskin.view.result.scale import in_figure_unit
from mirrorskin.view.result.sheet import sheet_of

REFRESH = 150
"""Milliseconds from one look at the rig to the next."""

_PICTURE = 360, 300  # largest size, CSS pixels
_HISTOGRAM = 360, 130
_NARROW = 130  # width of a field
_STEPS = {"mm": [0.01, 0.05, 0.1, 0.5, 1.0], "deg": [0.1, 0.5, 1.0, 5.0]}
_NAMES = {"travel": "travel (down)", "pitch": "pitch", "roll": "roll", "x": "x", "y": "y", "twist": "twist"}
_STATES = {
    "disconnected": "not connected",
    "connecting": "connecting",
    "ready": "ready, the stage rests",
    "moving": "the stage moves",
}
_STOP = """
const say = detail => document.dispatchEvent(new CustomEvent("stop-asked", {detail}))
fetch(address, {method: "POST", signal: AbortSignal.timeout(1000)}).then(
  async answer => say(answer.ok ? "" : await answer.text() || `answer ${answer.status}`),
  () => say("the program does not answer"))
"""
_DRAWN = """
requestAnimationFrame(() => requestAnimationFrame(() => seen.data = {number: cb_obj.data.number}))
"""
_TOUCH = "touch"  # a press and a turn, until the surface is good enough
_UNSEEN = 5.0  # seconds after which a picture that was not drawn does not hold up the next one
_SATURATED = 0.001  # share of the pixels above which the exposure is too long


class RigPane:
    """Buttons and pictures of a rig.

    Attributes
    ----------
    stop : Button
        Stops the stage; the page shows it at its head, whatever else it shows.
    """

    def __init__(self, control: RigControl, add: Callable[[str, Any], None]) -> None:
        self.control, self._add = control, add
        self._drawn: Any = None
        self._ranges: dict[str, tuple[float, float]] = {}  # of the maps of a run
        self._shown: Any = None
        self._noted = ""  # text of a touch
        self._sent = ColumnDataSource(data={"number": [0]})
        self._seen = ColumnDataSource(data={"number": [0]})  # what the browser has drawn
        self._sent_at = -math.inf
        self._sent.js_on_change("data", CustomJS(args={"seen": self._seen}, code=_DRAWN))
        self.stop = pn.widgets.Button(label="STOP", color="danger", width=110, height=38)
        self.stop.on_click(lambda _: self._stop())
        if control.stop_address:  # answered at once, also while this program computes
            self.stop.js_on_click(args={"address": control.stop_address}, code=_STOP)
        home = control.settings.stage.home
        label = "Connect, and home the stage (it moves)" if home else "Connect"
        self.connect = pn.widgets.Button(label=label, color="primary", width=270)
        self.connect.on_click(lambda _: self._ask(control.connect))
        self.state = text(width=420)
        self.facts = text(width=_PICTURE[0])
        rows, columns = control.settings.camera.shape
        x, y, unit = axes_with_unit((rows, columns), control.settings.camera.pixel_sides)
        self.camera = Picture(extent(x, y), unit, _PICTURE)
        self.growing = Picture(extent(x, y), unit, _PICTURE)
        self.camera.figure.tags = [self._sent, self._seen]
        self.histogram = ColumnDataSource(data={"left": [], "right": [], "top": []})
        self._places = {name: text(width=90) for name in control.settings.stage.axes}
        self.steps = {
            unit: pn.widgets.Select(label=f"Step ({unit})", options=values, value=values[1], width=_NARROW)
            for unit, values in _STEPS.items()
        }
        self.view = pn.FlexBox(
            pn.Column(
                pn.pane.Bokeh(self.camera.figure), self.facts, pn.pane.Bokeh(self.growing.figure),
                *self._about_run(),
            ),
            pn.Column(
                pn.Row(self.connect), self.state, *self._jogging(), *self._running(),
                pn.pane.Bokeh(self._histogram()), width=440,
            ),
        )  # fmt: skip
        self.refresh()

    def _histogram(self) -> Any:
        width, height = _HISTOGRAM
        drawn = figure(
            width=width + 60,
            height=height,
            tools="",
            toolbar_location=None,
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 1.05),
        )
        self._brightness = drawn.x_range
        plain_axes(drawn)
        drawn.quad("left", "right", "top", 0, source=self.histogram, color="#56606b", line_width=0)
        drawn.xaxis.axis_label = "brightness (counts)"
        drawn.yaxis.visible = False
        return drawn

    def _jogging(self) -> list[Any]:
        """Return the buttons of moves by hand."""
        axes = self.control.settings.stage.axes
        units = list(dict.fromkeys(axis.unit for axis in axes.values()))
        rows = []
        self.jogs: dict[tuple[str, int], Any] = {}
        for name, axis in axes.items():
            buttons = []
            for sign, label in ((-1, "\N{MINUS SIGN}"), (1, "+")):
                button = pn.widgets.Button(label=f"{name} {label}", width=72)
                button.on_click(lambda _, name=name, sign=sign: self._jog(name, sign))
                self.jogs[name, sign] = button
                buttons.append(button)
            low, high = axis.limits
            limits = hint(f"{low:g} to {high:g} {axis.unit}")
            name_of = text(f"<p>{_NAMES[name]}</p>{limits}", width=110)
            rows.append(pn.Row(name_of, *buttons, self._places[name], margin=(0, 0)))
        self.lift = pn.widgets.Button(label="Lift", width=90)
        self.lift.on_click(lambda _: self._ask(self.control.lift))
        return [heading("Move by hand"), pn.Row(*(self.steps[unit] for unit in units), self.lift), *rows]

    def _running(self) -> list[Any]:
        """Return the fields of a run."""
        axes, deepest = self.control.settings.stage.axes, self.control.settings.stage.press

        def field(label: str, value: float, step: float = 0.1) -> Any:
            return pn.widgets.FloatInput(label=label, value=value, step=step, width=_NARROW)

        self.press = {
            "start": field("From travel (mm)", 0.0),
            "stop": field("To travel (mm)", min(1.5, deepest)),
            "speed": field("Speed (mm/s)", 0.5),
        }
        at = min(1.0, deepest)
        self.turn = {
            "press": field("At travel (mm)", at),
            "tilt": field("Tilt (deg)", 2.5),
            "turns": field("Turns", 1.0, 1.0),
            "rate": field("Turns per second", 0.5),
        }
        self.slide = {
            "press": field("At travel (mm)", at),
            "distance": field("Distance (mm)", 0.5),
            "direction": field("Direction (deg)", 0.0, 15.0),
            "speed": field("Speed (mm/s)", 0.2),
        }
        self.twist = {
            "press": field("At travel (mm)", at),
            "angle": field("Angle (deg)", 10.0, 1.0),
            "speed": field("Speed (deg/s)", 4.0),
        }
        self.rock = {
            "press": field("At travel (mm)", at),
            "tilt": field("Tilt (deg)", 2.5),
            "phase": field("Direction (deg)", 0.0, 15.0),
            "speed": field("Speed (deg/s)", 2.0),
        }
        self.touch = {
            "sigma": field("Standard deviation (µm)", 3.0, 1.0),
            "share": field("Of the pixels (%)", 95.0, 1.0),
            "press": field("To travel (mm)", at),
            "tilt": field("Tilt (deg)", 2.5),
            "region": pn.widgets.TextInput(
                label="Region (may be empty)", placeholder="100,50,64x48", width=_NARROW
            ),
        }
        # Fields and the plan by motion, where the stage has the axes.
        self._motions: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {
            "press": (self.press, vertical_plan)
        }
        if {"pitch", "roll"} <= {*axes}:
            self._motions |= {"rotation": (self.turn, axial_plan), "rocking": (self.rock, rock_plan)}
            self._motions[_TOUCH] = self.touch, dict
        if {"x", "y"} <= {*axes}:
            self._motions["slide"] = self.slide, slide_plan
        if "twist" in axes:
            self._motions["twist"] = self.twist, twist_plan
        self.motion = pn.widgets.Select(
            label="Motion", options=[*self._motions], value="press", width=_NARROW
        )
        self._fields = pn.FlexBox(*self.press.values())
        self.file = pn.widgets.TextInput(
            label="Record to (may be empty)", placeholder="recording.h5", width=280
        )
        self.start = pn.widgets.Button(label="Start", color="primary", width=110, margin=(27, 10))
        self.motion.param.watch(lambda _: self._choose_motion(), "value")
        self.start.on_click(lambda _: self._start())
        return [heading("Run and reconstruct"), self.motion, self._fields, pn.Row(self.file, self.start)]

    def _about_run(self) -> list[Any]:
        self.run = text(hint("While it runs, its map grows here."), width=_PICTURE[0])
        self.open = pn.widgets.Button(label="Show the result", width=200, visible=False)
        self.open.on_click(lambda _: self._show_result())
        return [self.run, self.open]

    def _show_result(self) -> None:
        """Show the recording of the last run, or its result if it was not recorded."""
        control = self.control
        if control.recorded is not None:
            self._add(control.recorded.name, control.recorded)
        elif control.result is not None:
            self._add("live result", control.result)

    def _choose_motion(self) -> None:
        self._fields[:] = list(self._motions[self.motion.value][0].values())

    def _stop(self) -> None:
        self.control.stop()
        self.refresh()

    def _ask(self, request: Any) -> None:
        request()
        self.refresh()

    def _jog(self, axis: str, sign: int) -> None:
        unit = self.control.settings.stage.axes[axis].unit
        step = float(self.steps[unit].value)
        by = math.radians(step) if unit == "deg" else step
        self._ask(lambda: self.control.jog(axis, sign * by))

    def _start(self) -> None:
        fields, plan_of = self._motions[self.motion.value]
        try:
            values = {name: _value_of(field) for name, field in fields.items()}
            plan = plan_of(**values)
        except InputError as error:
            self.control.problem = str(error)
            self.refresh()
            return
        name = self.file.value.strip()
        record = Path(name) if name else None
        if self.motion.value == _TOUCH:
            request = 1e-3 * values["sigma"], values["share"] / 100, values["press"], values["tilt"]
            self._ask(lambda: self.control.touch(*request, record, values["region"]))
        else:
            self._ask(lambda: self.control.run(plan, record))

    def refresh_when_drawn(self) -> None:
        """Show what the rig shows now, if the browser has drawn what was shown before.

        Pictures do not queue then, and the newest one is shown.
        """
        now = time.monotonic()
        drawn = self._seen.data["number"] == self._sent.data["number"]
        if drawn or now - self._sent_at > _UNSEEN:
            self.refresh()
            self._sent_at = now
            self._sent.data = {"number": [self._sent.data["number"][0] + 1]}

    def begin_showing(self) -> None:
        """Show the rig now: the browser has not drawn what changed while it showed something else."""
        self._sent_at = -math.inf
        self.refresh()

    def refresh(self) -> None:
        """Show what the rig shows now."""
        control, state = self.control, self.control.seen
        self.connect.disabled = control.state != "disconnected"
        self.start.disabled = self.lift.disabled = control.state != "ready"
        self.open.visible = control.result is not None and control.state != "moving"
        for button in self.jogs.values():
            button.disabled = control.state != "ready"
        _set(self.state, f"<p>{_STATES[control.state]}</p>{problem(control.problem)}")
        here = control.position
        for name, place in self._places.items():
            axis = control.settings.stage.axes[name]
            value = "unknown" if here is None else f"{getattr(here, name) * axis.scale:.3f} {axis.unit}"
            _set(place, f"<p>{value}</p>")
        if state.frame is not None and state.frame is not self._drawn:
            self._drawn = state.frame
            self._show_frame(state.frame)
        if state.note != self._noted:
            self._noted = state.note
            self._show_touch()
        if state.update is not self._shown:
            self._shown = state.update
            self._show_run()

    def _show_frame(self, frame: Any) -> None:
        self.camera.show(show_frame(frame, "", automatic=False), about="live")
        judged = judge(frame)
        heights = judged.counts / max(1, int(judged.counts.max()))
        self.histogram.data = {"left": judged.edges[:-1], "right": judged.edges[1:], "top": np.sqrt(heights)}
        self._brightness.end = float(judged.edges[-1])
        advice = ": shorten the exposure" if judged.saturated > _SATURATED else ""
        facts = {
            "Saturated": f"{100 * judged.saturated:.2f} %{advice}",
            "Sharpness": f"{judged.sharpness:.2f}, larger is sharper",
            "Frames": f"{self.control.seen.frames}, {self.control.seen.rate:.1f} per second",
        }
        _set(self.facts, table(facts))

    def _show_touch(self) -> None:
        """Show what a touch expects or why it ended, and its newest surface."""
        surface = self.control.seen.surface
        if surface is not None:
            self.growing.show(show_map(sheet_of(surface), "height"), about="of the touch")
        _set(self.run, hint(self._noted))

    def _show_run(self) -> None:
        update, status = self.control.seen.update, self.control.seen.status
        if update is None or status is None:
            self._ranges.clear()  # a run begins
            return
        facts = {"Frames used": f"{status.used}, {status.skipped} skipped, {status.dropped} dropped"}
        if update.motion in ("vertical", "horizontal"):
            facts["Travel" if update.motion == "vertical" else "Slide"] = f"{update.position:.3f} mm"
        elif update.motion == "axial" and "slope" not in update.maps:
            facts["Phase"] = f"{math.degrees(update.position) % 360:.1f} deg"
        else:
            name = "Tilt" if update.motion == "axial" else "Twist"
            facts[name] = f"{math.degrees(update.position):.2f} deg"
        for name, value in update.maps.numbers().items():
            declared = update.maps.declaration(name)
            facts[declared.title_of(name)] = in_figure_unit(value, declared)
        first = update.first
        if first is not None and np.isfinite(update.maps[first]).any():
            shown = show_map(sheet_of(update.maps), first)
            # Colours change as little as possible.
            low, high = self._ranges.get(first, (shown.low, shown.high))
            low, high = self._ranges[first] = min(low, shown.low), max(high, shown.high)
            self.growing.show(replace(shown, low=low, high=high), about="while the stage moves")
        _set(self.run, table(facts))


def _value_of(field: Any) -> Any:
    """Return the value of a field, angles in radians, and a region for a text; None if that is empty."""
    if isinstance(field.value, str):
        region = Region.read("".join(field.value.split()))
        if region is None and field.value.strip():
            raise InputError(f"{field.label}: give the first column and row, and how many: 100,50,64x48")
        return region
    if field.value is None:
        raise InputError(f"{field.label}: a number is needed")
    return math.radians(field.value) if "(deg" in field.label else float(field.value)


def _set(pane: Any, content: str) -> None:
    """Set a text, if it differs: each change is sent to the browser."""
    if pane.object != content:
        pane.object = content
