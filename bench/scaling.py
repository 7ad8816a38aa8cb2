"""How time goes with frames, pixels and cores."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from mirrorskin.bench.harness import THREADS, Case, Cases, Measured, Row, Timing, check_memory, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.scenes import STEPS, Shape
from mirrorskin.bench.sweep import Job, correlation_job, press_job, surface_job, turns_job
from mirrorskin.kernels.device import Device, open_device
from mirrorskin.kernels.errors import DeviceError

_VGA, _HD, _SMALL = (480, 640), (1080, 1920), (24, 32)
_COUNTS, _FEW = (8, 32, 128, 512), (8, 16)
_SHAPES: tuple[Shape, ...] = ((120, 160), (240, 320), (480, 640), (1080, 1920), (2160, 3840), (3648, 5472))
_TINY: tuple[Shape, ...] = ((12, 16), (24, 32))
_PRESS = 16  # frames of a press, where pixels grow
_LARGEST = 3_000_000  # pixels of a surface
_CORES_FRAMES, _CORES_SURFACE = 32, (768, 1024)
_ROOM = 200  # bytes of a pixel, for all maps
_ROUNDS, _PROCESSES = 5, 3
_PATIENCE = 600.0  # seconds for a process
_VARIABLES = "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"  # of old and of newer PoCL


def run_frames(device: Device, quick: bool) -> Case:
    """Time a press, a correlation and turns of ever more frames, maps included."""
    shape, counts = (_SMALL, _FEW) if quick else (_VGA, _COUNTS)
    check_memory("scaling-frames", 4 * sum(counts) * math.prod(shape))
    jobs = {f"press, {n} frames": press_job(device, shape, "uint8", n, maps=True) for n in counts}
    jobs |= {
        f"correlation, {n} frames": correlation_job(device, shape, "uint8", n, maps=True) for n in counts
    }
    jobs |= {f"turns, {n} frames": turns_job(device, shape, "uint8", n) for n in counts}
    rows = _time(jobs, device, quick)
    names = ("press", "correlation", "turns")
    notes = tuple(_by_frame(name, [row for row in rows if row.name.startswith(name)]) for name in names)
    title = f"presses, correlations and turns of {shape[0]} x {shape[1]} uint8, maps included"
    return Case("scaling-frames", title, rows, {}, notes)


def run_pixels(device: Device, quick: bool) -> Case:
    """Time a press, a turn and a surface of ever more pixels, maps included."""
    shapes = _TINY if quick else _SHAPES
    check_memory("scaling-pixels", sum(map(math.prod, shapes)) * _ROOM)
    jobs: dict[str, Job] = {}
    for shape in shapes:
        size = f"{shape[0]} x {shape[1]}"
        jobs[f"press, {size}"] = press_job(device, shape, "uint8", _PRESS, maps=True)
        jobs[f"turns, {size}"] = turns_job(device, shape, "uint8", STEPS)
        if math.prod(shape) <= _LARGEST:
            jobs[f"surface, {size}"] = surface_job(device, shape)
    title = f"a press of {_PRESS} frames, a turn of {STEPS}, a surface within a mask; uint8, maps included"
    return Case("scaling-pixels", title, _time(jobs, device, quick), {})


def _time(jobs: Mapping[str, Job], device: Device, quick: bool) -> list[Row]:
    """Return the limit, of as many bytes as the largest work, and the works."""
    limits = Limits(device, max(job.bytes for job in jobs.values()))
    works = limits.works() | {name: job.work for name, job in jobs.items()}
    measured = take_turns(works, 1 if quick else _ROUNDS, device.profile)
    return limits.rows(measured) + [
        Row(name, measured[name], job.bytes, job.frames) for name, job in jobs.items()
    ]


def _by_frame(name: str, rows: list[Row]) -> str:
    """Say what a call costs, and what each frame adds: a straight line, fitted to shares of the time."""
    counts, seconds = np.array([[row.frames, row.measured.wall.median] for row in rows]).T
    slope, fixed = np.polyfit(counts, seconds, 1, w=1 / seconds)
    off = np.max(np.abs((fixed + slope * counts) / seconds - 1))
    return f"{name}: {1e3 * fixed:.2f} ms and {1e6 * slope:.1f} us a frame, within {100 * off:.0f} %"


def run_cores(device: Device, quick: bool) -> Case:
    """Time the same works in processes whose device has 1, 2, 4, ... and all cores."""
    name, title = "scaling-cores", "press, correlation, turns and surface on ever more cores"
    if device.info.kind != "cpu" or device.info.platform != "Portable Computing Language":
        note = f"{device.info.title}: only of PoCL's CPU devices can the number of cores be set"
        return Case(name, title, [], {}, (note,))
    counts = [*(2**n for n in range(THREADS.bit_length()) if 2**n < THREADS), THREADS]
    found: dict[int, list[list[Row]]] = {threads: [] for threads in counts}
    for _ in range(1 if quick else _PROCESSES):  # taking turns, as works in one process do
        for threads, same in found.items():
            asked = json.dumps({"device": device.info.title, "threads": threads, "quick": quick})
            command = [sys.executable, "-m", "mirrorskin.bench.scaling", asked]
            same.append(_read(run_process(command, dict.fromkeys(_VARIABLES, str(threads))), threads))
    rows = [row for same in found.values() for row in _middle(same)]
    return Case(name, title, rows, {}, _speed_ups(rows))


def run_process(command: Sequence[str], environment: Mapping[str, str]) -> dict[str, Any]:
    """Run a process with some variables of its own; return the JSON in its last line.

    Raises DeviceError with its last line where it failed.
    """
    variables = {**os.environ, **environment}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=_PATIENCE)
    if done.returncode:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise DeviceError(f"a process of the benchmark ended with {done.returncode}: {last}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _read(found: Mapping[str, Any], threads: int) -> list[Row]:
    """Return a process' rows: the limit, and works that are shares of it."""
    rows: list[Row] = []
    for name, one in found.items():
        measured = dict(one["measured"])
        measured["wall"] = Timing(**measured["wall"])
        measured["device"] = {kind: Timing(**timing) for kind, timing in measured["device"].items()}
        label = f"{name}, {threads} thread{'s' if threads > 1 else ''}"
        rows.append(Row(label, Measured(**measured), one["bytes"], one["frames"]))
    return [rows[0], *(replace(row, limit=rows[0]) for row in rows[1:])]


