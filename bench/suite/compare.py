"""Comparison of two runs: which works take longer, and by more than the variation between rounds."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from mirrorskin.cli.commands.bench.records import Case, Row, Run, as_ms, as_percent
from mirrorskin.io import InputError

Verdict = Literal["faster", "slower", "as before", "unknown"]

HEAD = ("work", "A, ms", "B, ms", "B / A", "quartiles", "verdict", "A, of limit", "B, of limit")

_SAME = 0.05  # relative difference of the bytes of a limit if another shape of its kernel was the fastest
_LEAST = 3  # minimum number of rounds for quartiles


@dataclass(frozen=True, slots=True)
class Difference:
    """One work in two runs.

    Attributes
    ----------
    name : str
    before, after : float
        Median seconds.
    ratio, lower, upper : float
        ``after`` divided by ``before`` for the same amount of work, and its bounds from the quartiles.
    verdict : str
        ``slower`` or ``faster`` if the quartiles of the two do not overlap, else ``as before``;
        ``unknown`` for fewer than three rounds.
    shares : (float, float)
        Bandwidth as a share of the limit in the same run; NaN without a limit.
    """

    name: str
    before: float
    after: float
    ratio: float
    lower: float
    upper: float
    verdict: Verdict
    shares: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Comparison:
    """The comparison of two runs.

    Attributes
    ----------
    cases : dict of list of Difference
        Differences by the name of the case.
    warnings, targets, apart : tuple of str
        Reasons why the runs are not comparable; targets met by only one of them; works that are in one run
        only, or that have different amounts of work.
    """

    cases: dict[str, list[Difference]]
    warnings: tuple[str, ...]
    targets: tuple[str, ...]
    apart: tuple[str, ...]

    @property
    def summary(self) -> tuple[str, ...]:
        """Numbers of changed works; limits, which are properties of the machine, are counted separately."""
        every = [difference for rows in self.cases.values() for difference in rows]
        limits, works = (
            [difference for difference in every if ("limit" in difference.name) is kind]
            for kind in (True, False)
        )
        return tuple(
            f"{what}: {_count(rows)}; B takes {_mean(rows):.2f} times as long as A (geometric mean)"
            for what, rows in (("works", works), ("limits of the machine", limits))
            if rows
        )


def compare(before: Run, after: Run) -> Comparison:
    """Compare two runs, A and B, work by work.

    Raises
    ------
    InputError
        The runs have no work in common.
    """
    old, new = ({case.name: case for case in run.cases} for run in (before, after))
    shared = [name for name in old if name in new]
    cases = {name: rows for name in shared if (rows := list(_differences(old[name], new[name])))}
    if not cases and not any(old[name].targets for name in shared):
        raise InputError("the two runs have no work in common: specify runs of the same cases and sizes")
    return Comparison(
        cases,
        tuple(_warnings(before, after)),
        tuple(line for name in shared for line in _targets(old[name], new[name])),
        tuple(_apart(old, new, cases)),
    )


def as_text(before: Run, after: Run) -> str:
    """Compare two runs, and return titles, tables and other differences as text."""
    comparison = compare(before, after)
    parts = [f"A: {before.title}", f"B: {after.title}", *(f"warning: {line}" for line in comparison.warnings)]
    for name, rows in comparison.cases.items():
        parts += ["", name, *_aligned([list(HEAD), *as_rows(rows)])]
    return "\n".join([*parts, "", *comparison.targets, *comparison.apart, *comparison.summary])


def as_rows(differences: Sequence[Difference]) -> list[list[str]]:
    """Return the table of a case as cells under `HEAD`."""
    return [
        [
            difference.name,
            as_ms(difference.before),
            as_ms(difference.after),
            f"{difference.ratio:.2f}",
            f"{difference.lower:.2f}-{difference.upper:.2f}",
            difference.verdict if difference.verdict != "as before" else "",
            *map(as_percent, difference.shares),
        ]
        for difference in differences
    ]


def _aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table; all columns but the first are right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *cells in rows:
        numbers = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        yield "  ".join([first.ljust(widths[0]), *numbers]).rstrip()


def _differences(before: Case, after: Case) -> Iterator[Difference]:
    others = {row.name: row for row in after.rows}
    for row in before.rows:
        other = others.get(row.name)
        if other is not None and _is_same_work(row, other):
            shares = (before.share(row), after.share(other)) if row.bytes else (math.nan, math.nan)
            yield _difference(row, other, shares)


def _difference(before: Row, after: Row, shares: tuple[float, float]) -> Difference:
    old, new, scale = before.wall, after.wall, _size(before) / _size(after)
    lower, upper = scale * new.lower / old.upper, scale * new.upper / old.lower
    verdict: Verdict = "slower" if lower > 1 else "faster" if upper < 1 else "as before"
    if min(old.rounds, new.rounds) < _LEAST:
        verdict = "unknown"
    ratio = scale * new.median / old.median
    return Difference(before.name, old.median, new.median, ratio, lower, upper, verdict, shares)


def _size(row: Row) -> float:
    """Return the amount of work of a row, in its own unit."""
    return float(row.bytes or row.operations or 1)


def _is_same_work(before: Row, after: Row) -> bool:
    return (
        before.frames == after.frames
        and bool(before.bytes) == bool(after.bytes)
        and abs(math.log(_size(before) / _size(after))) < _SAME
    )


def _warnings(before: Run, after: Run) -> Iterator[str]:
    """Yield the differences between two runs other than the code."""
    if before.machine != after.machine:
        yield f"other machine or device: {before.machine} / {after.machine}"
    if before.system != after.system:
        yield f"other system: {before.system} / {after.system}"
    for name in sorted(before.versions.keys() & after.versions.keys() - {"mirrorskin"}):
        old, new = (run.versions[name] or "none" for run in (before, after))
        if old != new:
            yield f"other {name}: {old} / {new}"
    if quick := [word for word, run in (("A", before), ("B", after)) if run.quick]:
        yield f"{' and '.join(quick)}: made with --quick; the times mean nothing"


def _targets(before: Case, after: Case) -> Iterator[str]:
    others = {target.what: target for target in after.targets}
    for target in before.targets:
        other = others.get(target.what)
        if other is not None and other.met != target.met:
            word = "met" if other.met else "missed"
            values = f"{target.measured} before, {other.measured} now ({other.bound})"
            yield f"{before.name}, {target.what}: {word} now: {values}"


def _apart(old: dict[str, Case], new: dict[str, Case], cases: dict[str, list[Difference]]) -> Iterator[str]:
    for word, mine, others in (("A", old, new), ("B", new, old)):
        if only := [name for name in mine if name not in others]:
            yield f"only in {word}: {', '.join(only)}"
    for name in (name for name in old if name in new):
        compared = {difference.name for difference in cases.get(name, [])}
        names = dict.fromkeys(row.name for case in (old[name], new[name]) for row in case.rows)
        if rest := [row for row in names if row not in compared]:
            yield f"{name}: not the same work in both, or only in one: {', '.join(rest)}"


def _count(rows: Sequence[Difference]) -> str:
    counts = Counter(difference.verdict for difference in rows)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in get_args(Verdict) if counts[verdict])


def _mean(rows: Sequence[Difference]) -> float:
    return math.exp(sum(math.log(difference.ratio) for difference in rows) / len(rows))
