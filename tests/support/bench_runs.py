"""Runs of the benchmark as JSON tells them, made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Data = dict[str, Any]


def timing(seconds: float, spread: float = 0.05, rounds: int = 7) -> Data:
    """Return a median and quartiles that lie by a share of it on either side."""
    return {
        "median": seconds,
        "lower": seconds * (1 - spread),
        "upper": seconds * (1 + spread),
        "rounds": rounds,
    }


def row(
    name: str,
    seconds: float,
    *,
    moved: int = 0,
    operations: int = 0,
    kernel: float | None = None,
    share: float | None = None,
    spread: float = 0.05,
    rounds: int = 7,
) -> Data:
    """Return a work that takes so long, and so long in kernels."""
    return {
        "name": name,
        "bytes": moved,
        "frames": 0,
        "operations": operations,
        "wall": timing(seconds, spread, rounds),
        "device": {} if kernel is None else {"kernel": timing(kernel, spread, rounds)},
        "kernels": {} if kernel is None else {"some_kernel": kernel},
        "moved": {} if kernel is None else {"some_kernel": moved},
        "first": seconds,
        "compile": 0,
        "bandwidth": moved / seconds,
        "share": share,
        "kernel_share": None,
    }


def target(what: str, met: bool, measured: str = "1.3 times") -> Data:
    """Return an aim that was reached, or was not."""
    return {"what": what, "bound": "at most 1.25 times", "measured": measured, "met": met}


def case(name: str, *rows: Data, targets: tuple[Data, ...] = (), notes: tuple[str, ...] = ()) -> Data:
    """Return a case of these rows."""
    told = {"absent": {}, "notes": list(notes), "targets": list(targets)}
    return {"name": name, "title": f"all about {name}", "rows": list(rows), **told}


def run(*cases: Data, **changes: Any) -> Data:
    """Return a run of these cases, on a machine that does not exist."""
    device = {"name": "Some GPU", "platform": "Some platform", "driver": "1.0", "kind": "gpu"}
    return {
        "date": "2026-11-21T12:00:00+00:00",
        "commit": "0123456789abcdef",
        "device": device,
        "processor": "Some processor",
        "threads": 2,
        "system": "Linux x86_64",
        "versions": {"Python": "3.11.7", "mirrorskin": "0.1.0", "numpy": "2.4.6", "torch": None},
        "quick": False,
        "cases": list(cases),
        **changes,
    }


def save(data: Data, path: Path) -> Path:
    """Write a run as `mirrorskin bench -o` does, and return where."""
    path.write_text(json.dumps(data), encoding="utf-8")
    return path
