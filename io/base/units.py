"""Conversion of units: a table of those that laboratories and the files of other programs use.

Symbols take the symbols of prefixes (``mN``, ``MN``, ``um`` as ``µm``). Names take their names, in the
singular and the plural (``millinewton``, ``micrometres``). Case distinguishes units, as in the SI.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from mirrorskin.io.base.types import InputError

Kind = Literal["length", "angle", "time", "memory", "force", "pressure"]

NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""Pattern of a number with a decimal point."""

BASE: dict[Kind, str] = {
    "length": "mm",
    "angle": "rad",
    "time": "s",
    "memory": "byte",
    "force": "N",
    "pressure": "N/mm^2",
}
"""The base unit of each kind of quantity."""


class Unit(NamedTuple):
    """A unit in the table: number of base units, and its plural; "" if it only has symbols."""

    factor: float
    plural: str


class _Row(NamedTuple):
    """Spellings of a unit, separated by blanks, and prefixes: symbol, name, base and exponent."""

    factor: float
    symbols: str
    names: str = ""
    prefixes: tuple[tuple[str, str, int, int], ...] = ()


_LARGE = (
    ("k", "kilo", 10, 3),
    ("M", "mega", 10, 6),
    ("G", "giga", 10, 9),
    ("T", "tera", 10, 12),
    ("P", "peta", 10, 15),
    ("E", "exa", 10, 18),
)
_SI = (
    ("a", "atto", 10, -18),
    ("f", "femto", 10, -15),
    ("p", "pico", 10, -12),
    ("n", "nano", 10, -9),
    ("u", "micro", 10, -6),
    ("\u00b5", "micro", 10, -6),
    ("\u03bc", "micro", 10, -6),
    ("m", "milli", 10, -3),
    ("c", "centi", 10, -2),
    ("d", "deci", 10, -1),
    ("da", "deca", 10, 1),
    ("da", "deka", 10, 1),
    ("h", "hecto", 10, 2),
    *_LARGE,
)
_SIZES = (
    *_LARGE,
    ("Ki", "kibi", 2, 10),
    ("Mi", "mebi", 2, 20),
    ("Gi", "gibi", 2, 30),
    ("Ti", "tebi", 2, 40),
    ("Pi", "pebi", 2, 50),
    ("Ei", "exbi", 2, 60),
)

_GRAVITY = 9.80665  # m/s^2, converts a mass to its weight
_POUND, _OUNCE = 0.45359237, 0.028349523125  # kg
_PER_AREA = "N/{0}^2 N/{0}**2 N/{0}2 N/{0}\u00b2"  # pint writes blanks, which `_spelling` removes

_ROWS: dict[Kind, tuple[_Row, ...]] = {
    "length": (
        _Row(1e3, "m", "meter metre", _SI),
        _Row(1e-3, "\u00b5 \u03bc", "micron"),
        _Row(1e-7, "\u00c5 \u212b", "angstrom Angstrom \u00e5ngstr\u00f6m"),
        _Row(25.4, 'in " \u2033', "inch"),
        _Row(25.4e-6, "uin \u00b5in \u03bcin", "microinch"),
        _Row(25.4e-3, "th", "mil thou"),
        _Row(304.8, "ft", "foot"),
        _Row(914.4, "yd", "yard"),
        _Row(1609344.0, "mi", "mile"),
    ),
    "angle": (
        _Row(1.0, "rad", "radian", _SI),
        _Row(math.pi / 180, "deg °", "degree deg arcdegree arcdeg", _SI),
        _Row(math.pi / 10800, "' \u2032", "arcminute arcmin arc_minute"),
        _Row(math.pi / 648000, '" \u2033'),
        _Row(math.pi / 648000, "arcsec", "arcsecond arcsec arc_second", _SI),
        _Row(math.pi / 648000e3, "mas"),
        _Row(math.pi / 200, "gon grad", "gon gradian grade grad", _SI),
        _Row(math.tau, "", "turn revolution rev cycle circle"),
    ),
    "time": (
        _Row(1.0, "s sec", "second sec", _SI),
        _Row(60.0, "", "minute min"),
        _Row(3600.0, "h", "hour hr"),
        _Row(86400.0, "d", "day"),
        _Row(604800.0, "", "week"),
    ),
    "memory": (
        _Row(1.0, "B byte", "byte octet", _SIZES),
        _Row(0.125, "bit", "bit", _SIZES),
    ),
    "force": (
        _Row(1.0, "N", "newton", _SI),
        _Row(1e-5, "dyn", "dyne", _SI),
        _Row(_GRAVITY / 1e3, "gf", "gram-force gram_force pond", _SI),
        _Row(_GRAVITY, "kp"),
        _Row(_GRAVITY * _POUND, "lbf", "pound-force pound_force"),
        _Row(_GRAVITY * _OUNCE, "ozf", "ounce-force ounce_force"),
        _Row(_GRAVITY / 1e3, "g", "gram gramme", _SI),
        _Row(_GRAVITY * _POUND, "", "pound lb"),
        _Row(_GRAVITY * _OUNCE, "oz", "ounce"),
    ),
    "pressure": (
        _Row(1e-6, "Pa", "pascal", _SI),
        _Row(1.0, _PER_AREA.format("mm")),
        _Row(1e-2, _PER_AREA.format("cm")),
        _Row(1e-6, _PER_AREA.format("m")),
        _Row(0.1, "bar", "bar", _SI),
        _Row(_GRAVITY * _POUND / 25.4**2, "psi"),
        _Row(_GRAVITY * _POUND / 25.4**2 * 1e3, "ksi kpsi"),
        _Row(0.101325, "atm", "atmosphere"),
        _Row(_GRAVITY / 100, "at"),
        _Row(0.101325 / 760, "torr Torr", "torr", _SI),
        _Row(133.322387415e-6, "mmHg"),
        _Row(25.4 * 133.322387415e-6, "inHg"),
    ),
}
_PLURALS = {"inch": "inches", "microinch": "microinches", "foot": "feet", "thou": "thou", "torr": "torr"}
_HEADINGS: dict[Kind, str] = {
    "length": "um \u00b5m \u03bcm mm cm m in",
    "angle": "rad mrad deg ° turn",
    "time": "us ms s min",
    "memory": "byte B kB MB GB KiB MiB GiB",
    "force": "mN N g kg",
    "pressure": "kPa MPa",
}
_EXAMPLES: dict[Kind, str] = {
    "length": "um, mm, cm, m, in, mil, ...",
    "angle": "rad, mrad, deg, arcmin, gon, turn, ...",
    "time": "us, ms, s, min, h, ...",
    "memory": "byte, kB, MB, GB, KiB, MiB, GiB, ...",
    "force": "mN, N, gf, kgf, lbf, g, kg, ...",
    "pressure": "Pa, kPa, MPa, bar, psi, ...",
}
_NOUN: dict[Kind, str] = {
    "length": "a length",
    "angle": "an angle",
    "time": "a time",
    "memory": "an amount of memory",
    "force": "a force",
    "pressure": "a pressure",
}
PLAIN = {"", "1", "dimensionless", "share", "count", "counts", "frame", "frames", "pixel", "pixels", "px"}
"""Names of the unit of plain numbers."""
_PER_SECOND = {"mHz": "1/ks", "Hz": "1/s", "hertz": "1/s", "kHz": "1/ms", "MHz": "1/us", "GHz": "1/ns"}
_OTHER_PLURALS = {"px": "pixels", "pixel": "pixels", "pixels": "pixels", "Hz": "hertz", "hertz": "hertz"}
_MOST_DECIMALS = 9
_QUOTED_MAX = 40  # maximum number of quoted characters of a unit


