"""Measures of many results in a table, compared with limits."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.base.inputs import Maps
from mirrorskin.engine.metrology.measures import Measures, measure
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError
from mirrorskin.io.base.types import PIXEL
from mirrorskin.io.base.units import NUMBER, ratio
from mirrorskin.io.formats.tables import save_table
from mirrorskin.kernels.array_types import Doubles

_COVERAGE = 2  # standard uncertainties of the guard band (ISO 14253-1)
_LEAST_TREND, _CLEAR_TREND = 12, 4.5  # results, and standard deviations of a slope, from which it is a trend
_BOUND = re.compile(rf"\s*(?:({NUMBER})\s*([^\s0-9:][^\s:]*)?)?\s*")
_PLAIN = {"²": "2", "³": "3", "°": "deg", "^": ""}


class Verdict(StrEnum):
    """Whether a quantity is within its limits, by ISO 14253-1, with the expanded uncertainty (k = 2)."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNDECIDED = "undecided"
    MISSING = "missing"


@dataclass(frozen=True, slots=True)
class Limit:
    """The lowest and the highest allowed value of a quantity.

    Attributes
    ----------
    low, high : float or None
    unit : str
        Unit of both; by default that of the quantity.
    """

    low: float | None = None
    high: float | None = None
    unit: str = ""

    @classmethod
    def read(cls, text: str, name: str = "") -> Limit:
        """Return the limit written as ``LOW:HIGH`` with units, either of which may be missing.

        Examples
        --------
        >>> Limit.read("4.9mm:5.1mm")
        Limit(low=4.9, high=5.1, unit='mm')
        >>> Limit.read(":2um").high
        2.0
        """
        bounds = [_BOUND.fullmatch(part) for part in text.split(":")]
        found = [match for match in bounds if match is not None]
        numbers = [None if match[1] is None else float(match[1]) for match in found]
        units = {match[2] or "" for match in found if match[1] is not None}
        if len(bounds) != 2 or len(found) != 2 or len(units) != 1:
            where = f"limits of {name}, {text!r}" if name else f"limits {text!r}"
            raise InputError(
                f"{where}: a lowest and a highest value in one unit are needed, as in 4.9mm:5.1mm"
            )
        if None not in numbers and numbers[0] > numbers[1]:  # type: ignore[operator]
            raise InputError(f"limits {text!r}: the lowest value is above the highest one")
        return cls(numbers[0], numbers[1], units.pop())

    def within(self, name: str, unit: str) -> tuple[float, float]:
        """Return both limits in the unit of the quantity, infinite where there is none."""
        factor = _factor(name, self.unit, unit)
        low = -math.inf if self.low is None else factor * self.low
        return low, math.inf if self.high is None else factor * self.high

    def judge(self, name: str, quantity: Quantity | None) -> Verdict:
        """Compare a quantity with the limits; without an uncertainty, its value alone."""
        if quantity is None or not math.isfinite(quantity.value):
            return Verdict.MISSING
        low, high = self.within(name, quantity.unit)
        guard = _COVERAGE * quantity.sigma if math.isfinite(quantity.sigma) else 0.0
        margin = min(quantity.value - low, high - quantity.value)
        if margin >= guard:
            return Verdict.INSIDE
        return Verdict.OUTSIDE if margin < -guard or guard == 0 else Verdict.UNDECIDED


def _factor(name: str, unit: str, own: str) -> float:
    """Return by what to multiply a value in a unit for one in a quantity's own unit."""
    plain, wanted = ("".join(_PLAIN.get(letter, letter) for letter in text) for text in (unit, own))
    if not plain or plain == wanted:
        return 1.0
    if own:
        with suppress(InputError):
            return ratio(unit, own)
    raise InputError(f"limits of {name} are in {unit}: {f'give {own}' if own else 'it has no unit'}")


@dataclass(frozen=True, slots=True)
class Trend:
    """A clear change of a quantity from result to result.

    Attributes
    ----------
    step : Quantity
        Change from one result to the next.
    results : int
        Number of results that have the quantity.
    line : ndarray, (rows,)
        The quantity by the trend, for each row.
    """

    step: Quantity
    results: int
    line: Doubles

    def __str__(self) -> str:
        verb, step = ("falls" if self.step.value < 0 else "rises"), self.step
        total = abs(step.value) * (len(self.line) - 1)
        size = replace(step, value=abs(step.value))
        return f"{verb} by {size} from result to result, {total:.2g} {step.unit} in all {len(self.line)}"


