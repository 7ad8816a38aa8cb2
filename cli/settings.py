"""Settings of a batch, a TOML file: properties that the stacks lack, and options of the computation."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, defstruct, field, structs

from mirrorskin.cli.declared import Term, term_of
from mirrorskin.cli.stack import STACK, stack_options
from mirrorskin.engine.base.options import Option
from mirrorskin.engine.base.reconstruction import load_operation, method_for
from mirrorskin.engine.batch.jobs import TABLES, Plan
from mirrorskin.engine.rotation.tilt import check_tilt
from mirrorskin.io import InputError
from mirrorskin.io.base.settings_file import load_toml
from mirrorskin.io.base.system import read_text

_REMEDY = "write the tables [stack], [press], [rotation], [slip], or [stack] and [operation] in TOML"


def _text(example: str) -> Meta:
    return Meta(min_length=1, description="a text in quotes", examples=[example])


def read_settings(path: Path | None, memory_limit: int) -> Plan:
    """Read the settings of a batch, which apply to every recording."""
    if path is None:
        return Plan(memory_limit=memory_limit)
    kinds: dict[str, type[Any]] = {table: method_for(motion) for motion, table in TABLES.items()}
    if operation := _operation_of(path):
        try:
            kinds = {"operation": load_operation(operation)}
        except InputError as error:
            raise InputError(f"{path}: operation.class: {error}") from None
    stack = [(term.name, _stack_type(term) | None, None) for term in STACK.without("phases").terms]
    tables: dict[str, type[Struct]] = {"stack": defstruct("stack", stack, frozen=True, rename="kebab")}
    tables |= {name: _table(name, kind) for name, kind in kinds.items()}
    fields: Any = [(name, model, field(default_factory=model)) for name, model in tables.items()]
    settings = load_toml(path, defstruct("Settings", fields, frozen=True), _REMEDY)
    stored = {name: _given(getattr(settings, name)) for name in tables}
    opening = _opening(stored["stack"], f"{path}: stack.")
    chosen: dict[str, Any] = {
        name: _options(stored[name], kind, f"{path}: {name}") for name, kind in kinds.items()
    }
    if operation:
        chosen = {"operation": operation, "operation_options": chosen["operation"]}
    return Plan(opening, memory_limit=memory_limit, **chosen)


def _operation_of(path: Path) -> str:
    """Return the class of the table [operation], with the whole path of a file; "" without that table.

    `load_toml` reports other faults of the file.
    """
    text = read_text(path, _REMEDY)
    try:
        table = tomllib.loads(text).get("operation")
    except (ValueError, RecursionError):
        return ""
    if not isinstance(table, dict):
        return ""
    name = str(table.get("class", ""))
    if not name:
        needed = 'MODULE:CLASS or FILE.py:CLASS is needed; write e.g. class = "mine.py:Wear"'
        raise InputError(f"{path}: operation.class: {needed}")
    place, _, kind = name.rpartition(":")
    return f"{Path(place).resolve()}:{kind}" if place.endswith(".py") else name


def _table(name: str, kind: type[Any]) -> type[Struct]:
    """Return the model of a table with the options of a class."""
    fields = [
        (option.name, _type(option) | None, None)
        for option in kind.options.values()
        if not option.python_only
    ]
    if name == "operation":
        fields = [("class_", Annotated[str, _text("mine.py:Wear")], field(name="class")), *fields]
    return defstruct(name, fields, frozen=True, rename="kebab", kw_only=True)


def _stack_type(term: Term) -> Any:
    """Return the type in TOML of an option of a stack."""
    if term.kind == "flag":
        return bool
    return Literal[term.choices] if term.choices else Annotated[str, _text(term.example or term.unit)]


def _type(option: Option) -> Any:
    """Return the type of an option's value in TOML."""
    term = term_of(option)
    if option.kind == "flag":
        return bool
    if option.kind == "choice":
        return Literal[option.choices]
    if option.kind in ("file", "path", "text") or option.words or term.example:
        meta = _text(option.file or term.example or term.unit)
        kind: Any = Annotated[str, meta]
    else:
        number = int if option.kind in ("integer", "integers") else float
        bounds = zip(("ge", "le", "gt"), (*option.within, option.above), strict=True)
        limits: dict[str, Any] = {name: bound for name, bound in bounds if bound is not None}
        meta = Meta(description=option.needed, examples=[number(option.example or 1)], **limits)
        kind = Annotated[number, meta]
    if option.kind not in ("numbers", "integers"):
        return kind
    item, examples = str(meta.description), [meta.examples]
    return Annotated[list[kind], Meta(description=f"a list, with each item {item},", examples=examples)]


def _given(table: Struct) -> dict[str, Any]:
    return {name: value for name, value in structs.asdict(table).items() if value is not None}


def _options(values: Mapping[str, Any], kind: type[Any], where: str) -> dict[str, Any]:
    """Return options in their units, with which the class can be constructed."""
    values_read = {}
    for name, value in values.items():
        if name == "class_":
            continue
        option, term = kind.options[name], term_of(kind.options[name])
        place = f"{where}.{name.replace('_', '-')}"
        if option.kind in ("file", "path"):
            values_read[name] = Path(value)
            continue
        if isinstance(value, list):
            value = [term.read_one(part, place) if isinstance(part, str) else part for part in value]
        elif isinstance(value, str):
            value = term.read_one(value, place)
        values_read[name] = value
    try:
        chosen: dict[str, Any] = kind(**values_read).written()
    except InputError as error:
        raise InputError(f"{where}{_with_key(str(error), kind)}") from None
    return {name: chosen[name] for name in values_read}


def _with_key(message: str, kind: type[Any]) -> str:
    """Return a message about options after the name of a table: with the key, if it starts with an option."""
    name, space, rest = message.partition(" ")
    return f".{name.replace('_', '-')}{space}{rest}" if name in kind.options else f": {message}"


def _opening(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert [stack] to keywords of ``open_recording``; InputError for those that no stack can have."""
    read = {}
    for term in STACK.terms:
        if term.name in values:
            value, place = values[term.name], f"{where}{term.flag[2:]}"
            if term.kind == "file":
                value = Path(value)
            read[term.name] = term.read(value, place) if isinstance(value, str) else value
    options = stack_options(read, where)
    if "tilt" in options:
        try:
            check_tilt(options["tilt"])
        except InputError as error:
            raise InputError(f"{where}tilt: {error}") from None
    if min(options.get("pixel_size", (1.0,))) <= 0:
        raise InputError(f'{where}pixel-size: a length above 0 is needed; write e.g. "0.03mm"')
    return dict(options)
