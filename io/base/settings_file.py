"""TOML files written by users, checked against a model: a `msgspec.Struct` with a field for each key."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from mirrorskin.io.base.system import read_text
from mirrorskin.io.base.text import printable, shortened
from mirrorskin.io.base.types import InputError

_Model = TypeVar("_Model", bound=msgspec.Struct)


def load_toml(path: str | Path, model: type[_Model], remedy: str) -> _Model:
    """Read a TOML file as its model; ``remedy`` ends the message about a file that cannot be read.

    A table is a field whose type is a `msgspec.Struct`. The type of a key defines its values: a number with
    bounds, a text, a choice (`Literal`), a list. ``msgspec.Meta`` contains the bounds, a description of valid
    values (``description``) and examples (``examples``). A ``__post_init__`` that raises ValueError checks
    the consistency of several keys. Numbers are finite.

    Examples
    --------
    >>> from typing import Annotated
    >>> import msgspec
    >>> Length = Annotated[float, msgspec.Meta(gt=0, description="a length above 0, in mm,", examples=[0.5])]
    >>> class Stage(msgspec.Struct):
    ...     press: Length
    >>> class Rig(msgspec.Struct):
    ...     stage: Stage
    >>> load_toml("rig.toml", Rig, "'mirrorskin rig new' writes a template").stage.press  # doctest: +SKIP
    2.0
    """
    path = Path(path)
    text = read_text(path, remedy)
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        comma = re.search(r"^[^#\n\"']*=\s*([+-]?\d+),(\d+)\s*(?:#.*)?$", text, re.MULTILINE)
        if comma:
            line = text.count("\n", 0, comma.start()) + 1
            written, number = ",".join(comma.groups()), ".".join(comma.groups())
            raise InputError(
                f"{path}, line {line}: {written}: write the number with a decimal point, {number}"
            ) from error
        raise InputError(f"{path} is not TOML: {error}; correct it there") from None
    return _table(tables, model, str(path), "")


def quote(value: Any) -> str:
    """Return a value in TOML syntax, approximately, for messages."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    try:
        text = f'"{value}"' if isinstance(value, str) else str(value)
    except ValueError:  # an integer with thousands of digits
        return "too large a number"
    return shortened(printable(text))


def _table(values: Any, model: type[_Model], where: str, name: str) -> _Model:
    if not isinstance(values, dict):
        raise InputError(
            f"{where}: {name} is {quote(values)}: write [{name}] alone in a line, and its keys below"
        )
    fields = {field.encode_name: field for field in msgspec.structs.fields(model)}
    for key in values:
        if key not in fields:
            raise InputError(f"{where}: {_dotted(name, key)} is not known: {_suggest(key, list(fields))}")
    arguments: dict[str, Any] = {}
    for key, field in fields.items():
        kind, dotted = field.type, _dotted(name, key)
        table = next((member for member in _within(kind) if _is_model(member)), None)
        if key not in values and field.required:
            missing = f"table [{dotted}]" if table else f"{key} = {_example(kind)} in [{name}]"
            raise InputError(f"{where}: {dotted} is missing: add {missing}")
        if key in values and table:
            arguments[field.name] = _table(values[key], table, where, dotted)
        elif key in values:
            arguments[field.name] = _value(values[key], kind, f"{where}: {dotted}", key)
    try:
        return model(**arguments)
    except ValueError as error:
        raise InputError(f"{where}: {f'[{name}] ' if name else ''}{error}") from None


def _value(value: Any, kind: Any, where: str, key: str) -> Any:
    try:
        if not _is_finite(value):
            raise OverflowError("a number that is not finite")
        return _convert(value, kind)
    except (msgspec.ValidationError, OverflowError) as error:
        needed, example = _needed(kind), f"{key} = {_example(kind)}"
        raise InputError(f"{where} is {quote(value)}: {needed} is needed; write e.g. {example}") from error


def _convert(value: Any, kind: Any) -> Any:
    """Convert to the first matching type of a union: msgspec 0.22 crashes on a tuple and a bound in one."""
    inner = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(inner) not in (Union, UnionType):
        return msgspec.convert(value, kind)
    problems = []
    for member in get_args(inner):
        try:
            return _convert(value, member)
        except msgspec.ValidationError as error:
            problems.append(error)
    raise problems[0]


def _is_finite(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _within(kind: Any) -> Iterator[Any]:
    """Yield a type, or the members of a union, without their annotations."""
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    yield kind
    if get_origin(kind) is not Literal and not _is_model(kind):
        for member in get_args(kind):
            yield from _within(member)


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _meta(kind: Any) -> msgspec.Meta | None:
    """Return the outermost annotation with a description."""
    if get_origin(kind) is Annotated:
        for annotation in kind.__metadata__:
            if isinstance(annotation, msgspec.Meta) and annotation.description:
                return annotation
    inner = () if get_origin(kind) is Literal else get_args(kind)
    return next((meta for member in inner if (meta := _meta(member)) is not None), None)


def _choices(kind: Any) -> tuple[Any, ...]:
    literal = next((member for member in _within(kind) if get_origin(member) is Literal), None)
    return (True, False) if literal is None else get_args(literal)


def _needed(kind: Any) -> str:
    meta = _meta(kind)
    if meta is not None:
        return str(meta.description)
    return f"one of {', '.join(map(quote, _choices(kind)))}"


def _example(kind: Any) -> str:
    meta = _meta(kind)
    return quote(meta.examples[0] if meta is not None and meta.examples else _choices(kind)[0])


def _dotted(table: str, key: str) -> str:
    shown = key if key.isprintable() and key else repr(key)
    return f"{table}.{shown}" if table else shown


def _suggest(key: str, names: list[str]) -> str:
    close = difflib.get_close_matches(key.lower(), names, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"