def find_trend(values: Doubles, unit: str) -> Trend | None:
    """Return the trend of values, (rows,), NaN where unknown; None if none is clear. See `Table.trend`."""
    number, known = np.arange(float(values.size)), np.isfinite(values)
    if np.count_nonzero(known) < _LEAST_TREND:
        return None
    x, y = number[known], values[known]
    away = x - np.mean(x)
    slope = float(away @ y / (away @ away))
    line = np.mean(y) + slope * (number - np.mean(x))
    left = y - line[known]
    square = float(left @ left)
    alike = max(0.0, float(left[1:] @ left[:-1])) / square if square else 0.0
    sigma = math.sqrt(square / (len(x) - 2) / float(away @ away) * (1 + alike) / (1 - alike))
    return Trend(Quantity(slope, sigma, unit), len(x), line) if abs(slope) > _CLEAR_TREND * sigma else None


@dataclass(frozen=True, slots=True)
class Row:
    """The measures of one result, or why there are none."""

    name: str
    measures: Measures | None
    problem: str = ""

    def quantity(self, name: str) -> Quantity | None:
        """Return a quantity; None if it was not measured."""
        return None if self.measures is None else self.measures.quantities.get(name)


@dataclass(frozen=True, slots=True)
class Table:
    """Measures of many results, one in a row.

    Attributes
    ----------
    rows : sequence of Row
    limits : dict of str to Limit
        Of quantities, by name.
    """

    rows: Sequence[Row]
    limits: Mapping[str, Limit] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of all quantities that any result has, in reading order."""
        names: list[str] = []
        for row in self.rows:
            after = 0
            for name in () if row.measures is None else row.measures.quantities:
                if name not in names:
                    names.insert(after, name)
                after = names.index(name) + 1
        return names

    def main(self, count: int = 5) -> list[str]:
        """Return names of the quantities that have limits, or of those that matter most."""
        if self.limits:
            return list(self.limits)
        wanted = {name for row in self.rows if row.measures for name in row.measures.main(count)}
        return [name for name in self.names if name in wanted][:count]

    def unit(self, name: str) -> str:
        """Return the unit of a quantity; of one that no result has, that of its limits."""
        stated = self.limits[name].unit if name in self.limits else ""
        return next((quantity.unit for row in self.rows if (quantity := row.quantity(name))), stated)

    def values(self, name: str) -> tuple[Doubles, Doubles]:
        """Return values and standard uncertainties of a quantity, (rows,); NaN where unknown."""
        quantities = [row.quantity(name) for row in self.rows]
        unknown = Quantity(math.nan, math.nan, "")
        pairs = [((quantity or unknown).value, (quantity or unknown).sigma) for quantity in quantities]
        values, sigmas = np.array(pairs).reshape(-1, 2).T
        return values, sigmas

    def trend(self, name: str) -> Trend | None:
        """Return the trend of a quantity over the results in their order; None if none is clear.

        It is a straight line by least squares. The scatter of the values determines whether it is clear:
        errors that all results have in common, such as those of the calibration, do not change it. Where
        neighbours scatter alike, as of the same object several times in a row, they count for less.

        Examples
        --------
        >>> values = 0.0, 1.1, 1.9, 3.0, 4.2, 4.9, 6.0, 7.1, 8.0, 9.0, 10.1, 10.9
        >>> lot = [Row("", Measures({"Sq": Quantity(value, 0.1, "um")}, [])) for value in values]
        >>> print(Table(lot).trend("Sq"))
        rises by 0.9979 ± 0.0082 um from result to result, 11 um in all 12
        """
        return find_trend(self.values(name)[0], self.unit(name))

    def verdict(self, row: Row) -> Verdict:
        """Return the worst verdict on the quantities of a row that have limits."""
        verdicts = {limit.judge(name, row.quantity(name)) for name, limit in self.limits.items()}
        worst = Verdict.OUTSIDE, Verdict.MISSING, Verdict.UNDECIDED
        return next((verdict for verdict in worst if verdict in verdicts), Verdict.INSIDE)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as comma-separated values: units in the heading, standard uncertainties as u(...).

        After the name of the result come the verdict, if there are limits, and all quantities; last, the
        notes.
        """
        columns: dict[str, Sequence[Any] | Doubles] = {"result": [row.name for row in self.rows]}
        units: dict[str, str] = {}
        if self.limits:
            columns["limits"] = [str(self.verdict(row)) for row in self.rows]
        for name in self.names:
            unit = self.unit(name)
            for column, values in zip((name, f"u({name})"), self.values(name), strict=True):
                columns[column], units[column] = values, unit
        columns["remarks"] = [
            row.problem or "; ".join(row.measures.notes if row.measures else []) for row in self.rows
        ]
        notes = {"uncertainties": "u(...) are standard uncertainties (k = 1); an empty cell is unknown"}
        for name, limit in self.limits.items():
            low, high = limit.within(name, self.unit(name))
            bounds = [f"at least {low:g}"] * math.isfinite(low) + [f"at most {high:g}"] * math.isfinite(high)
            notes[f"limits of {name}"] = f"{' and '.join(bounds)} {self.unit(name)}".rstrip()
        save_table(Path(path), columns, units, notes)

    def _repr_html_(self) -> str:
        """Draw the main quantities for a notebook."""
        from html import escape

        names = self.main(10)
        head = "".join(f"<th>{escape(name)}</th>" for name in ("result", *names))
        rows = [
            [row.name, *(str(row.quantity(name) or row.problem or "unknown") for name in names)]
            for row in self.rows
        ]
        body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        return f"<table><tr>{head}</tr>{body}</table>"


