"""Options of an operation as widgets, generated from their declarations."""

from __future__ import annotations

import math
import re
from typing import Any

import panel as pn

from mirrorskin.engine.base.options import Option, plain
from mirrorskin.io import InputError
from mirrorskin.view.app.look import problem, text
from mirrorskin.view.app.session import Session

_WIDTH = 262
_DEGREES = {"rad": "deg"}  # units that people write instead of the declared one
_STEPS = 100  # of a slider
_UNTITLED = ".bk-slider-title { display: none; }"  # it is a name for who cannot see the field above
_FILE = re.compile(r"\.[A-Za-z]\w*$")  # the end of the name of a file


class OptionsPane:
    """Widgets of the operation and its options; a change computes the result again.

    Attributes
    ----------
    operation : Select
    widgets : dict of str to Widget
        The field of each option by name.
    notes : dict of str to HTML
        Why the text of a field is not used, next to it, by name.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.widgets: dict[str, Any] = {}
        self.notes: dict[str, Any] = {}
        self.operation = pn.widgets.Select(
            label="Operation",
            options=session.operations(),
            value=session.kind_name,
            width=_WIDTH,
            description="What is computed from the frames. All steps: as 'mirrorskin reconstruct' does.",
        )
        self._first, self._more = pn.Column(margin=0), pn.Column(margin=(0, -10))
        self.problem = text(width=_WIDTH)
        self.reset = pn.widgets.Button(label="Reset all options", width=_WIDTH)
        self.undo = pn.widgets.Button(label="Undo", width=_WIDTH // 2 - 10)
        self.redo = pn.widgets.Button(label="Redo", width=_WIDTH // 2 - 10)
        self.operation.param.watch(lambda event: self._choose_operation(event.new), "value")
        self.reset.on_click(lambda _: session.choose_operation(session.kind_name))
        self.undo.on_click(lambda _: session.undo())
        self.redo.on_click(lambda _: session.redo())
        session.watch("operation", callback=self._build)
        session.watch("problem", "result", callback=self._say)
        self._build()
        self._say()
        more = pn.Card(self._more, title="More options", collapsed=True, width=_WIDTH, margin=(8, 10))
        self.view = pn.Column(
            self.operation,
            self.problem,
            pn.Row(self.undo, self.redo),
            self._first,
            more,
            self.reset,
            width=_WIDTH + 20,
        )

    def _build(self) -> None:
        """Make the widgets of the operation: those with a value first, then those that may be left out."""
        self.widgets, self.notes = {}, {}
        kind = self._session.kind_name
        if self.operation.value != kind:
            self.operation.value = kind
        parts: dict[bool, list[Any]] = {True: [], False: []}
        for name, option in self._session.options().items():
            field, shown = widget_of(option, self._session.value(name))
            field.param.watch(lambda event, name=name: self._changed(name, event.new), "value")
            self.widgets[name], self.notes[name] = field, text(width=_WIDTH, visible=False)
            parts[option.default is not None].append(pn.Column(shown, self.notes[name], margin=0))
        self._first[:], self._more[:] = parts[True], parts[False]

    def _choose_operation(self, name: str) -> None:
        if name != self._session.kind_name:
            self._session.choose_operation(name)

    def _changed(self, name: str, value: Any) -> None:
        try:
            self._session.choose(name, read(self._session.kind.options[name], value))
        except InputError as error:
            self._session.refuse(name, str(error))

    def _say(self) -> None:
        """Show what is wrong next to the field that it is about, whose name messages begin with."""
        session = self._session
        about = session.problem.partition(" ")[0]
        self.problem.object = "" if about in self.notes else problem(session.problem)
        for name, note in self.notes.items():
            why = session.refused.get(name) or (session.problem if name == about else "")
            note.object, note.visible = problem(why), bool(why)
        self.undo.disabled, self.redo.disabled = not session.can_undo, not session.can_redo


def widget_of(option: Option, value: Any) -> tuple[Any, Any]:
    """Return the field of an option, and what is shown: with a slider between limits, or its explanation."""
    label = option.name.replace("_", " ").capitalize()
    unit = _DEGREES.get(option.unit, option.unit)
    titled = f"{label} ({unit})" if unit else label
    about = described(option)
    widgets, settings = pn.widgets, {"width": _WIDTH, "description": about}
    if option.kind == "flag" and not option.optional:
        box = widgets.Checkbox(label=label, value=value, margin=(8, 0, 8, 10))
        return box, pn.Row(box, widgets.TooltipIcon(value=about, margin=(6, 5)))
    if option.kind in ("choice", "flag"):
        chosen: dict[str, Any] = {choice: choice for choice in option.choices} or {"yes": True, "no": False}
        if option.optional:
            chosen = {option.shown_default or "none": None, **chosen}
        field = widgets.Select(label=label, options=chosen, value=plain(value), **settings)
        return field, field
    low, high = option.within
    if option.kind == "integer" and option.default is not None:
        # Without limits, so that a number beyond them is refused with the reason.
        field = widgets.IntInput(label=titled, value=value, **settings)
        return field, field
    if option.kind == "number" and option.default is not None and low is not None and high is not None:
        step = (high - low) / _STEPS
        field = widgets.FloatInput(label=titled, value=value, step=step, **settings)
        slider = widgets.FloatSlider(
            label=titled,
            stylesheets=[_UNTITLED],
            start=low,
            end=high,
            step=step,
            value=value,
            width=_WIDTH,
            show_value=False,
            margin=(0, 10),
        )
        slider.param.watch(lambda event: field.param.update(value=event.new), "value_throttled")
        field.param.watch(lambda event: _follow(slider, event.new), "value")
        return field, pn.Column(field, slider, margin=0)
    field = widgets.TextInput(
        label=titled, value=written(option, value), placeholder=option.shown_default or "none", **settings
    )
    return field, field


def _follow(slider: Any, value: float | None) -> None:
    if value is not None and slider.start <= value <= slider.end:
        slider.value = value


def described(option: Option) -> str:
    """Return help, limits and default of an option as a sentence."""
    text = f"{option.help[:1].upper()}{option.help[1:]}."
    low, high = option.within
    if (
        option.kind in ("number", "integer", "numbers", "integers", "map")
        and (low, high, option.above) != (None,) * 3
    ):
        text += f" {option.needed[:1].upper()}{option.needed[1:]}."
    default = option.shown_default or (plain(option.default) if option.kind != "flag" else "")
    return f"{text} Default: {default}." if default not in ("", None) else text


def written(option: Option, value: Any) -> str:
    """Return a value as the text of a field; empty if there is none."""
    if value is None:
        return ""
    if isinstance(value, list | tuple):
        return ", ".join(written(option, item) for item in value)
    value = plain(value)
    return str(value) if isinstance(value, str) else f"{value / _factor(option):.10g}"


def read(option: Option, value: Any) -> Any:
    """Return the value that a widget stands for, in the option's unit."""
    if not isinstance(value, str) or option.kind in ("choice", "flag"):
        return value
    text = value.strip()
    if not text:
        return option.default
    if (
        text in option.words
        or option.kind in ("file", "path", "text")
        or (option.kind == "map" and _FILE.search(text))
    ):
        return text
    numbers = [_number(option, part) for part in text.split(",")]
    if option.kind in ("numbers", "integers"):
        return numbers if option.kind == "numbers" else [_whole(number) for number in numbers]
    if len(numbers) > 1:
        raise InputError(f"{option.name} {text}: write the number with a decimal point")
    return _whole(numbers[0]) if option.kind == "integer" else numbers[0]


def _whole(number: float) -> float:
    """Return a number without fraction as an integer; any other number is refused by the option."""
    return int(number) if number.is_integer() else number


def _number(option: Option, text: str) -> float:
    try:
        return float(text) * _factor(option)
    except ValueError:
        raise InputError(f"{option.name} {text}: {option.needed} is needed") from None


def _factor(option: Option) -> float:
    return math.pi / 180 if option.unit == "rad" else 1.0
