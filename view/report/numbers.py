"""The table of what was measured."""

from __future__ import annotations

from dataclasses import dataclass

from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError, Result
from mirrorskin.view.report.pictures import Ends

_UNITS = {"mm2": "mm²", "mm3": "mm³", "um": "µm"}
_DIGIT, _POINT = "\N{FIGURE SPACE}", "\N{PUNCTUATION SPACE}"


@dataclass(frozen=True, slots=True)
class Row:
    """A quantity in words; what is not known is empty."""

    name: str
    value: str
    sigma: str
    unit: str


@dataclass(frozen=True, slots=True)
class Numbers:
    """The rows of a table, and what is to be said of them."""

    rows: list[Row]
    notes: list[str]


def numbers_of(result: Result, section: Ends | None) -> Numbers:
    """Measure what makes sense of a result, or say in a note why nothing does."""
    from mirrorskin.engine import measure

    try:
        measures = measure(result, section=section)
    except InputError as error:
        return Numbers([], [sentence(str(error))])
    told = [_told(quantity) for quantity in measures.quantities.values()]
    values, sigmas = (align([one[part] for one in told]) for part in (0, 1))
    units = [_UNITS.get(quantity.unit, quantity.unit) for quantity in measures.quantities.values()]
    rows = [Row(*row) for row in zip(measures.quantities, values, sigmas, units, strict=True)]
    return Numbers(rows, [sentence(note) for note in measures.notes])


def _told(quantity: Quantity) -> tuple[str, str]:
    """Return a value and its uncertainty as they are written, the latter empty where it is not known."""
    number = str(quantity).removesuffix(quantity.unit).strip()
    value, _, sigma = number.replace("-", "\N{MINUS SIGN}").partition(" ± ")
    return value, sigma


def align(numbers: list[str]) -> list[str]:
    """Put spaces as wide as digits behind numbers, so that their points stand below each other."""
    behind = [number.partition(".")[2] for number in numbers]
    longest = max(map(len, behind), default=0)
    return [
        number and number + ("" if "." in number or not longest else _POINT) + _DIGIT * (longest - len(after))
        for number, after in zip(numbers, behind, strict=True)
    ]


def sentence(words: str) -> str:
    """Return words that begin with a capital and end with a stop."""
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."
