"""A result in one line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result


@dataclass(frozen=True, slots=True)
class Summary:
    """How much of a result was answered.

    Attributes
    ----------
    what : {"height", "normals", "azimuth"}
        What was asked for.
    pixels, answered : int
        All, and those with an answer; in each turn, where each has maps of its own.
    quantity, unit : str
        What ``lowest`` and ``highest`` are of.
    lowest, highest : float
        NaN without an answer.
    in_contact : int or None
        Pixels told to be in contact in every frame, if that was asked.
    turns : int or None
        How many have maps of their own.
    filled : int or None
        Of the pixels with a height, those that were filled, if any were looked for.
    relief : (float, float) or None
        Lowest and highest of the heights that go with normals and are relative, mm.
    """

    what: str
    pixels: int
    answered: int
    quantity: str
    unit: str
    lowest: float
    highest: float
    in_contact: int | None = None
    turns: int | None = None
    filled: int | None = None
    relief: tuple[float, float] | None = None

    def __str__(self) -> str:
        turns = "" if self.turns is None else f" in {self.turns} turns"
        if self.answered == 0:
            return f"no {self.what} at any of {self.pixels} pixels{turns}"
        quantity = "" if self.quantity == self.what else f"{self.quantity} "
        filled = f" ({self.filled} filled)" if self.filled else ""
        parts = [
            f"{self.what} at {self.answered} of {self.pixels} pixels{turns}{filled}",
            f"{quantity}from {self.lowest:.3f} to {self.highest:.3f} {self.unit}",
        ]
        if self.in_contact is not None:
            parts.append(f"in contact at {self.in_contact}")
        if self.relief is not None:
            lowest, highest = self.relief
            parts.append(f"relative height from {lowest:.3f} to {highest:.3f} mm")
        return ", ".join(parts)


def summarise(result: Result) -> Summary:
    """Count the pixels of a result that have an answer, and tell how far the answers reach.

    Of a result without zeniths that has azimuths, the modulation is told. Of one with normals, whose heights
    are all relative, the normals are.
    """
    if result.zenith is not None and (result.height is None or _relative(result)):
        return _summary(result, "normals", result.zenith, "zenith", np.degrees(result.zenith), "deg")
    if result.height is None and result.azimuth is not None and result.modulation is not None:
        return _summary(result, "azimuth", result.azimuth, "modulation", result.modulation, "counts")
    height = np.empty(0, np.float32) if result.height is None else result.height
    return _summary(result, "height", height, "height", height, "mm")


def _summary(
    result: Result,
    what: str,
    answers: NDArray[np.float32],
    quantity: str,
    values: NDArray[np.float32],
    unit: str,
) -> Summary:
    answered = np.isfinite(answers)
    known = values[answered & np.isfinite(values)]
    return Summary(
        what,
        answers.size,
        int(np.count_nonzero(answered)),
        quantity,
        unit,
        lowest=float(np.min(known)) if known.size else np.nan,
        highest=float(np.max(known)) if known.size else np.nan,
        in_contact=None if result.contact is None else int(np.count_nonzero(result.contact)),
        turns=len(answers) if answers.ndim == 3 else None,
        filled=None if result.filled is None else int(np.count_nonzero(result.filled)),
        relief=_relief(result),
    )


def _relative(result: Result) -> bool:
    """Tell whether no absolute height is known."""
    return result.offset_unknown is not None and bool(np.all(result.offset_unknown))


def _relief(result: Result) -> tuple[float, float] | None:
    """Return how far heights reach that are relative, if there are any."""
    if result.height is None or not _relative(result) or not np.isfinite(result.height).any():
        return None
    return float(np.nanmin(result.height)), float(np.nanmax(result.height))
