"""How time shrinks with cores: processes of their own, whose device has so many threads."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from mirrorskin.bench.harness import Measured, Timing, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.scaling.process import run_process
from mirrorskin.bench.scaling.works import Scaled, scale_correlation, scale_press, scale_surface, scale_turn
from mirrorskin.bench.sweep.sweep import Sweep
from mirrorskin.bench.turns import STEPS
from mirrorskin.kernels.device import Device, DeviceInfo, open_device

_SHAPE, _SMALL = (1080, 1920), (24, 32)
_COUNT, _FEW = 32, 8
_SURFACE = (768, 1024)
_PROCESSES, _ROUNDS = 3, 5
_VARIABLES = "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"  # of old and of newer PoCL
_NAME, _TITLE = "scaling-cores", "press, correlation, turns and surface on ever more cores"


def run_cores(device: Device, quick: bool) -> Case:
    """Time the same works in processes that have 1, 2, 4, ... and all cores.

    Raises
    ------
    DeviceError
        A process failed.
    """
    if not _can_choose(device.info):
        said = f"{device.info.title}: only PoCL's CPU devices can be told how many cores to take"
        return Case(_NAME, _TITLE, [], {}, (said,))
    told: dict[int, list[list[Row]]] = {threads: [] for threads in _counts(THREADS)}
    for _ in range(1 if quick else _PROCESSES):  # taking turns, as works in one process do
        for threads, found in told.items():
            found.append(_read(_run_child(device.info, threads, quick), threads))
    rows = [_middle(same) for found in told.values() for same in zip(*found, strict=True)]
    return Sweep(_NAME, _TITLE, rows, {}, _notes(rows))


def _can_choose(info: DeviceInfo) -> bool:
    """Return whether a device is one whose number of threads can be told it."""
    return info.kind == "cpu" and info.platform == "Portable Computing Language"


def _counts(most: int) -> list[int]:
    """Return numbers of threads, doubled each time, and all there are."""
    return [*(2**n for n in range(most.bit_length()) if 2**n < most), most]


def _run_child(info: DeviceInfo, threads: int, quick: bool) -> Mapping[str, Any]:
    """Return what a process with so many cores measured."""
    asked = json.dumps({"device": info.title, "threads": threads, "quick": quick})
    return run_process([sys.executable, "-m", __name__, asked], dict.fromkeys(_VARIABLES, str(threads)))


def _read(told: Mapping[str, Any], threads: int) -> list[Row]:
    """Return a process' rows."""
    label = f"{threads} thread{'s' if threads > 1 else ''}"
    return [
        Row(f"{name}, {label}", as_measured(one["measured"]), one["bytes"], one["frames"])
        for name, one in told.items()
    ]


def _middle(same: Sequence[Row]) -> Row:
    """Return that of several processes' rows which took the median time."""
    return sorted(same, key=lambda row: row.measured.wall.median)[len(same) // 2]


def as_measured(told: Mapping[str, Any]) -> Measured:
    """Return what was measured, of what `dataclasses.asdict` made of it."""
    device = {kind: Timing(**timing) for kind, timing in told["device"].items()}
    return Measured(Timing(**told["wall"]), device, dict(told["kernels"]), told["first"], told["compile"])


def _notes(rows: list[Row]) -> tuple[str, ...]:
    """Say how many times as fast each work is on more cores."""
    names = dict.fromkeys(row.name.partition(", ")[0] for row in rows)
    notes = []
    for name in names:
        mine = [row for row in rows if row.name.partition(", ")[0] == name]
        first = mine[0].measured.wall.median
        times = ", ".join(f"{first / row.measured.wall.median:.2f}" for row in mine[1:])
        notes.append(f"{name}, times as fast as on one core: {times or 'there is one only'}")
    return tuple(notes)


def _measure(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Do the works in this process, and return what was measured of each."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: asked["threads"]])
    device, quick = open_device(asked["device"]), asked["quick"]
    shape, count = (_SMALL, _FEW) if quick else (_SHAPE, _COUNT)
    made = {
        "press": scale_press(device, shape, count),
        "correlation": scale_correlation(device, shape, count),
        "turns": scale_turn(device, shape, STEPS),
        "surface": scale_surface(device, _SMALL if quick else _SURFACE),
    }
    limits = Limits(device, np.zeros(max(one.bytes for one in made.values()), np.uint8))
    works = limits.works() | {name: one.work for name, one in made.items()}
    measured = take_turns(works, 1 if quick else _ROUNDS, device.profile)
    rows = [limits.rows(measured)[0], *(_row(name, one, measured[name]) for name, one in made.items())]
    return {
        row.name: {"measured": asdict(row.measured), "bytes": row.bytes, "frames": row.frames} for row in rows
    }


def _row(name: str, one: Scaled, measured: Measured) -> Row:
    return Row(name, measured, one.bytes, one.frames)


if __name__ == "__main__":
    print(json.dumps(_measure(json.loads(sys.argv[1]))))
