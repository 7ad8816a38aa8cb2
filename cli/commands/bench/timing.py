"""Fair timing on a shared machine: the works of a case take turns, and their results are compared first."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from mirrorskin.cli.commands.bench.records import Row, Timing
from mirrorskin.kernels.profile import Kind, Profile, Record

OURS = "mirrorskin"
FIRST = f"{OURS}, first call"
"""A whole call, and the same call without memory kept from earlier ones."""
ROUNDS = 15

_PAUSE = 0.005  # s before a turn, in which the threads of the previous work go to sleep
_PATIENCE = 10.0  # s that a work may take in total; it is timed _LEAST times however slow it is
_LEAST = 3
_KINDS: tuple[Kind, ...] = ("upload", "kernel", "download")


@dataclass(frozen=True)
class Work:
    """A call that is timed; the numbers are those of `Row`. `before` is called before each turn, untimed."""

    call: Callable[[], object]
    bytes: int = 0
    frames: int = 0
    operations: int = 0
    before: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class _Turn:
    wall: float
    processor: float
    records: list[Record]
    result: object = None

    def seconds(self, kind: Kind, name: str | None = None) -> float:
        return sum(
            record.seconds for record in self.records if record.kind == kind and name in (None, record.name)
        )


def take_turns(
    works: Mapping[str, Work],
    rounds: int,
    profile: Profile,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
) -> dict[str, Row]:
    """Time several works, each once a round, after one untimed warm-up whose results are given to `check`.

    A work that has taken 10 s in total and had three turns leaves the remaining rounds to the others.
    """
    warm_ups = {}
    for name, work in works.items():
        work.before()
        warm_ups[name] = _turn(work, profile)
    check({name: turn.result for name, turn in warm_ups.items()})
    first = {name: (turn.wall, turn.seconds("compile")) for name, turn in warm_ups.items()}
    warm_ups.clear()  # and the maps that they hold

    turns: dict[str, list[_Turn]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            mine = turns[name]
            if len(mine) < _LEAST or sum(turn.wall for turn in mine) < _PATIENCE:
                work.before()
                time.sleep(_PAUSE)
                turn = _turn(work, profile)
                mine.append(_Turn(turn.wall, turn.processor, turn.records))
    return {name: _row(name, works[name], mine, *first[name]) for name, mine in turns.items()}


def _turn(work: Work, profile: Profile) -> _Turn:
    profile.clear()
    used, start = time.process_time(), time.perf_counter()
    result = work.call()
    wall, used = time.perf_counter() - start, time.process_time() - used
    return _Turn(wall, used, profile.records(), result)


def _row(name: str, work: Work, turns: list[_Turn], first: float, compiling: float) -> Row:
    device = {kind: [turn.seconds(kind) for turn in turns] for kind in _KINDS}
    moved = {record.name: float(record.bytes) for record in turns[-1].records if record.kind == "kernel"}
    kernels = {kernel: [turn.seconds("kernel", kernel) for turn in turns] for kernel in sorted(moved)}
    return Row(
        name=name,
        wall=Timing.of([turn.wall for turn in turns]),
        processor=float(np.median([turn.processor for turn in turns])),
        bytes=work.bytes,
        frames=work.frames,
        operations=work.operations,
        device={kind: Timing.of(seconds) for kind, seconds in device.items() if any(seconds)},
        kernels={kernel: float(np.median(seconds)) for kernel, seconds in kernels.items()},
        moved=moved,
        first=first,
        compile=compiling,
    )


def renamed(row: Row, name: str) -> Row:
    """Return a row under another name."""
    return msgspec.structs.replace(row, name=name)