def _middle(same: Sequence[Sequence[Row]]) -> list[Row]:
    """Return of each work the row of the process in which it took the median time."""
    return [
        sorted(rows, key=lambda row: row.measured.wall.median)[len(rows) // 2]
        for rows in zip(*same, strict=True)
    ]


def _speed_ups(rows: list[Row]) -> tuple[str, ...]:
    """Say how many times as fast each work is on more cores."""
    notes = []
    for name in dict.fromkeys(row.name.partition(", ")[0] for row in rows):
        first, *others = (row.measured.wall.median for row in rows if row.name.partition(", ")[0] == name)
        times = ", ".join(f"{first / one:.2f}" for one in others)
        notes.append(f"{name}, times as fast as on one core: {times or 'there is one only'}")
    return tuple(notes)


def _measure(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Do the works in this process, and return what was measured of each."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: asked["threads"]])
    device, quick = open_device(asked["device"]), asked["quick"]
    shape, count = (_SMALL, STEPS) if quick else (_HD, _CORES_FRAMES)
    jobs = {
        "press": press_job(device, shape, "uint8", count, maps=True),
        "correlation": correlation_job(device, shape, "uint8", count, maps=True),
        "turns": turns_job(device, shape, "uint8", STEPS),
        "surface": surface_job(device, _SMALL if quick else _CORES_SURFACE),
    }
    first, _, _, *rows = _time(jobs, device, quick)
    return {
        row.name: {"measured": asdict(row.measured), "bytes": row.bytes, "frames": row.frames}
        for row in (first, *rows)
    }


CASES: Cases = {"scaling-frames": run_frames, "scaling-pixels": run_pixels, "scaling-cores": run_cores}

if __name__ == "__main__":
    print(json.dumps(_measure(json.loads(sys.argv[1]))))
