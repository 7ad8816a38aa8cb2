"""Quantities on the command line: a number and a unit, such as ``0.1mm``.

Each function receives the text and the name of its option, and raises `mirrorskin.io.InputError` with an
example of a correct value.
"""

from __future__ import annotations

import math
import re

from mirrorskin.io import InputError, Region
from mirrorskin.io.base.text import shortened
from mirrorskin.io.base.units import NUMBER, Kind, in_base

_LETTERS = "A-Za-z\u00b5\u03bc\u00c5\u212b\u00e5\u00f6"  # those of µm and of ångström, too
_UNIT = rf"[{_LETTERS}]+(?:[-_][A-Za-z]+)*|[°'\"\u2032\u2033]"
_EXAMPLES: dict[Kind, str] = {
    "length": "0.1mm",
    "angle": "2.5deg",
    "time": "10ms",
    "memory": "512MB",
    "force": "1.5N",
    "pressure": "0.1MPa",
}
_PER_ANGLE = "5.7/deg"
_DECIMAL_COMMA = re.compile(
    rf"\s*([+-]?[0-9]+),([0-9]+(?:[eE][+-]?[0-9]+)?)\s*((?:{_UNIT})?(?:/(?:{_UNIT}))?)\s*"
)


def length(text: str, option: str = "") -> float:
    """Return a length, as in ``0.1mm``, in millimetres; of either sign."""
    return read_quantity(text, option, "length")


def lengths(text: str, option: str = "") -> tuple[float, float]:
    """Return lengths along x and y, as in ``0.03mm,0.04mm``, or one for both, in millimetres."""
    refuse_decimal_comma(text, option, several=True)
    values = [length(part, option) for part in text.split(",")]
    if len(values) > 2:
        raise _error(text, option, "one or two lengths are needed", "0.03mm,0.04mm")
    return values[0], values[-1]


def vector(text: str, count: int, option: str = "") -> tuple[float, ...]:
    """Return ``count`` lengths, as in ``0mm,0mm,40mm``, in millimetres."""
    refuse_decimal_comma(text, option, several=True)
    values = tuple(length(part, option) for part in text.split(","))
    if len(values) != count:
        raise _error(text, option, f"{count} lengths are needed", ",".join(["0mm"] * (count - 1) + ["1mm"]))
    return values


def segment(text: str, option: str = "") -> tuple[tuple[float, float], tuple[float, float]]:
    """Return two different points, as in ``-2mm,0mm:2mm,1mm``: x and y of each, in millimetres."""
    ends = tuple(vector(part, 2, option) for part in text.split(":"))
    if len(ends) != 2 or ends[0] == ends[1]:
        raise _error(text, option, "two points are needed", "-2mm,0mm:2mm,0mm")
    return (ends[0][0], ends[0][1]), (ends[1][0], ends[1][1])


def compliance(text: str, option: str = "") -> float:
    """Return a compliance, as in ``0.01mm/N``, in mm/N."""
    distance, slash, newton = text.strip().rpartition("/")
    if not slash or newton.strip() != "N":
        raise _error(text, option, "a length for each newton is needed", "0.01mm/N")
    return length(distance, option)


def force(text: str, option: str = "") -> float:
    """Return a force above 0, as in ``1.5N``, or a weight, as in ``150g``, in newtons."""
    return _above_zero(read_quantity(text, option, "force"), text, option, "force")


def pressure(text: str, option: str = "") -> float:
    """Return a pressure or a modulus above 0, as in ``0.1MPa``, in N/mm^2."""
    return _above_zero(read_quantity(text, option, "pressure"), text, option, "pressure")


def _above_zero(value: float, text: str, option: str, kind: Kind) -> float:
    if value <= 0:
        raise _error(text, option, f"a {kind} above 0 is needed", _EXAMPLES[kind])
    return value


def number(text: str, option: str = "") -> float:
    """Return a plain number, as in ``0.25``."""
    try:
        return float(text)
    except ValueError:
        refuse_decimal_comma(text, option)
        raise _error(text, option, "a number is needed", "0.25") from None


def integer(text: str, option: str = "") -> int:
    """Return a whole number, as in ``2``."""
    try:
        return int(text)
    except ValueError:
        raise _error(text, option, "a whole number is needed", "2") from None


def duration(text: str, option: str = "") -> float:
    """Return a time, as in ``10ms``, in seconds."""
    return read_quantity(text, option, "time")


def angle(text: str, option: str = "") -> float:
    """Return an angle, as in ``2.5deg``, in radians."""
    return read_quantity(text, option, "angle")


