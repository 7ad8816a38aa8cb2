"""A result in one line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result
from mirrorskin.io.maps import SlipStatus, is_builtin


@dataclass(frozen=True, slots=True)
class Summary:
    """How much of a result was answered; ``str()`` of it is one line.

    Attributes
    ----------
    what : {"height", "slope", "normals", "azimuth", "slip"}
        The maps that count; or the name of the first of a user's own.
    pixels, answered : int
        All (of slip those in contact), and those with an answer; in each turn, where each has maps of its
        own.
    quantity, unit : str
        What ``lowest`` and ``highest`` are of.
    lowest, highest : float
        NaN without an answer.
    in_contact : int or None
        Pixels in contact in every frame, if that was estimated.
    turns : int or None
        How many have maps of their own.
    filled : int or None
        Of the pixels with a height, those that were filled, if holes were looked for.
    relief : (float, float) or None
        Lowest and highest of the heights that go with normals and are relative, mm.
    slipped : int or None
        Of the pixels that tell of slip, those that slipped.
    stick_ratio : float or None
        Share of the contact that sticks in the last frame for which that is known.
    force_x, force_y : float or None
        Along the sheet, N.
    force, force_sigma : float or None
        Of a press, and the standard deviation that is expected, N.
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
    slipped: int | None = None
    stick_ratio: float | None = None
    force: float | None = None
    force_sigma: float | None = None
    force_x: float | None = None
    force_y: float | None = None

    def __str__(self) -> str:
        turns = "" if self.turns is None else f" in {self.turns} turns"
        if self.slipped is not None:
            return self._slip()
        if self.answered == 0:
            return f"no {self.what} at any of {self.pixels} pixels{turns}"
        quantity = "" if self.quantity == self.what else f"{self.quantity} "
        filled = f" ({self.filled} filled)" if self.filled else ""
        parts = [
            f"{self.what} at {self.answered} of {self.pixels} pixels{turns}{filled}",
            f"{quantity}from {self.lowest:.3f} to {self.highest:.3f} {self.unit}".rstrip(),
        ]
        if self.in_contact is not None:
            parts.append(f"in contact at {self.in_contact}")
        if self.relief is not None:
            parts.append("relative height from {:.3f} to {:.3f} mm".format(*self.relief))
        if self.force is not None and self.force_sigma is not None:
            parts.append(f"force {self.force:.4g} +- {self.force_sigma:.2g} N")
        return ", ".join(parts)

    def _slip(self) -> str:
        parts = [
            f"slip known at {self.answered} of {self.pixels} pixels in contact",
            f"{self.slipped} slipped",
        ]
        if self.slipped:
            parts.append(f"from {self.lowest:.3f} to {self.highest:.3f} {self.unit} of the way")
        if self.stick_ratio is not None:
            parts.append(f"{100 * self.stick_ratio:.1f} % of the contact sticks")
        if self.force_x is not None and self.force_y is not None:
            parts.append(f"force along the sheet {self.force_x:.4g}, {self.force_y:.4g} N")
        return ", ".join(parts)


def summarise(result: Result) -> Summary:
    """Count the pixels of a result that have an answer, and find the range of the answers.

    They are slip; heights; slopes of a body that rocked; normals where there are some and all heights are
    relative; else azimuths, whose modulation is given; else the first map of the user's own.
    """
    if result.slip_onset is not None:
        return _summarise_slip(result)
    height = np.empty(0, np.float32) if result.height is None else result.height
    relative = result.offset_unknown is not None and bool(np.all(result.offset_unknown))
    answers, values, names = height, height, ("height", "height", "mm")
    if result.slope is not None:
        answers, values, names = result.slope, result.slope, ("slope", "slope", "along it")
    elif result.zenith is not None and (result.height is None or relative):
        answers, values, names = result.zenith, np.degrees(result.zenith), ("normals", "zenith", "deg")
    elif result.height is None and result.azimuth is not None and result.modulation is not None:
        answers, values, names = result.azimuth, result.modulation, ("azimuth", "modulation", "counts")
    elif result.height is None and (own := [name for name in result.maps() if not is_builtin(name)]):
        answers = values = result[own[0]]
        names = own[0], own[0], result.declaration(own[0]).unit
    what, quantity, unit = names
    answered = np.isfinite(answers)
    lowest, highest = _range(values if answers is height else values[answered]) or (np.nan, np.nan)
    return Summary(
        what,
        answers.size,
        int(np.count_nonzero(answered)),
        quantity,
        unit,
        lowest,
        highest,
        in_contact=None if result.contact is None else int(np.count_nonzero(result.contact)),
        turns=len(answers) if answers.ndim == 3 else None,
        filled=None if result.filled is None else int(np.count_nonzero(result.filled)),
        relief=_range(height) if relative else None,
        force=result.force,
        force_sigma=result.force_sigma,
    )


def _summarise_slip(result: Result) -> Summary:
    assert result.slip_onset is not None
    status = np.zeros(result.slip_onset.shape, np.uint8) if result.status is None else result.status
    touched = status != SlipStatus.NO_CONTACT if result.contact is None else result.contact != 0
    ratio = np.empty(0) if result.stick_ratio is None else result.stick_ratio[np.isfinite(result.stick_ratio)]
    lowest, highest = _range(result.slip_onset) or (np.nan, np.nan)
    return Summary(
        "slip",
        int(np.count_nonzero(touched)),
        int(np.count_nonzero(touched & np.isin(status, (SlipStatus.SLIPPED, SlipStatus.STICKS)))),
        "slip onset",
        result.declaration("slip_onset").unit,
        lowest,
        highest,
        slipped=int(np.count_nonzero(touched & (status == SlipStatus.SLIPPED))),
        stick_ratio=float(ratio[-1]) if ratio.size else None,
        force_x=result.force_x,
        force_y=result.force_y,
    )


def _range(values: NDArray[np.float32]) -> tuple[float, float] | None:
    """Return the lowest and the highest finite value, if there is any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else None
