"""Tables of a TOML file: their keys, what each may be, and how that is said when it is something else."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from mirrorskin.io import InputError

# Reads a value; raises ValueError, which tells what is needed instead.
Reader = Callable[[Any], Any]

REQUIRED = object()
"""The default of a key that must be said."""

_LONGEST = 40  # letters of a value that a message quotes


@dataclass(frozen=True, slots=True)
class Key:
    """What is known of a key.

    Attributes
    ----------
    read : callable
        Reads its value; raises ValueError, which tells what is needed instead.
    example : str
        A value, as TOML writes it.
    default : object
        What holds if it is not said; ``REQUIRED`` if it must be.
    """

    read: Reader
    example: str
    default: Any = REQUIRED


def read_table(
    said: Any, keys: Mapping[str, Key], where: str, name: str = "", tables: Collection[str] = ()
) -> dict[str, Any]:
    """Read the values of a table; what is not said gets its default.

    Parameters
    ----------
    said : object
        The table as TOML gives it.
    keys : mapping
        What it may hold.
    where : str
        The file, for messages.
    name : str
        The table's dotted name; empty at the top of the file.
    tables : collection of str
        Names of tables in it, which are read elsewhere.

    Raises
    ------
    InputError
        It is no table, a key is not known or missing, or a value is not what it may be.
    """
    if not isinstance(said, dict):
        raise InputError(
            f"{where}: {name} is {quote(said)}: write [{name}] alone in a line, and its keys below"
        )
    for key in said:
        if key not in keys and key not in tables:
            raise InputError(f"{where}: {_dotted(name, key)} is not known: {_suggest(key, [*keys, *tables])}")
    return {key: _value(said, key, keys[key], where, name) for key in keys}


def _value(said: Mapping[str, Any], key: str, known: Key, where: str, name: str) -> Any:
    dotted = _dotted(name, key)
    if key not in said:
        if known.default is REQUIRED:
            raise InputError(f"{where}: {dotted} is missing; write {key} = {known.example} in [{name}]")
        return known.default
    try:
        return known.read(said[key])
    except ValueError as error:
        raise InputError(
            f"{where}: {dotted} is {quote(said[key])}: {error}; write e.g. {key} = {known.example}"
        ) from error


def _dotted(table: str, key: str) -> str:
    shown = key if key.isprintable() and key else repr(key)
    return f"{table}.{shown}" if table else shown


def _suggest(key: str, known: Collection[str]) -> str:
    close = difflib.get_close_matches(key.lower().replace("-", "_"), known, n=1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"


def quote(value: Any) -> str:
    """Write a value as TOML does, near enough to be recognised."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    try:
        text = f'"{value}"' if isinstance(value, str) else str(value)
    except ValueError:  # a whole number of thousands of digits
        return "out of all bounds"
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def number(words: str, fits: Callable[[float], bool] = lambda value: True) -> Reader:
    """Return what reads a finite number that fits; `words` name such a number."""

    def read(value: Any) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                known = float(value)
            except OverflowError:  # whole numbers may have any length
                known = math.inf
            if math.isfinite(known) and fits(known):
                return known
        raise ValueError(f"{words} is needed")

    return read


def whole(words: str, least: int, most: int) -> Reader:
    """Return what reads a whole number from `least` to `most`."""

    def read(value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise ValueError(f"{words} from {least} to {most} is needed")
        return value

    return read


def one_of(*known: str | int) -> Reader:
    """Return what reads one of several words or whole numbers."""

    def read(value: Any) -> str | int:
        for one in known:
            if type(value) is type(one) and value == one:
                return one
        raise ValueError(f"one of {', '.join(map(quote, known))} is needed")

    return read


def several(count: int, words: str, read_one: Reader) -> Reader:
    """Return what reads an array of `count` values of one kind."""

    def read(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(f"{words} are needed, in [ ]")
        return tuple(map(read_one, value))

    return read


def text(words: str) -> Reader:
    """Return what reads a text that is not empty, in one line."""

    def read(value: Any) -> str:
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            raise ValueError(f"{words} is needed, a text in quotes")
        return value

    return read


def flag(value: Any) -> bool:
    """Read true or false."""
    if not isinstance(value, bool):
        raise ValueError("true or false is needed")
    return value
