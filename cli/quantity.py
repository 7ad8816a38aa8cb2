"""Quantities with units, as they are written on the command line."""

from __future__ import annotations

import functools
import math
import re
from typing import Any, NamedTuple

from mirrorskin.io import InputError

# pint would compute what it is given; it is given the unit alone.
_QUANTITY = re.compile(
    r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([A-Za-z\u00b5\u03bc]+|°)?\s*"
)


class _Kind(NamedTuple):
    """A kind of quantity: its unit here, the one that all its units reduce to, and how to speak of it."""

    unit: str
    root: str
    noun: str
    example: str


_LENGTH = _Kind("millimeter", "meter", "a length", "0.1mm")
_ANGLE = _Kind("radian", "radian", "an angle", "2.5deg")
_MEMORY = _Kind("byte", "bit", "an amount of memory", "512MB")
_TIME = _Kind("second", "second", "a time", "10ms")
_PER_ANGLE = "5.7/deg"


def length(text: str, option: str = "") -> float:
    """Read a length, as in ``0.1mm``.

    Parameters
    ----------
    text : str
        A number and a unit.
    option : str, optional
        What to call it in messages.

    Returns
    -------
    float
        Millimetres, of either sign.

    Raises
    ------
    InputError
        It is not a finite number with a unit of length.
    """
    return _read(text, option, _LENGTH)


def lengths(text: str, option: str = "") -> tuple[float, float]:
    """Read one length for both axes, or two as in ``0.03mm,0.04mm``; see ``length``.

    Returns
    -------
    (float, float)
        Millimetres along x and y.
    """
    values = [length(part, option) for part in text.split(",")]
    if len(values) > 2:
        raise _error(text, option, "one or two lengths are needed", "0.03mm,0.04mm")
    return values[0], values[-1]


def vector(text: str, count: int, option: str = "") -> tuple[float, ...]:
    """Read so many lengths, as in ``0mm,0mm,40mm``, in millimetres; see ``length``."""
    values = tuple(length(part, option) for part in text.split(","))
    if len(values) != count:
        raise _error(text, option, f"{count} lengths are needed", ",".join(["0mm"] * (count - 1) + ["1mm"]))
    return values


def segment(text: str, option: str = "") -> tuple[tuple[float, float], tuple[float, float]]:
    """Read two points, as in ``-2mm,0mm:2mm,1mm``: x and y of each, in millimetres; see ``length``.

    Raises
    ------
    InputError
        It is not that, or both are one point.
    """
    ends = tuple(vector(part, 2, option) for part in text.split(":"))
    if len(ends) != 2 or ends[0] == ends[1]:
        raise _error(text, option, "two points are needed", "-2mm,0mm:2mm,0mm")
    return (ends[0][0], ends[0][1]), (ends[1][0], ends[1][1])


def compliance(text: str, option: str = "") -> float:
    """Read by how much a newton moves something, as in ``0.01mm/N``, in mm/N; see ``length``."""
    distance, slash, newton = text.strip().rpartition("/")
    if not slash or newton.strip() != "N":
        raise _error(text, option, "a length for each newton is needed", "0.01mm/N")
    return length(distance, option)


def duration(text: str, option: str = "") -> float:
    """Read a time, as in ``10ms``, in seconds; see ``length``."""
    return _read(text, option, _TIME)


def angle(text: str, option: str = "") -> float:
    """Read an angle, as in ``2.5deg``, in radians; see ``length``."""
    return _read(text, option, _ANGLE)


def per_angle(text: str, option: str = "") -> float:
    """Read a number for each unit of angle, as in ``5.7/deg``, per radian.

    Raises
    ------
    InputError
        It is not a finite number over a unit of angle.
    """
    over, _, under = text.partition("/")
    number, one = _QUANTITY.fullmatch(over), _QUANTITY.fullmatch(f"1 {under}")
    if number is None or number[2] or one is None or not one[2]:
        raise _error(text, option, "a number over a unit of angle is needed", _PER_ANGLE)
    radians = _registry().convert(1.0, _unit(text, one[2], option, _ANGLE, _PER_ANGLE), _ANGLE.unit)
    return _finite(float(number[1]) / radians, text, option, _PER_ANGLE)


def memory(text: str, option: str = "") -> int:
    """Read an amount of memory, as in ``512MB`` (10^6) or ``512MiB`` (2^20), in bytes; see ``length``.

    Raises
    ------
    InputError
        It is not a number with a unit of memory, or less than one byte.
    """
    size = round(_read(text, option, _MEMORY))
    if size < 1:
        raise _error(text, option, "at least one byte is needed", _MEMORY.example)
    return size


def frame_size(text: str, option: str = "") -> tuple[int, int]:
    """Read a picture's size in pixels, as in ``640x480``: columns and rows.

    Raises
    ------
    InputError
        It is not two whole numbers above zero.
    """
    match = re.fullmatch("([1-9][0-9]{0,8})x([1-9][0-9]{0,8})", text.strip())
    if match is None:
        raise _error(text, option, "pixels across and down are needed", "640x480")
    return int(match[1]), int(match[2])


def _read(text: str, option: str, kind: _Kind) -> float:
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise _error(text, option, "a number and a unit are needed", kind.example)
    number, symbol = match.groups()
    if symbol is None:
        raise _error(text, option, "a unit is needed", kind.example)
    unit = _unit(text, symbol, option, kind, kind.example)
    return _finite(float(_registry().convert(float(number), unit, kind.unit)), text, option, kind.example)


def _unit(text: str, symbol: str, option: str, kind: _Kind, example: str) -> Any:
    """Return the unit of a symbol if it is of a kind."""
    import pint  # takes a quarter of a second

    registry = _registry()
    try:
        unit = registry.Unit(symbol)
    except (pint.UndefinedUnitError, ValueError) as error:
        raise _error(text, option, f"{symbol} is not a known unit", example) from error
    # A pixel of a style sheet is a length, but nobody here means that one.
    if registry.get_root_units(unit)[1] != registry.Unit(kind.root) or unit == registry.Unit("css_pixel"):
        raise _error(text, option, f"{unit}s are not {kind.noun}", example)
    return unit


def _finite(value: float, text: str, option: str, example: str) -> float:
    if not math.isfinite(value):
        raise _error(text, option, "the number is too large", example)
    return value


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _error(text: str, option: str, wrong: str, example: str) -> InputError:
    return InputError(f"{' '.join((option + ' ' + text).split())}: {wrong}; write e.g. {example}")
