"""How a field of a part of a calibration is kept in a file: told where the field is, read by the layout.

The last functions return the metadata of a dataclass's field, as in ``field(metadata=number("mm"))``. A field
with a default may be missing from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike

Kind = Literal["array", "number", "integer", "numbers", "integers", "text", "names", "mapping"]
Size = int | str
Check = Callable[[Any], bool]
_STORED = "stored"
_DOUBLE = np.dtype(np.float64)


@dataclass(frozen=True, slots=True)
class Stored:
    """How one field is kept.

    Attributes
    ----------
    kind : str
        "array": a NumPy array; "number", "integer", "text": one; "numbers", "integers": a tuple of them;
        "names": a tuple of texts; "mapping": numbers by names, in a group of their own.
    unit : str or None
        The attribute ``units``; None of values without one, or of several with different ones.
    shape : tuple of int and str
        Of an array or tuple. A letter is a size that the fields of one part share; "rows" and "columns" are
        the camera's.
    dtype : dtype
        Of an array.
    valid : callable or None
        Tells whether a value can be one.
    place : bool
        Whether the first two numbers are a place on the sheet, told from the picture's centre.
    """

    kind: Kind
    unit: str | None = None
    shape: tuple[Size, ...] = ()
    dtype: np.dtype[Any] = _DOUBLE
    valid: Check | None = None
    place: bool = False

    @property
    def is_map(self) -> bool:
        """Whether there is one value a pixel of the camera, which is cut with the picture."""
        return self.shape[:2] == ("rows", "columns")


def stored(part: Any) -> dict[str, Stored]:
    """Return how the fields of a part are kept, by their names; ``part`` is one, or its class."""
    return {one.name: one.metadata[_STORED] for one in fields(part)}


def optional(part: Any) -> set[str]:
    """Name the fields that a file need not have."""
    return {
        one.name for one in fields(part) if one.default is not MISSING or one.default_factory is not MISSING
    }


def unit_of(name: str, how: Mapping[str, Stored]) -> str | None:
    """Return the unit of what is told by a field's name, or by that with ``_x``, ``_y`` or ``_z``."""
    one = how.get(name) or how.get(name.rpartition("_")[0])
    return None if one is None else one.unit


def pixels(dtype: DTypeLike, unit: str | None = None) -> Mapping[str, Stored]:
    """Declare a map: one value a pixel of the camera."""
    return {_STORED: Stored("array", unit, ("rows", "columns"), np.dtype(dtype))}


def array(*shape: Size, unit: str | None = None) -> Mapping[str, Stored]:
    """Declare an array of float64 that has nothing to do with the camera's pixels."""
    return {_STORED: Stored("array", unit, shape)}


def number(unit: str | None = None, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare one float."""
    return {_STORED: Stored("number", unit, valid=valid)}


def integer(valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare one int."""
    return {_STORED: Stored("integer", valid=valid)}


def numbers(count: Size, unit: str | None = None, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a tuple of floats."""
    return {_STORED: Stored("numbers", unit, (count,), valid=valid)}


def place(count: int) -> Mapping[str, Stored]:
    """Declare a tuple of floats, x and y or more, mm from the picture's centre."""
    return {_STORED: Stored("numbers", "mm", (count,), place=True)}


def integers(count: Size, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a tuple of ints."""
    return {_STORED: Stored("integers", None, (count,), valid=valid)}


def text(valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a text."""
    return {_STORED: Stored("text", valid=valid)}


def names(count: Size) -> Mapping[str, Stored]:
    """Declare a tuple of texts."""
    return {_STORED: Stored("names", None, (count,))}


def mapping() -> Mapping[str, Stored]:
    """Declare floats by names; each has the unit that ``unit_of`` tells."""
    return {_STORED: Stored("mapping")}