@functools.cache
def units_of(kind: Kind) -> Mapping[str, Unit]:
    """Return all units of a kind of quantity, by each of their spellings.

    Examples
    --------
    >>> units_of("force")["millinewtons"]
    Unit(factor=0.001, plural='millinewtons')
    """
    units: dict[str, Unit] = {}
    for factor, symbols, names, prefixes in _ROWS[kind]:
        for short, long, base, power in (("", "", 10, 0), *prefixes):
            scaled = factor * base**power if power > 0 else factor / base**-power  # 1e-9 is not exact, 1e9 is
            unit = Unit(scaled, long + _plural(names.split()[0]) if names else "")
            units |= {short + symbol: unit for symbol in symbols.split()}
            for name in names.split():
                units |= {long + spelling: unit for spelling in (name, _plural(name))}
    return units


def _plural(name: str) -> str:
    return _PLURALS.get(name) or re.sub(r"(?=[-_]force)|$", "s", name, count=1)


def in_base(symbol: str, kind: Kind) -> float:
    """Return the number of base units in a unit; ValueError if it is unknown or measures another quantity.

    Examples
    --------
    >>> in_base("cm", "length"), in_base("micrometres", "length")
    (10.0, 0.001)
    """
    unit = units_of(kind).get(_spelling(symbol))
    if unit is None:
        raise ValueError(_refusal(_spelling(symbol), kind))
    return unit.factor


def _spelling(symbol: str) -> str:
    """Return the spelling of a unit in the table: pint and astropy write a quotient with blanks."""
    return symbol.replace(" ", "") if "/" in symbol else symbol


def _refusal(symbol: str, kind: Kind) -> str:
    unit = next((units[symbol] for units in map(units_of, BASE) if symbol in units), None)
    plural = unit.plural if unit else _OTHER_PLURALS.get(symbol)
    if plural:
        return f"{plural} are not {_NOUN[kind]}"
    if unit:
        return f"{symbol} is not {_NOUN[kind]}"
    end = "..." if len(symbol) > _QUOTED_MAX else ""
    return f"{symbol[:_QUOTED_MAX]}{end} is not a known unit ({_EXAMPLES[kind]})"


def is_common(symbol: str, kind: Kind | None = None) -> bool:
    """Return whether a text is the symbol of a common unit, of some kind or of any."""
    return any(symbol in units.split() for quantity, units in _HEADINGS.items() if kind in (None, quantity))


def conversion_factor(unit: str, target: str, where: str) -> float:
    """Return the factor that converts a value in a file from its unit to another."""
    try:
        return ratio(unit, target)
    except InputError as error:
        raise InputError(
            f"{where} is in {unit[:_QUOTED_MAX]!r}, which cannot be converted to {target}: "
            "correct its attribute units"
        ) from error


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
    for kind in BASE:
        units = units_of(kind)
        factors, base = units.get(_spelling(unit)), units.get(_spelling(other))
        if factors and base:
            return factors.factor / base.factor
    parts, others = (_PER_SECOND.get(symbol, symbol).split("/") for symbol in (unit, other))
    if len(parts) == len(others) == 2:
        over, under = (ratio(part.strip(), base.strip()) for part, base in zip(parts, others, strict=True))
        return over / under
    needed = repr(other[:_QUOTED_MAX]) if other else "a number without a unit"
    raise InputError(f"{unit[:_QUOTED_MAX]!r} cannot be converted to {needed}. Use units of one quantity")


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
