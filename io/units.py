"""Conversion of units: common ones from a table, others by pint."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from typing import Any, Literal

from mirrorskin.io.types import InputError

Kind = Literal["length", "angle", "time", "memory", "force", "pressure"]

BASE: dict[Kind, str] = {
    "length": "mm",
    "angle": "rad",
    "time": "s",
    "memory": "byte",
    "force": "N",
    "pressure": "N/mm^2",
}
"""The base unit of each kind of quantity."""

_GRAVITY = 9.80665  # m/s^2, converts a mass to its weight

_COMMON: dict[Kind, dict[str, float]] = {
    "length": {
        "mm": 1.0,
        "um": 0.001,
        "\u00b5m": 0.001,
        "\u03bcm": 0.001,
        "cm": 10.0,
        "m": 1000.0,
        "in": 25.4,
    },
    "angle": {"rad": 1.0, "mrad": 0.001, "deg": math.pi / 180, "°": math.pi / 180, "turn": math.tau},
    "time": {"s": 1.0, "ms": 0.001, "us": 1e-6, "min": 60.0},
    "memory": {"byte": 1, "B": 1, "kB": 1e3, "MB": 1e6, "GB": 1e9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30},
    "force": {"N": 1.0, "mN": 1e-3, "g": _GRAVITY / 1000, "kg": _GRAVITY},
    "pressure": {"MPa": 1.0, "kPa": 1e-3},
}
_NOUN: dict[Kind, str] = {
    "length": "a length",
    "angle": "an angle",
    "time": "a time",
    "memory": "an amount of memory",
    "force": "a force",
    "pressure": "a pressure",
}
_ANGLES = ("radian", "degree", "arcminute", "arcsecond", "grade", "turn")
PLAIN = {"", "1", "dimensionless", "share", "count", "counts", "frame", "frames", "pixel", "pixels", "px"}
"""Names of the unit of plain numbers."""
_PER_SECOND = {"Hz": "1/s", "hertz": "1/s"}
_MOST_DECIMALS = 9
_LONGEST = 40  # maximum number of quoted characters of a unit
_SYMBOL = re.compile(r"[^\W\d]+|°")  # pint evaluates arithmetic, so only single names are passed to it


def in_base(symbol: str, kind: Kind) -> float:
    """Return the number of base units in a unit; ValueError if it is unknown or measures another quantity.

    Examples
    --------
    >>> in_base("cm", "length")
    10.0
    """
    known = _COMMON[kind].get(symbol)
    if known is None and len(symbol) > _LONGEST:  # pint would take long
        raise ValueError(f"{symbol[:_LONGEST]}... is not a known unit")
    return _pint_factor(symbol, kind) if known is None else known


def is_common(symbol: str, kind: Kind | None = None) -> bool:
    """Return whether a text is the symbol of a common unit, of some kind or of any."""
    return any(symbol in units for own, units in _COMMON.items() if kind in (None, own))


def conversion_factor(unit: str, wanted: str, where: str) -> float:
    """Return the factor that converts a value in a file to a base unit, or to the inverse of one."""
    if unit == wanted:
        return 1.0
    over, _, base = wanted.rpartition("/")
    given_over, _, symbol = unit.rpartition("/")
    try:
        if given_over != over or len(unit) > _LONGEST:
            raise ValueError(f"{unit} is no {wanted}")
        (kind,) = (kind for kind, name in BASE.items() if name == base)
        factor = in_base(symbol, kind)
    except ValueError as error:
        raise InputError(
            f"{where} is in {unit[:_LONGEST]!r}, which cannot be converted to {wanted}: "
            "correct its attribute units"
        ) from error
    return 1 / factor if over else factor


def ratio(unit: str, other: str) -> float:
    """Return the factor that converts a value from one unit to another.

    Raises
    ------
    InputError
        They do not measure the same quantity, or one of them is unknown.

    Examples
    --------
    >>> ratio("mm", "um"), ratio("count / ms", "1/s")
    (1000.0, 1000.0)
    """
    if unit == other or (unit in PLAIN and other in PLAIN):
        return 1.0
    parts, others = (_PER_SECOND.get(one, one).split("/") for one in (unit, other))
    if len(parts) == len(others) == 2:
        over, under = (ratio(one.strip(), base.strip()) for one, base in zip(parts, others, strict=True))
        return over / under
    for common in _COMMON.values():  # before any unit that needs pint
        if unit in common and other in common:
            return common[unit] / common[other]
    for kind in BASE:
        try:
            if max(len(unit), len(other)) <= _LONGEST:
                return in_base(unit, kind) / in_base(other, kind)
        except ValueError:
            continue
    wanted = repr(other[:_LONGEST]) if other else "a number without a unit"
    raise InputError(f"{unit[:_LONGEST]!r} cannot be converted to {wanted}. Use units of one quantity")


def numbers_with_unit(values: Sequence[float], unit: str) -> tuple[list[str], str]:
    """Return values as texts and their unit, with enough decimals to distinguish them, at least three.

    Lengths in mm below 0.1 mm are in µm, below 0.1 µm in nm.

    Examples
    --------
    >>> numbers_with_unit((-1.95, 0.0), "mm")
    (['-1.950', '0.000'], 'mm')
    >>> numbers_with_unit((-0.0000014, 0.0000032), "mm")
    (['-1.400', '3.200'], 'nm')
    """
    largest = max((abs(value) for value in values), default=0.0)
    if unit == "mm" and 0 < largest < 0.1:
        factor, unit = (1e3, "\u00b5m") if largest >= 1e-4 else (1e6, "nm")
        values = [factor * value for value in values]
    extent = max(values, default=0.0) - min(values, default=0.0)
    digits = 3
    if 0 < extent < math.inf:
        digits = min(max(digits, 2 - math.floor(math.log10(extent))), _MOST_DECIMALS)
    return [f"{value:.{digits}f}" for value in values], unit


def _pint_factor(symbol: str, kind: Kind) -> float:
    import pint  # loading its table of units takes most of a second

    registry = _registry()
    try:
        if not _SYMBOL.fullmatch(symbol):
            raise ValueError(symbol)
        unit = registry.Unit(symbol)
    except (pint.UndefinedUnitError, ValueError) as error:
        raise ValueError(f"{symbol} is not a known unit") from error
    base = registry.Unit(BASE[kind])
    # pint also defines the pixel of style sheets, which is a length.
    same = registry.get_root_units(unit)[1] == registry.get_root_units(base)[1]
    # Angles are dimensionless, but so are decibels, percents and counts.
    other = kind == "angle" and not str(unit).endswith(_ANGLES)
    if not same or other or unit == registry.Unit("css_pixel"):
        raise ValueError(f"{unit}s are not {_NOUN[kind]}")
    return float(registry.convert(1.0, unit, base))


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()
