"""Artificial runs of benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mirrorskin.cli.commands.bench.records import Case, Machine, Row, Run, Target, Timing


def timing(seconds: float, spread: float = 0.05, rounds: int = 7) -> Timing:
    """Return a median, and quartiles a fraction of it below and above."""
    return Timing(seconds, seconds * (1 - spread), seconds * (1 + spread), rounds)


def row(
    name: str,
    seconds: float,
    *,
    moved: int = 0,
    operations: int = 0,
    frames: int = 0,
    kernel: float | None = None,
    spread: float = 0.05,
    rounds: int = 7,
) -> Row:
    """Return a work with its time, and its time in kernels."""
    return Row(
        name=name,
        wall=timing(seconds, spread, rounds),
        bytes=moved,
        frames=frames,
        operations=operations,
        device={} if kernel is None else {"kernel": timing(kernel, spread, rounds)},
        kernels={} if kernel is None else {"some_kernel": kernel},
        moved={} if kernel is None else {"some_kernel": moved},
        first=seconds,
    )


def target(what: str, met: bool, measured: str = "1.3 times") -> Target:
    """Return a target that was met, or was not."""
    return Target(what, "at most 1.25 times", measured, met)


def case(name: str, *rows: Row, targets: tuple[Target, ...] = (), notes: tuple[str, ...] = ()) -> Case:
    """Return a case of these rows."""
    return Case(name, f"all about {name}", list(rows), {}, notes, targets)


def run(*cases: Case, **changes: Any) -> Run:
    """Return a run of these cases on a machine that does not exist."""
    values: dict[str, Any] = {
        "date": "2026-11-21T12:00:00+00:00",
        "commit": "0123456789abcdef",
        "device": Machine("Some GPU", "Some platform", "1.0", "gpu"),
        "processor": "Some processor",
        "threads": 2,
        "system": "Linux x86_64",
        "versions": {"Python": "3.11.7", "mirrorskin": "0.1.0", "numpy": "2.4.6", "torch": None},
        "quick": False,
        "cases": list(cases),
    }
    return Run(**{**values, **changes})


def save(run_: Run, path: Path) -> Path:
    """Write a run as `mirrorskin bench -o` does, and return its path."""
    path.write_bytes(run_.as_json())
    return path
