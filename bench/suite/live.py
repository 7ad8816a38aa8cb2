"""Live runs of `mirrorskin bench live`, with targets: sustained rate, latency, and processor time.

Targets: a press without loss at 1000 frames/s of 640 x 480 and 150 frames/s of 1920 x 1200; a rotation with
normals and heights of 640 x 480 at 60 updates/s, with a latency from frame to height of 15 ms (99 %: 30 ms);
trackers of 320 x 240 at 1000 frames/s, pose and slip together with a latency of 3 ms (99 %).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from mirrorskin.bench.suite.harness import Cases, Run
from mirrorskin.cli.commands.bench.live_runs import Ran, measure_live
from mirrorskin.cli.commands.bench.records import Case, LiveRow, Target, as_ms
from mirrorskin.engine.live import RAISED
from mirrorskin.kernels.device import Device

Shape = tuple[int, int]
Judge = Callable[[LiveRow, Ran], tuple[Target, ...]]

_VGA, _HALF = (480, 640), (240, 320)
_QUICK = (60, 80), 100.0, 0.3  # rows and columns, frames/s, s
_KEPT_UP = 0.99  # minimum rate, as a share of the specified frame rate
_NEAR = 1e-2  # tolerated difference of the last heights from the converged ones, as a share of the range
_AROUND = 5, 5  # pixels with heights around one that is compared: single ones have any offset
_UPDATES, _MEDIAN, _SLOWEST = 60, 15, 30  # updates/s, and ms from frame to height
_LATENCY = 3.0  # ms, 99 % of the frames, of pose and slip together
_PROCESSOR = {"press": 1.0, "turn": 4.0, "pose": 0.7, "slip": 0.8, "force": 1.0}  # ms a frame


def judge_press(least: float, row: LiveRow, ran: Ran) -> tuple[Target, ...]:
    """Return the targets of the sustained rate and of losses."""
    rate = (row.frames - row.lost) / row.seconds
    met = rate >= _KEPT_UP * least
    return (
        Target("frames that were used", f"at least {least:g} a second", f"{rate:.1f} a second", met),
        Target("frames lost", "none", f"{row.lost} of {row.frames}", row.lost == 0),
    )


def _judge_vga(row: LiveRow, ran: Ran) -> tuple[Target, ...]:
    return (*judge_press(1000.0, row, ran), *judge_cost(row, ran))


def judge_rotation(row: LiveRow, ran: Ran) -> tuple[Target, ...]:
    """Return the targets of updates, their latency, and the difference from the converged heights."""
    assert ran.status is not None
    assert ran.last is not None
    rate, shown = row.updates / row.seconds, ran.status.latency[RAISED]
    median, p99 = 1e3 * shown.median, 1e3 * shown.p99
    best, height = ran.result.height, ran.last.height
    known = np.isfinite(best) & np.isfinite(height)
    known = cv2.erode(known.astype(np.uint8), np.ones(_AROUND, np.uint8)) > 0
    off = (height - best)[known].astype(np.float64)
    rms = math.sqrt(float(np.mean(off**2))) / float(np.ptp(best[known]))
    what = "frame in to height out"
    return (
        Target("updates", f"at least {_UPDATES} a second", f"{rate:.1f} a second", rate >= _UPDATES),
        Target(f"{what}, median", f"at most {_MEDIAN} ms", f"{median:.1f} ms", median <= _MEDIAN),
        Target(f"{what}, 99 %", f"at most {_SLOWEST} ms", f"{p99:.1f} ms", p99 <= _SLOWEST),
        Target("heights compared with the converged ones", f"within {_NEAR:g}", f"{rms:.1e}", rms <= _NEAR),
        *judge_cost(row, ran),
    )


def judge_cost(row: LiveRow, ran: Ran) -> tuple[Target, ...]:
    """Return the target of the processor time of a frame."""
    limit = _PROCESSOR[row.name]
    met = row.processor <= 1e-3 * limit
    return (Target("processor time of a frame", f"at most {limit:g} ms", f"{as_ms(row.processor)} ms", met),)


def judge_latency(row: LiveRow, ran: Ran) -> tuple[Target, ...]:
    """Return the targets of latency and losses."""
    late = 1e3 * row.latency["99"]
    return (
        Target("latency, 99 %", f"at most {_LATENCY:g} ms", f"{late:.2f} ms", late <= _LATENCY),
        Target("frames lost", "none", f"{row.lost} of {row.frames}", row.lost == 0),
    )


def _run(
    name: str, of: str, shape: Shape, rate: float, seconds: float, judge: Judge, device: Device, quick: bool
) -> Case:
    if quick:
        shape, rate, seconds = _QUICK
    load = os.getloadavg()[0]
    row, ran = measure_live(of, shape, rate, seconds, device)
    notes = [f"load of the machine before: {load:.2f}"]
    if ran.status is not None:
        notes += [
            f"{stage}: median {as_ms(latency.median)} ms, 99 % below {as_ms(latency.p99)} ms"
            for stage, latency in ran.status.latency.items()
            if math.isfinite(latency.median)
        ]
    title = f"{of} of {row.size}, {rate:g} frames a second for {seconds:g} s"
    targets = () if quick else judge(row, ran)
    return Case(name, title, notes=tuple(notes), targets=targets, live=(row,))


def _case(name: str, of: str, shape: Shape, rate: float, seconds: float, judge: Judge) -> dict[str, Run]:
    return {name: partial(_run, name, of, shape, rate, seconds, judge)}


CASES: Cases = {
    **_case("live-vertical-vga", "press", _VGA, 1000.0, 60.0, _judge_vga),
    **_case("live-vertical-1920x1200", "press", (1200, 1920), 165.0, 30.0, partial(judge_press, 150.0)),
    **_case("live-axial-vga", "turn", _VGA, 66.0, 60.0, judge_rotation),
    **_case("live-pose", "pose", _HALF, 1000.0, 10.0, judge_cost),
    **_case("live-slip", "slip", _HALF, 1000.0, 10.0, judge_cost),
    **_case("live-force", "force", _HALF, 1000.0, 10.0, judge_cost),
    **_case("live-pose-and-slip", "pose+slip", _HALF, 1000.0, 10.0, judge_latency),
}
