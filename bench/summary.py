"""A case in a few words: its works beside the quickest of the others that do the same."""

from __future__ import annotations

from collections.abc import Sequence

from mirrorskin.bench.ours import OURS
from mirrorskin.bench.report import Data, as_ms, is_limit

SUMMARY_HEAD = ("work", "ms", "GB/s", "of limit", "quickest other", "ms", "times as fast")


def as_summary(case: Data) -> list[list[str]]:
    """Return the works of ours in a case, as cells under `SUMMARY_HEAD`.

    Of a case with others only what one of them does as well, because the names end with the same part behind
    the comma, and what an aim is about. Sweeps are told by `as_sweep`.
    """
    works = [] if _is_sweep(case) else [row for row in case["rows"] if not is_limit(row)]
    ours, others = ([row for row in works if is_ours(row) is kind] for kind in (True, False))
    rivals = {row["name"]: _quickest(row, others) for row in ours}
    told = {target["what"] for target in case["targets"]} | {name for name in rivals if rivals[name]}
    alone = not any(rivals.values())
    return [_cells(row, rivals[row["name"]]) for row in ours if alone or row["name"] in told]


def as_sweep(case: Data) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return what a sweep goes through, sizes, types or cores, and its works: names and cells under those.

    Both are empty where a case is no sweep.
    """
    rows = [row for row in case["rows"] if _is_sweep(case) and not is_limit(row) and row["bytes"]]
    labels = tuple(dict.fromkeys(_part(row) for row in rows))
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        share = "" if row["share"] is None else f" ({100 * row['share']:.0f} %)"
        rate = row["bandwidth"] / 1e9
        lines.setdefault(_head(row), {})[_part(row)] = f"{rate:.{1 if rate >= 1 else 2}f}{share}"
    cells = ([name, *(found.get(label, "") for label in labels)] for name, found in lines.items())
    return labels, [[case["name"], *line] for line in cells]


def as_starts(case: Data) -> list[list[str]]:
    """Return the steps that a case takes cold and warm, and the milliseconds of both; else none."""
    steps: dict[str, dict[str, str]] = {}
    for row in case["rows"]:
        if _head(row) in ("cold", "warm"):
            steps.setdefault(_part(row), {})[_head(row)] = as_ms(row["wall"]["median"])
    return [[step, *(found.get(kind, "") for kind in ("cold", "warm"))] for step, found in steps.items()]


def is_ours(row: Data) -> bool:
    """Return whether a row is the engine's: by its name, or because it used the device."""
    return OURS in row["name"] or "kernel" in row["device"]


def is_accuracy(case: Data) -> bool:
    """Return whether a case holds answers against known truths."""
    return str(case["name"]).startswith("accuracy-")


def _is_sweep(case: Data) -> bool:
    return str(case["name"]).startswith(("sweep-", "scaling-"))


def _head(row: Data) -> str:
    return str(row["name"]).partition(", ")[0]


def _part(row: Data) -> str:
    return str(row["name"]).partition(", ")[2]


def _quickest(row: Data, others: Sequence[Data]) -> Data | None:
    same = [other for other in others if _part(other) == _part(row)]
    return min(same, key=lambda other: float(other["wall"]["median"]), default=None)


def _cells(row: Data, rival: Data | None) -> list[str]:
    mine = row["wall"]["median"]
    counted = bool(row["bytes"])
    share = row["share"] if counted else None
    return [
        row["name"],
        as_ms(mine),
        f"{row['bandwidth'] / 1e9:.2f}" if counted else "",
        "" if share is None else f"{100 * share:.0f} %",
        *(("", "", "") if rival is None else _beside(rival, mine)),
    ]


def _beside(rival: Data, mine: float) -> tuple[str, str, str]:
    theirs = rival["wall"]["median"]
    return _head(rival), as_ms(theirs), f"{theirs / mine:.1f}"
