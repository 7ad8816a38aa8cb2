"""Runs read again: the JSON that ``mirrorskin bench -o`` wrote, checked before anyone relies on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Never

from mirrorskin.io import InputError

Run = dict[str, Any]
"""What a benchmark found, as plain data; see `mirrorskin.bench.report.as_data`."""

_HUGE = 1e300


@dataclass(frozen=True, slots=True)
class _Value:
    """A value that is not made of others: what it is called, and what is one."""

    called: str
    fits: Callable[[Any], bool]


@dataclass(frozen=True, slots=True)
class _Named:
    """Values of one kind, under any names."""

    kind: object


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _HUGE


_TEXT = _Value("a text", lambda value: isinstance(value, str))
_FLAG = _Value("true or false", lambda value: isinstance(value, bool))
_NUMBER = _Value("a number", _is_number)
_COUNT = _Value("a number of things", lambda value: _is_number(value) and value >= 0)
_POSITIVE = _Value("a positive number", lambda value: _is_number(value) and value > 0)
_MAYBE_TEXT = _Value("a text or null", lambda value: value is None or isinstance(value, str))
_MAYBE_NUMBER = _Value("a number or null", lambda value: value is None or _is_number(value))

_ROW = {
    "name": _TEXT,
    "bytes": _COUNT,
    "frames": _COUNT,
    "operations": _COUNT,
    "wall": {"median": _POSITIVE, "lower": _POSITIVE, "upper": _POSITIVE, "rounds": _COUNT},
    "device": _Named({"median": _COUNT, "lower": _COUNT, "upper": _COUNT, "rounds": _COUNT}),
    "kernels": _Named(_NUMBER),
    "first": _NUMBER,
    "compile": _NUMBER,
    "bandwidth": _NUMBER,
    "share": _MAYBE_NUMBER,
    "kernel_share": _MAYBE_NUMBER,
}
_CASE = {
    "name": _TEXT,
    "title": _TEXT,
    "rows": [_ROW],
    "absent": _Named(_TEXT),
    "notes": [_TEXT],
    "targets": [{"what": _TEXT, "bound": _TEXT, "measured": _TEXT, "met": _FLAG}],
}
_RUN = {
    "date": _TEXT,
    "commit": _MAYBE_TEXT,
    "device": {"name": _TEXT, "platform": _TEXT, "driver": _TEXT, "kind": _TEXT},
    "processor": _TEXT,
    "threads": _NUMBER,
    "system": _TEXT,
    "versions": _Named(_MAYBE_TEXT),
    "quick": _FLAG,
    "cases": [_CASE],
}
_LATER: Mapping[str, Callable[[], object]] = {"operations": int, "notes": list, "targets": list}  # first runs


def open_run(path: Path) -> Run:
    """Return a run that was written as JSON.

    Parameters
    ----------
    path : Path
        Also of one that an earlier version wrote: what that did not tell yet is 0 or empty.

    Raises
    ------
    InputError
        The file cannot be read, is no JSON, or is not a run of the benchmark.
    """
    try:
        run = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON: name a file that 'mirrorskin bench -o' wrote") from error
    try:
        _check(run, _RUN, "")
    except _WrongError as error:
        raise InputError(f"{path}: {error}: name a file that 'mirrorskin bench -o' wrote") from error
    return dict(run)


class _WrongError(Exception):
    """Data is not of the kind it should be; the message says where."""


def _refuse(word: str) -> Never:
    raise ValueError(f"JSON knows no {word}")


def _check(value: Any, kind: object, where: str) -> None:
    """Raise unless a value is of a kind; what later versions added is filled in."""
    match kind:
        case _Value(called, fits):
            _require(fits(value), f"{where} is not {called}")
        case [inner]:
            _require(isinstance(value, list), f"{where} is not a list")
            for number, one in enumerate(value):
                _check(one, inner, f"{where}[{number}]")
        case _Named(inner):
            _require(isinstance(value, dict), f"{where} is not an object")
            for name, one in value.items():
                _check(one, inner, f"{where}.{name}")
        case dict():
            _require(isinstance(value, dict), f"{where or 'it'} is not an object")
            for name, inner in kind.items():
                inside = f"{where}.{name}" if where else name
                if name in _LATER:
                    value.setdefault(name, _LATER[name]())
                _require(name in value, f"{inside} is missing")
                _check(value[name], inner, inside)


def _require(fits: bool, said: str) -> None:
    if not fits:
        raise _WrongError(said)