def table(
    results: Mapping[str, Maps] | Iterable[Maps],
    *,
    limits: Mapping[str, Limit | str] | None = None,
    **options: Any,
) -> Table:
    """Measure many results, one after the other.

    Parameters
    ----------
    results : mapping of str to maps, or iterable of maps
        Results by name, or paths, which are their own names; see `measure`. One is in memory at a time.
    limits : mapping of str to Limit or str, optional
        Limits of quantities by name, such as ``{"Sq": ":2um", "sphere radius": "4.9mm:5.1mm"}``.
    **options
        Those of `measure`, for all results.

    Returns
    -------
    Table
        A result that cannot be measured is a row with the reason.

    Raises
    ------
    InputError
        A limit cannot be read, has another unit than its quantity, or is of an unknown one.

    Examples
    --------
    >>> x, y = np.array([-0.1, 0.0, 0.1]), np.array([0.05, -0.05])
    >>> lot = {name: {"height": np.full((2, 3), z), "x": x, "y": y} for name, z in (("a", 1.0), ("b", 2.0))}
    >>> found = table(lot, limits={"median height": ":1500um"}, form="none")
    >>> [str(found.verdict(row)) for row in found.rows], found.values("median height")[0].tolist()
    (['inside', 'outside'], [1.0, 2.0])
    """
    read = {
        name: limit if isinstance(limit, Limit) else Limit.read(limit, name)
        for name, limit in (limits or {}).items()
    }
    lot: Mapping[Any, Maps] | None = results if isinstance(results, Mapping) else None
    rows = []
    for number, each in enumerate(results):
        name = str(each) if lot is not None or isinstance(each, str | os.PathLike) else str(number)
        try:
            rows.append(Row(name, measure(each if lot is None else lot[each], **options)))
        except InputError as error:
            rows.append(Row(name, None, str(error)))
    found = Table(_of_one_unit(rows), read)
    names = found.names
    for name, limit in read.items():
        if names and name not in names:
            raise InputError(f"limits of {name}: no result has it; there are {', '.join(names)}")
        limit.within(name, found.unit(name))
    return found


def _of_one_unit(rows: Sequence[Row]) -> list[Row]:
    """Return the rows; those whose lengths are in another unit than in the first one, without measures."""
    units = [
        {quantity.unit for quantity in row.measures.quantities.values()} if row.measures else set()
        for row in rows
    ]
    pixels = [PIXEL in used for used in units]
    first = next((pixel for pixel, row in zip(pixels, rows, strict=True) if row.measures), False)
    own, other = ("px", "mm") if first else ("mm", "px")
    problem = f"lengths are in {other}, those of the results before in {own}: give pixel_size"
    return [
        row if row.measures is None or pixel == first else Row(row.name, None, problem)
        for row, pixel in zip(rows, pixels, strict=True)
    ]
