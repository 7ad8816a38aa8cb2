"""A part of a calibration in words, field by field."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mirrorskin.io.calibration.fields import Stored, stored, unit_of
from mirrorskin.io.calibration.types import BITS, Part

_FEW = 16


def words_of(part: Part) -> dict[str, str]:
    """Return what each field of a part says: numbers with units, angles in degrees, maps by their median."""
    how = stored(part)
    return {name: said for name, one in how.items() for said in _words(getattr(part, name), one, how)}


def _words(value: Any, how: Stored, others: dict[str, Stored]) -> Iterator[str]:
    """Yield the words for a value, or none."""
    if value is None:
        return
    if how.kind in ("text", "integer"):
        yield str(value)
    elif how.kind == "names":
        yield ", ".join(value)
    elif how.kind == "mapping":
        if value:
            yield ", ".join(f"{name} {_number(one, unit_of(name, others))}" for name, one in value.items())
    elif how.is_map:
        yield _map(value, how.unit)
    elif np.size(value) <= _FEW:
        yield _number(value, how.unit)
    else:
        yield f"{' x '.join(map(str, np.shape(value)))} numbers"


def _map(values: Any, unit: str | None) -> str:
    if unit is None:  # flags
        counts = {name: np.count_nonzero(values & bit) for name, bit in BITS.items()}
        return ", ".join(f"{count} {name}" for name, count in counts.items())
    known = values[np.isfinite(values)]
    lacking = values.size - known.size
    return (_number(np.median(known), unit) if known.size else "no pixel known") + (
        f" (median; {lacking} pixels unknown)" if lacking else " (median)"
    )


def _number(value: Any, unit: str | None) -> str:
    if unit == "rad":
        value, unit = np.degrees(value), "deg"
    told = ", ".join(f"{one:.5g}" for one in np.ravel(value))
    return f"{told} {unit}" if unit else told
