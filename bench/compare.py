"""Two runs beside each other: what takes longer now, and whether by more than its turns vary."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from mirrorskin.bench.report import as_machine, as_ms
from mirrorskin.bench.run import Data
from mirrorskin.io import InputError

Verdict = Literal["quicker", "slower", "as before", "unknown"]

HEAD = ("work", "A, ms", "B, ms", "B / A", "quartiles", "verdict", "A, of limit", "B, of limit")

_SAME = 0.05  # by which a limit's bytes differ where another shape of its kernel was the best
_LEAST = 3  # turns that have a spread


@dataclass(frozen=True, slots=True)
class Difference:
    """One work in two runs.

    Attributes
    ----------
    name : str
    before, after : float
        Median seconds.
    ratio, lower, upper : float
        After to before for as much work; and what it is at least and at most, by the quartiles of both.
    verdict : str
        ``slower`` or ``quicker`` where the quartiles of the two do not overlap, else ``as before``;
        ``unknown`` of fewer than three turns.
    shares : (float or None, float or None)
        Of the limit in the same run.
    """

    name: str
    before: float
    after: float
    ratio: float
    lower: float
    upper: float
    verdict: Verdict
    shares: tuple[float | None, float | None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """What two runs have in common, and what not.

    Attributes
    ----------
    cases : dict of list of Difference
        By the case's name.
    warnings, targets, apart : tuple of str
        Why the two are no fair comparison; which aims were reached in one run and not in the other; works of
        one run alone, and what is no longer the same work.
    """

    cases: dict[str, list[Difference]]
    warnings: tuple[str, ...]
    targets: tuple[str, ...]
    apart: tuple[str, ...]

    @property
    def summary(self) -> tuple[str, ...]:
        """How many works changed; limits, which are the machine's, are counted by themselves."""
        every = [one for rows in self.cases.values() for one in rows]
        limits, works = ([one for one in every if ("limit" in one.name) is kind] for kind in (True, False))
        return tuple(
            f"{what}: {_count(rows)}; B takes {_mean(rows):.2f} times as long as A (geometric mean)"
            for what, rows in (("works", works), ("limits of the machine", limits))
            if rows
        )


def compare(before: Data, after: Data) -> Comparison:
    """Compare two runs, A and B, work by work.

    Raises
    ------
    InputError
        The runs have no work in common.
    """
    old, new = ({case["name"]: case for case in run["cases"]} for run in (before, after))
    shared = [name for name in old if name in new]
    cases = {name: rows for name in shared if (rows := list(_differences(old[name], new[name])))}
    if not cases and not any(old[name]["targets"] for name in shared):
        raise InputError("the two runs have no work in common: name runs of the same cases and sizes")
    return Comparison(
        cases,
        tuple(_warnings(before, after)),
        tuple(line for name in shared for line in _targets(old[name], new[name])),
        tuple(_apart(old, new, cases)),
    )


def as_data(comparison: Comparison, before: Data, after: Data) -> dict[str, Any]:
    """Return a comparison as what JSON knows."""
    runs = ({name: run[name] for name in run if name != "cases"} for run in (before, after))
    cases = [{"name": name, "rows": [asdict(one) for one in rows]} for name, rows in comparison.cases.items()]
    found = {name: list(getattr(comparison, name)) for name in ("warnings", "targets", "apart", "summary")}
    return {**dict(zip(("before", "after"), runs, strict=True)), "cases": cases, **found}


def as_rows(differences: Sequence[Difference]) -> list[list[str]]:
    """Return the table of a case, as cells under `HEAD`."""
    return [
        [
            one.name,
            as_ms(one.before),
            as_ms(one.after),
            f"{one.ratio:.2f}",
            f"{one.lower:.2f}-{one.upper:.2f}",
            one.verdict if one.verdict != "as before" else "",
            *("" if share is None else f"{100 * share:.0f} %" for share in one.shares),
        ]
        for one in differences
    ]


def _differences(before: Data, after: Data) -> Iterator[Difference]:
    others = {row["name"]: row for row in after["rows"]}
    for row in before["rows"]:
        if row["name"] in others and _is_same_work(row, others[row["name"]]):
            yield _difference(row, others[row["name"]])


def _difference(before: Data, after: Data) -> Difference:
    old, new, scale = before["wall"], after["wall"], _size(before) / _size(after)
    lower, upper = scale * new["lower"] / old["upper"], scale * new["upper"] / old["lower"]
    verdict: Verdict = "slower" if lower > 1 else "quicker" if upper < 1 else "as before"
    return Difference(
        before["name"],
        old["median"],
        new["median"],
        scale * new["median"] / old["median"],
        lower,
        upper,
        verdict if min(old["rounds"], new["rounds"]) >= _LEAST else "unknown",
        (_share(before), _share(after)),
    )


def _size(row: Data) -> float:
    """Return how much work a turn is, in whatever it is counted."""
    return float(row["bytes"] or row["operations"] or 1)


def _is_same_work(before: Data, after: Data) -> bool:
    return (
        before["frames"] == after["frames"]
        and bool(before["bytes"]) == bool(after["bytes"])
        and abs(math.log(_size(before) / _size(after))) < _SAME
    )


def _share(row: Data) -> float | None:
    return row["share"] if row["bytes"] else None


def _warnings(before: Data, after: Data) -> Iterator[str]:
    """Say what else than our code differs between two runs."""
    if as_machine(before) != as_machine(after):
        yield f"other machine or device: {as_machine(before)} / {as_machine(after)}"
    if before["system"] != after["system"]:
        yield f"other system: {before['system']} / {after['system']}"
    for name in sorted(before["versions"].keys() & after["versions"].keys() - {"mirrorskin"}):
        old, new = (run["versions"][name] or "none" for run in (before, after))
        if old != new:
            yield f"other {name}: {old} / {new}"
    if quick := [word for word, run in (("A", before), ("B", after)) if run["quick"]]:
        yield f"{' and '.join(quick)}: made with --quick; the times mean nothing"


def _targets(before: Data, after: Data) -> Iterator[str]:
    others = {target["what"]: target for target in after["targets"]}
    for target in before["targets"]:
        other = others.get(target["what"])
        if other is not None and other["met"] != target["met"]:
            word = "reached" if other["met"] else "missed"
            values = f"{target['measured']} before, {other['measured']} now ({other['bound']})"
            yield f"{before['name']}, {target['what']}: {word} now: {values}"


def _apart(old: Data, new: Data, cases: dict[str, list[Difference]]) -> Iterator[str]:
    for word, mine, others in (("A", old, new), ("B", new, old)):
        if only := [name for name in mine if name not in others]:
            yield f"only in {word}: {', '.join(only)}"
    for name in (name for name in old if name in new):
        compared = {one.name for one in cases.get(name, [])}
        names = dict.fromkeys(row["name"] for case in (old[name], new[name]) for row in case["rows"])
        if rest := [row for row in names if row not in compared]:
            yield f"{name}: not the same work in both, or in one alone: {', '.join(rest)}"


def _count(rows: Sequence[Difference]) -> str:
    counts = Counter(one.verdict for one in rows)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in get_args(Verdict) if counts[verdict])


def _mean(rows: Sequence[Difference]) -> float:
    return math.exp(sum(math.log(one.ratio) for one in rows) / len(rows))
