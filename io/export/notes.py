"""What a result says of its heights and of how they came about, in lines for files with room for them."""

from __future__ import annotations

import numpy as np

from mirrorskin.io.plain import legible
from mirrorskin.io.types import Result

SOFTWARE, DATE, SOURCE = "software", "date", "source"
_TOLD = {SOURCE: "source", DATE: "date", "turn": "turn"}


def notes_of(result: Result) -> dict[str, str]:
    """Tell where heights come from, from where they count, and how many were not measured.

    Parameters
    ----------
    result : Result
        With heights, (H, W).

    Returns
    -------
    dict of str
        One line each; what nobody knows is missing.
    """
    process = result.process
    maker = " ".join(str(process[name]) for name in ("program", "version") if name in process)
    notes = {name: _line(process[key]) for name, key in _TOLD.items() if key in process}
    if maker:
        notes[SOFTWARE] = _line(maker)
    notes["heights"] = tell_zero(result)
    if result.height is not None and result.filled is not None and result.filled.any():
        known = np.isfinite(result.height)
        filled, of = np.count_nonzero(known & (result.filled > 0)), np.count_nonzero(known)
        notes["filled"] = f"{filled} of {of} heights were not measured but filled"
    return notes


def tell_zero(result: Result) -> str:
    """Say from where heights count: not from the rest sheet where their offset is unknown."""
    unknown = result.offset_unknown
    count, of = (0, 0) if unknown is None else (np.count_nonzero(unknown), unknown.size)
    if not count:
        return "from the sheet at rest"
    return f"relative{'' if count == of else f' in {count} of {of} pieces'}: the mean of a piece is 0"


def _line(value: object) -> str:
    return legible(" ".join(str(value).split()))