def per_angle(text: str, option: str = "") -> float:
    """Return a number per unit of angle, as in ``5.7/deg``, per radian."""
    match = re.fullmatch(rf"\s*({NUMBER})\s*/\s*({_UNIT})\s*", text)
    if match is None:
        refuse_decimal_comma(text, option)
        raise _error(text, option, "a number over a unit of angle is needed", _PER_ANGLE)
    return _scaled(float(match[1]), match[2], "angle", text, option, _PER_ANGLE, per_unit=True)


def memory(text: str, option: str = "") -> int:
    """Return an amount of memory, as in ``512MB`` (10^6) or ``512MiB`` (2^20), in bytes, at least one."""
    size = round(read_quantity(text, option, "memory"))
    if size < 1:
        raise _error(text, option, "at least one byte is needed", _EXAMPLES["memory"])
    return size


def frame_size(text: str, option: str = "") -> tuple[int, int]:
    """Return columns and rows of a picture, as in ``640x480``."""
    match = re.fullmatch("([1-9][0-9]{0,8})x([1-9][0-9]{0,8})", text.strip())
    if match is None:
        raise _error(text, option, "pixels across and down are needed", "640x480")
    return int(match[1]), int(match[2])


def region(text: str, option: str = "") -> Region:
    """Return a rectangle of the picture, as in ``100,50,640x480``: first column and row, columns and rows."""
    parsed = Region.read("".join(text.split()))
    if parsed is None:
        needed = "the first column and row, and how many of each, are needed"
        raise _error(text, option, needed, "100,50,640x480")
    return parsed


def frame_range(text: str, option: str = "") -> tuple[int, int | None]:
    """Return a range of frames, as in ``10:200``: the first and the one after the last, None for the end."""
    match = re.fullmatch(r"([0-9]{0,9}):([0-9]{0,9})", "".join(text.split()))
    start, stop = (int(bound) if bound else None for bound in match.groups()) if match else (None, 0)
    if stop is not None and stop <= (start or 0):
        needed = "the first frame, from 0, and a later one that is left out are needed"
        raise _error(text, option, needed, "10:200, or 10: for all from 10 on")
    return start or 0, stop


def read_quantity(text: str, option: str, kind: Kind) -> float:
    """Return a number with a unit of some kind, in the base unit of that kind."""
    match = re.fullmatch(rf"\s*({NUMBER})\s*({_UNIT})?\s*", text)
    if match is None:
        refuse_decimal_comma(text, option)
        raise _error(text, option, "a number and a unit are needed", _EXAMPLES[kind])
    if match[2] is None:
        raise _error(text, option, "a unit is needed", _EXAMPLES[kind])
    return _scaled(float(match[1]), match[2], kind, text, option, _EXAMPLES[kind])


def _scaled(
    number: float, unit: str, kind: Kind, text: str, option: str, example: str, per_unit: bool = False
) -> float:
    try:
        factor = in_base(unit, kind)
    except ValueError as error:
        raise _error(text, option, shortened(str(error), 100), example) from None
    value = number / factor if per_unit else number * factor
    if not math.isfinite(value):
        raise _error(text, option, "the number is too large", example)
    return value


def decimal_comma(text: str) -> str:
    """Return a number with a decimal comma in a form with a point; "" for any other text.

    Examples
    --------
    >>> decimal_comma("0,05mm"), decimal_comma("0.05mm,0.04mm")
    ('0.05mm', '')
    """
    match = _DECIMAL_COMMA.fullmatch(text)
    return f"{match[1]}.{match[2]}{match[3]}" if match else ""


def refuse_decimal_comma(text: str, option: str, several: bool = False) -> None:
    """Raise InputError for a decimal comma: 0,05mm or, of ``several`` quantities, 0,3mm,0,4mm."""
    for part in text.split(":") if several else [text]:
        numbers = part.split(",")
        pairs = [",".join(numbers[first : first + 2]) for first in range(0, len(numbers), 2)]
        corrected = next(filter(None, map(decimal_comma, pairs if several else [part])), "")
        if corrected and not (several and corrected[-1].isdigit()):
            written = " ".join(f"{option} {shortened(text)}".split())
            raise InputError(f"{written}: write the number with a decimal point, {corrected}")


def _error(text: str, option: str, wrong: str, example: str) -> InputError:
    written = " ".join(f"{option} {shortened(text)}".split())
    return InputError(f"{written}: {wrong}; write e.g. {example}")
