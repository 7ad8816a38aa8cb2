"""How time grows with frames and pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mirrorskin.bench.harness import Case, Cases, Row, check_memory, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.scenes import STEPS, Shape
from mirrorskin.bench.sweep import Job, correlation_job, press_job, surface_job, turns_job
from mirrorskin.kernels.device import Device

_VGA, _SMALL = (480, 640), (24, 32)
_COUNTS, _FEW = (8, 32, 128, 512), (8, 16)
_SHAPES: tuple[Shape, ...] = ((120, 160), (240, 320), (480, 640), (1080, 1920), (2160, 3840), (3648, 5472))
_TINY: tuple[Shape, ...] = ((12, 16), (24, 32))
_PRESS = 16  # frames of a press, where pixels grow
_LARGEST = 3_000_000  # pixels of a surface
_ROOM = 200  # bytes of a pixel, for all maps
_ROUNDS = 5


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


CASES: Cases = {"scaling-frames": run_frames, "scaling-pixels": run_pixels}
