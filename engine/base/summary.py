"""Summary of a result in one line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result
from mirrorskin.io.base.units import numbers_with_unit
from mirrorskin.io.model.maps import SIGMA, SlipStatus, is_builtin, is_deviation, place_of, status_of

_STICKS = status_of(SlipStatus).codes[SlipStatus.STICKS]


@dataclass(frozen=True, slots=True)
class Summary:
    """Numbers of pixels of a result with an answer, and their range; ``str()`` is one line.

    Attributes
    ----------
    what : str
        Name of the summarised maps, such as ``"height"`` or ``"normals"``.
    pixels, answered : int
        Number of pixels, and number with an answer; of all turns, if there are maps for each.
    quantity, unit : str
        Map whose range is ``lowest`` to ``highest``, and its unit.
    lowest, highest : float
        NaN without an answer.
    in_contact : int or None
        Pixels in contact in every frame, if that was estimated.
    turns : int or None
        Number of turns, if there are maps for each.
    filled : int or None
        Pixels whose height was filled, if holes were searched for.
    relief : (float, float) or None
        Range of relative heights of a result with normals.
    relief_unit : str
        Unit of these.
    counts : dict of str to int
        Number of pixels of each code of the status, if the status is the main result, as for slip.
    numbers : dict of str to (float, float or None, str)
        Value, standard deviation and unit of each single number, such as a force, and last known value of
        each summarised series.
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
    relief_unit: str = "mm"
    counts: dict[str, int] = field(default_factory=dict)
    numbers: dict[str, tuple[float, float | None, str]] = field(default_factory=dict)

    def __str__(self) -> str:
        return ", ".join(self._parts())

    @property
    def is_empty(self) -> bool:
        """Whether no pixel has an answer; of slip, none is known to stick either."""
        return not self.answered and not self.counts.get(_STICKS)

    def _parts(self) -> Iterator[str]:
        turns = "" if self.turns is None else f" in {self.turns} turns"
        if self.answered:
            filled = f" ({self.filled} filled)" if self.filled else ""
            yield f"{self.what} at {self.answered} of {self.pixels} pixels{turns}{filled}"
            quantity = self.quantity.replace("_", " ")
            quantity = "" if quantity == self.what else f"{quantity} "
            yield f"{quantity}{_from_to(self.lowest, self.highest, self.unit)}"
        else:
            yield f"no {self.what} at any of {self.pixels} pixels{turns}"
        if self.in_contact is not None and self.answered:
            yield f"in contact at {self.in_contact}"
        if self.relief is not None:
            yield f"relative height {_from_to(*self.relief, self.relief_unit)}"
        yield from (f"{count} {name}" for name, count in self.counts.items())
        for name, (value, sigma, unit) in self.numbers.items():
            spread = "" if sigma is None else f" ± {sigma:.2g}"
            yield f"{name.replace('_', ' ')} {value:.4g}{spread} {unit}".rstrip()

    def as_dict(self) -> dict[str, Any]:
        """Return everything by name, for JSON; counts and numbers are entries of their own.

        ``lowest`` and ``highest`` are rounded to nine digits, which distinguish all values of float32.
        """
        facts = asdict(self)
        del facts["relief_unit"]
        facts |= {name: float(f"{facts[name]:.9g}") for name in ("lowest", "highest")}
        facts |= {name.replace(" ", "_"): count for name, count in facts.pop("counts").items()}
        for name, (value, sigma, _) in facts.pop("numbers").items():
            facts[name] = value
            facts |= {} if sigma is None else {f"{name}{SIGMA}": sigma}
        return facts


def status_shares(result: Result) -> str:
    """Return the meaning of each code of the status of a result, and its share of the pixels; "" without.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> frames = np.zeros((4, 1, 2), np.uint8)
    >>> frames[2:, 0, 0] = 255
    >>> status_shares(engine.find_onset(frames, [0.0, 0.1, 0.2, 0.3], dark=0, bright=255))
    'onset at 50 %, never light at 50 %'
    """
    status = result.get("status")
    if status is None or not np.size(status):
        return ""
    codes = result.declaration("status").codes
    shares = {text: 100 * float(np.mean(np.asarray(status) == code)) for code, text in codes.items()}
    return ", ".join(f"{text} at {percent:.3g} %" for text, percent in shares.items() if percent)


def _from_to(lowest: float, highest: float, unit: str) -> str:
    (low, high), unit = numbers_with_unit((lowest, highest), unit)
    return f"from {low} to {high} {unit}".rstrip()


def summarise(result: Result) -> Summary:
    """Count the pixels of a result that have an answer, and find the range of the answers.

    The first map whose declaration has a text for the summary is used; heights that are all relative come
    last. Without such a map, the first one that is not built-in is used, or the first of all.
    """
    relative = result.offset_unknown is not None and bool(np.all(result.offset_unknown))
    name, what = _leading(result, relative)
    if name is None:
        return Summary("answer", 0, 0, "", "", np.nan, np.nan)
    declared, values = result.declaration(name), result[name]
    answered = declared.has_answer(values)
    size = np.linalg.norm(values, axis=-1) if declared.components else values
    lowest, highest = _range(size[answered], declared.figure_scale) or (np.nan, np.nan)
    return Summary(
        what,
        answered.size,
        int(np.count_nonzero(answered)),
        name,
        declared.figure_unit,
        lowest,
        highest,
        in_contact=None if result.contact is None else int(np.count_nonzero(result.contact)),
        turns=len(answered) if answered.ndim == 3 and not declared.per_frame else None,
        filled=None if result.filled is None else int(np.count_nonzero(result.filled)),
        relief=None if result.height is None or not relative else _range(result.height),
        relief_unit=result.declaration("height").unit,
        counts=dict(_counts(result)),
        numbers=dict(_numbers(result)),
    )


def _leading(result: Result, relative: bool) -> tuple[str | None, str]:
    """Return the name of the summarised map, and the name of its pixels with a value."""
    maps = {name: result.declaration(name) for name in result.maps()}
    heights = result.name_of("height") if relative else None
    called = {
        name: declared.summary or (name if declared.quantity else "") for name, declared in maps.items()
    }
    order = sorted(maps, key=lambda name: (name == heights, place_of(maps[name].quantity or name)))
    for name in order:
        if called[name]:
            return name, called[name]
    custom = [name for name in maps if not is_builtin(name)] or [*maps]
    return (custom[0], custom[0].replace("_", " ")) if custom else (None, "")


def _counts(result: Result) -> Iterator[tuple[str, int]]:
    """Yield the number of pixels of each code, for maps whose codes are counted."""
    for name, values in result.maps().items():
        declared = result.declaration(name)
        for code, text in declared.codes.items() if declared.counted else ():
            count = int(np.count_nonzero(values == code))
            if count and code != declared.undefined:
                yield text, count


def _numbers(result: Result) -> Iterator[tuple[str, tuple[float, float | None, str]]]:
    numbers = result.numbers()
    for name, values in result.series().items():
        finite = values[np.isfinite(values)]
        if result.declaration(name).summary and finite.size:
            yield name, (float(finite[-1]), None, result.declaration(name).unit)
    for name, value in numbers.items():
        if not is_deviation(name):
            yield name, (value, numbers.get(f"{name}{SIGMA}"), result.declaration(name).unit)


def _range(values: NDArray[Any], scale: float = 1.0) -> tuple[float, float] | None:
    """Return the lowest and the highest finite value, if there is any."""
    finite = values[np.isfinite(values)]
    return (scale * float(finite.min()), scale * float(finite.max())) if finite.size else None
