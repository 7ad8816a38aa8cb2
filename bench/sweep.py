"""Kernels and estimators over sizes, types and numbers of frames, with their operations for the roofline.

Answers are not looked at here: tests hold each kernel against its reference, and the accuracy cases each
estimator against known truths.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from mirrorskin.bench.harness import Case, Cases, Row, Work, check_memory, pusher, take_turns
from mirrorskin.bench.integration import divisors, link, solve_with_scipy
from mirrorskin.bench.limits import Arithmetic, Limits, beside_limits
from mirrorskin.bench.normals import NORMAL, Turn, kernel_alone
from mirrorskin.bench.scenes import (
    LEVELS,
    PIXEL,
    SCALES,
    STEPS,
    TILT,
    Shape,
    fill_press,
    fill_turns,
    large_mask,
    noisy_slopes,
    phases,
    press_noise,
    random_cuts,
    references,
    roof,
    travel_of,
    turn_noise,
)
from mirrorskin.engine import (
    ChangePointSearch,
    Correlator,
    Integrator,
    NormalEstimator,
    OnsetSearch,
    correlate,
    find_edges,
    integrate,
)
from mirrorskin.engine.integration.rectangle import Rectangle
from mirrorskin.kernels.device import Device

SIZES: dict[str, Shape] = {"VGA": (480, 640), "1080p": (1080, 1920), "20 Mpx": (3648, 5472)}
_QUICK: dict[str, Shape] = {"37 x 61": (37, 61)}
_TYPES, _MAPS_ONLY = ("uint8", "uint16", "float32"), ("float32",)
_FEW, _LEAST, _MOST = 16, 8, 256  # frames: of a quick run, and the fewest and most of others
_TURN = 96_000_000  # bytes of frames that a turn is to have
_ROUNDS = 5
_CHAINS = 2_000_000  # pixels, at most, that arithmetic's limit takes as long as
_ROOM = 1_000_000_000  # bytes for what a case takes beside its maps
_CUTS = 50
# Operations, multiply-adds and what takes as long: of a sample, or of a pixel where there are no samples.
_SCAN, _CUSUM, _SPLIT, _WAVE = 2, 10, 9, 4
_NORMAL = 3 * 37 + 12  # three looks at each sample, and what goes before
_EDGES = 24 * 4 * 14  # pairs of places in three passes, directions, and operations of a pair


@dataclass(frozen=True, slots=True)
class Job:
    """One work on one size and type.

    `bytes` are what goes in and what comes out, each once, and sums once read and once written; `operations`
    multiply-adds and what takes as long, 0 where nobody counted.
    """

    work: Work
    bytes: int
    frames: int = 0
    operations: int = 0


def press_job(device: Device, shape: Shape, kind: str, count: int, *, maps: bool = False) -> Job:
    """Return the onset of a press with references of each pixel; with its maps, or the scan alone."""
    dtype, (dark, bright) = np.dtype(kind), references(shape, np.dtype(kind))
    room = 2 * count * math.prod(shape) * dtype.itemsize
    known: dict[str, Any] = {
        "dark": dark,
        "bright": bright,
        "noise": press_noise(dtype),
        "memory_limit": room,
    }
    search = OnsetSearch(shape, dtype, device=device, **known)
    fill_press(search.room[:count])
    frames = search.room[:count]
    work = pusher(search, frames, maps=maps, travel=travel_of(count))
    return Job(work, frames.nbytes, count, _SCAN * frames.size)


def correlation_job(device: Device, shape: Shape, kind: str, count: int, *, maps: bool = False) -> Job:
    """Return the wave of a stack, or its sums alone."""
    dtype, pixels = np.dtype(kind), math.prod(shape)
    correlator = Correlator(shape, dtype, device=device, memory_limit=2 * count * pixels * dtype.itemsize)
    frames = correlator.room[:count]
    fill_turns(frames)
    moved = frames.nbytes + (16 * pixels if maps else 0)
    work = pusher(correlator, frames, maps=maps, phase=phases(count))
    return Job(work, moved, count, _WAVE * frames.size)


def turns_job(device: Device, shape: Shape, kind: str, count: int) -> Job:
    """Return the normals of turns of 8 frames, maps included."""
    offset, gain, _ = SCALES[kind]
    known: dict[str, Any] = {"gain": gain, "offset": offset, "noise": turn_noise(np.dtype(kind))}
    room = 2 * (count + 1) * math.prod(shape)
    estimator = NormalEstimator(shape, kind, tilt=TILT, device=device, memory_limit=room, **known)
    frames = estimator.room[:count]
    fill_turns(frames)
    work = pusher(estimator, frames, maps=True, phase=phases(count))
    return Job(work, frames.nbytes + NORMAL * math.prod(shape), count)


def surface_job(device: Device, shape: Shape) -> Job:
    """Return the heights of noisy slopes within a mask, from nothing each time."""
    dz_dx, dz_dy = noisy_slopes(shape)
    mask, integrator = large_mask(shape), Integrator(shape, PIXEL, device=device)

    def work() -> object:
        integrator.reset()
        integrator.push(dz_dx, dz_dy, mask=mask, tolerance=1e-5)
        return integrator.result()

    return Job(work, (2 * 4 + 1 + 4) * mask.size)


def _onset(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    return {"onset_scan": press_job(device, shape, kind, count)}


def _changes(device: Device, shape: Shape, kind: str, count: int, *, known: bool) -> dict[str, Job]:
    """Return the cumulative sum between known levels, or the two passes between unknown ones."""
    dtype, (dark, bright) = np.dtype(kind), LEVELS[kind]
    levels: dict[str, Any] = {"dark": dark, "bright": bright} if known else {}
    levels |= {"noise": press_noise(dtype), "memory_limit": 2 * count * math.prod(shape) * dtype.itemsize}
    search = ChangePointSearch(shape, dtype, device=device, **levels)
    frames = search.room[:count]
    fill_press(frames)
    travel = travel_of(count)
    if known:
        work = pusher(search, frames, travel=travel)
        return {"changepoint_scan": Job(work, frames.nbytes, count, _CUSUM * frames.size)}
    np.nan_to_num(frames, copy=False)

    def passes() -> None:
        search.reset()
        search.push(frames, travel=travel)
        search.start_second_pass()
        search.push(frames, travel=travel)
        device.finish()

    return {"changepoint_sum and _split": Job(passes, 2 * frames.nbytes, count, _SPLIT * frames.size)}


def _correlation(device: Device, shape: Shape, kind: str, count: int) -> dict[str, Job]:
    """Return the sums over a stack, and the wave of one turn, which is summed and solved at once."""
    dtype = np.dtype(kind)
    turn = np.empty((STEPS, *shape), dtype)
    fill_turns(turn)
    moved = turn.nbytes + 16 * math.prod(shape)
    work = partial(correlate, turn, phases(STEPS), device=device)
    return {
        "correlation_add" if dtype.kind == "u" else "correlation_sum": correlation_job(
            device, shape, kind, count
        ),
        "correlation_window": Job(work, moved, STEPS, _WAVE * turn.size),
    }


def _normals(device: Device, shape: Shape, kind: str, _: int) -> dict[str, Job]:
    turn = Turn(shape, np.dtype(kind))
    operations = math.prod(shape) * STEPS * _NORMAL
    return {"normals_exact": Job(kernel_alone(turn, device), turn.bytes, STEPS, operations)}


def _edges(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    maps, pixels = roof(shape), math.prod(shape)
    work = partial(find_edges, *maps, device=device)
    return {"edges": Job(work, pixels * (12 + 4 + 1 + 1), 0, pixels * _EDGES)}


def _rectangle(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return the direct solver of a full picture, and SciPy's: two transforms of 1.25 log2 of a side."""
    source = link(noisy_slopes(shape)).source.astype(np.float32)
    given, solver = device.given("source", source), Rectangle(shape, (1.0, 1.0), device)
    ready, pixels = divisors(shape, np.float32), math.prod(shape)

    def solve() -> None:
        solver.solve(given)
        device.finish()

    operations = pixels * (2 * round(1.25 * math.log2(min(shape))) + 6)
    peer = partial(solve_with_scipy, source, ready)
    return {"rectangle": Job(solve, 8 * pixels, 0, operations), "SciPy": Job(peer, 8 * pixels)}


def _surfaces(device: Device, shape: Shape, _kind: str, _: int) -> dict[str, Job]:
    """Return heights within a mask, and with cuts; what their kernels move, they say themselves."""
    dz_dx, dz_dy = noisy_slopes(shape)
    known: dict[str, Any] = {"mask": large_mask(shape), "sigma": False, "device": device}
    cut = {**known, "edges": random_cuts(shape, _CUTS)}
    moved = math.prod(shape) * (2 * 4 + 1 + 4)
    return {
        "integrate within a mask": Job(partial(integrate, dz_dx, dz_dy, PIXEL, **known), moved),
        f"integrate with {_CUTS} cuts": Job(partial(integrate, dz_dx, dz_dy, PIXEL, **cut), moved),
    }


@dataclass(frozen=True, slots=True)
class Family:
    """The works of a kernel file: what makes them, their limit, and bytes of a pixel for all maps."""

    title: str
    make: Callable[[Device, Shape, str, int], dict[str, Job]]
    types: tuple[str, ...]
    limit: Literal["read", "triad"]
    room: int


def run_sweep(name: str, family: Family, device: Device, quick: bool) -> Case:
    """Time works and the limit in all sizes and types; the last group ends with the limit of arithmetic."""
    rows: list[Row] = []
    sizes = _QUICK if quick else SIZES
    notes = [f"shares are of the {family.limit} limit above a row, of as many bytes"]
    for size, shape in sizes.items():
        for kind in family.types:
            itemsize, pixels = np.dtype(kind).itemsize, math.prod(shape)
            count = min(_MOST, max(_LEAST, _TURN // (pixels * itemsize) // 8 * 8))
            count = _FEW if quick else count
            check_memory(name, _ROOM + pixels * (family.room + 2 * count * itemsize))
            jobs = family.make(device, shape, kind, count)
            limits = Limits(device, max(job.bytes for job in jobs.values()))
            arithmetic = Arithmetic(device, min(pixels, _CHAINS))
            works = {**limits.works(), **arithmetic.works(), **{one: job.work for one, job in jobs.items()}}
            measured = take_turns(works, 1 if quick else _ROUNDS, device.profile)
            label = f"{size} {kind}" if len(family.types) > 1 else size
            best = limits.rows(measured, first=family.limit)[0]
            limit = Row(f"{best.name}, {label}", best.measured, best.bytes)
            mine = [
                Row(f"{one}, {label}", measured[one], job.bytes, job.frames, job.operations, limit)
                for one, job in jobs.items()
            ]
            rows += [limit, *mine]
    notes += [_traffic(row, limit) for row in mine if row.measured.kernels]
    return Case(name, family.title, [*rows, arithmetic.row(measured)], {}, tuple(notes))


def _traffic(row: Row, limit: Row) -> str:
    """Say what a work's kernels take, and at which share of the limit they move what they say."""
    seconds, moved = row.measured.kernels, row.measured.moved
    longest = sorted(seconds, key=lambda one: -seconds[one])[:6]
    rates = {one: moved[one] / max(seconds[one], 1e-9) / limit.kernel_bandwidth for one in longest}
    parts = (f"{one} {1e3 * seconds[one]:.2f} ms ({100 * rates[one]:.0f} %)" for one in longest)
    return f"{row.name}: kernels move {sum(moved.values()) / 1e6:.1f} MB, of the limit: {', '.join(parts)}"


FAMILIES = {
    "sweep-onset": Family("onset.cl: a press with references of each pixel", _onset, _TYPES, "read", 80),
    "sweep-changepoint": Family(
        "changepoint.cl: a press between known levels", partial(_changes, known=True), _TYPES, "read", 140
    ),
    "sweep-changepoint-unknown": Family(
        "changepoint.cl: between unknown levels, two passes",
        partial(_changes, known=False),
        _TYPES,
        "read",
        140,
    ),
    "sweep-correlation": Family(
        f"correlation.cl: sums over a stack, the wave of {STEPS} frames",
        _correlation,
        _TYPES,
        "read",
        140,
    ),
    "sweep-normals": Family(f"normals.cl: exact normals of {STEPS} frames", _normals, _TYPES, "triad", 80),
    "sweep-edges": Family("edges.cl: edges of a roof, half of it noisy", _edges, _MAPS_ONLY, "triad", 110),
    "sweep-rectangle": Family("rectangle.cl: heights of a full picture", _rectangle, _MAPS_ONLY, "triad", 60),
    "sweep-surface": Family(
        "links.cl, components.cl, multigrid.cl: heights within a mask", _surfaces, _MAPS_ONLY, "triad", 400
    ),
}

_FRAMES_SHAPE, _COUNTS, _FEW_COUNTS = (480, 640), (8, 32, 128, 512), (8, 16)
_SHAPES: tuple[Shape, ...] = ((120, 160), (240, 320), (480, 640), (1080, 1920), (2160, 3840), (3648, 5472))
_TINY: tuple[Shape, ...] = ((12, 16), (24, 32))
_PRESS = 16  # frames of a press, where pixels grow
_LARGEST = 3_000_000  # pixels of a surface
_PIXEL_ROOM = 200  # bytes of a pixel, for all maps


def run_frames(device: Device, quick: bool) -> Case:
    """Time a press, a correlation and turns of ever more frames, maps included."""
    shape, counts = (_TINY[-1], _FEW_COUNTS) if quick else (_FRAMES_SHAPE, _COUNTS)
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
    check_memory("scaling-pixels", sum(map(math.prod, shapes)) * _PIXEL_ROOM)
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
    works, largest = {name: job.work for name, job in jobs.items()}, max(job.bytes for job in jobs.values())
    rows, measured = beside_limits(works, largest, device, quick, rounds=_ROUNDS)
    return rows + [Row(name, measured[name], job.bytes, job.frames) for name, job in jobs.items()]


def _by_frame(name: str, rows: list[Row]) -> str:
    """Say what a call costs, and what each frame adds: a straight line, fitted to shares of the time."""
    counts, seconds = np.array([[row.frames, row.measured.wall.median] for row in rows]).T
    slope, fixed = np.polyfit(counts, seconds, 1, w=1 / seconds)
    off = np.max(np.abs((fixed + slope * counts) / seconds - 1))
    return f"{name}: {1e3 * fixed:.2f} ms and {1e6 * slope:.1f} us a frame, within {100 * off:.0f} %"


CASES: Cases = {
    **{name: partial(run_sweep, name, family) for name, family in FAMILIES.items()},
    "scaling-frames": run_frames,
    "scaling-pixels": run_pixels,
}
