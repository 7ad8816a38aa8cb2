"""Whole live runs with frames from memory at their times: sustained rate and latency.

Targets: a press without loss at 1000 frames/s of 640 x 480 and 150 frames/s of 1920 x 1200; a rotation with
normals and heights of 640 x 480 at 60 updates/s, with a latency from frame to height of 15 ms (99 %: 30 ms).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mirrorskin.bench.suite.harness import Cases, Run
from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.engine import Press, Rotation
from mirrorskin.engine.live import RAISED, LiveRun, Loop, Status, Update
from mirrorskin.evaluation.base.sources import Paced
from mirrorskin.evaluation.scenes.inputs import SCALES, STEPS, TILT, fill_press, fill_turns
from mirrorskin.io import Header
from mirrorskin.kernels.device import Device

_PIXEL, _DEPTH = 0.03, 3.0  # mm
_PRESS = 256  # number of different frames of a press; each is repeated
_TURNS = 64  # frames after which a rotation repeats
_KEPT_UP = 0.99  # minimum rate, as a share of the specified frame rate
_NEAR = 1e-2  # tolerated difference of the last heights from the converged ones, as a share of the range
_UPDATES, _MEDIAN, _SLOWEST = 60, 15, 30  # updates/s, and ms from frame to height


@dataclass(frozen=True, slots=True)
class LiveCase:
    """Frames of uint8, (H, W), at a rate for some seconds; `least` is the rate to be sustained."""

    name: str
    shape: tuple[int, int]
    rate: float
    seconds: float
    least: float = 0.0

    @property
    def count(self) -> int:
        """Number of frames."""
        return round(self.rate * self.seconds)

    @property
    def size(self) -> str:
        """The frames in words."""
        rows, columns = self.shape
        return f"{columns} x {rows} uint8, {self.rate:g} frames/s for {self.seconds:g} s"


@dataclass(frozen=True, slots=True)
class Ran:
    """The outcome of a run: counts, seconds, the last update, and the load of the machine before."""

    status: Status
    seconds: float
    last: Update
    load: float


def run_press(case: LiveCase, device: Device, quick: bool) -> Case:
    """Compute heights during a press."""
    frames = np.empty((_PRESS, *case.shape), np.uint8)
    fill_press(frames)
    source = Paced(
        frames,
        lambda number: number * _PRESS // case.count,
        Header("vertical", pixel_size=(_PIXEL, _PIXEL)),
        lambda number: number * (_DEPTH / case.count),
        case.rate,
        case.count,
    )
    ran = _run(source, LiveRun(source, Press(device=device)))
    targets = () if quick else judge_press(ran, case.least)
    title = f"heights during a press; {case.size}"
    return Case(case.name, title, [], {}, _notes(ran), targets)


def run_rotation(case: LiveCase, device: Device, quick: bool) -> Case:
    """Compute normals, edges and heights during a rotation."""
    offset, gain, noise = SCALES["uint8"]
    frames = np.empty((_TURNS, *case.shape), np.uint8)
    fill_turns(frames)
    scale: dict[str, Any] = {"zenith_gain": np.asarray(gain), "zenith_offset": np.asarray(offset)}
    source = Paced(
        frames,
        lambda number: number % _TURNS,
        Header("axial", pixel_size=(_PIXEL, _PIXEL), tilt=TILT, **scale),
        lambda number: number * (math.tau / STEPS),
        case.rate,
        case.count,
    )
    noise = math.hypot(noise, 1 / math.sqrt(12))
    live_run = LiveRun(source, Rotation(window_frames=STEPS, noise=noise, device=device))
    ran = _run(source, live_run)
    best, height = live_run.result().height, ran.last.height
    assert best is not None
    assert height is not None
    off = (height - best)[np.isfinite(best)].astype(np.float64)
    span = float(np.nanmax(best) - np.nanmin(best))
    rms, largest = math.sqrt(float(np.mean(off**2))) / span, float(np.abs(off).max()) / span
    note = (
        f"the last heights differ from the converged ones by {rms:.1e} of their range, at most {largest:.1e}"
    )
    targets = () if quick else judge_rotation(ran, rms)
    title = f"normals, heights and edges during a rotation; {case.size}"
    return Case(case.name, title, [], {}, (*_notes(ran), note), targets)


def _run(source: Paced, operation: LiveRun) -> Ran:
    last: list[Update] = []

    def keep(update: Update, status: Status) -> None:
        last[:] = [update]

    operation.precompile()
    load, begun = os.getloadavg()[0], time.monotonic()
    status = Loop(source, operation, on_update=keep).run()
    return Ran(status, time.monotonic() - begun, last[0], load)


def judge_press(ran: Ran, required_rate: float) -> tuple[Target, ...]:
    """Return the targets of the sustained rate and of losses."""
    rate, lost = ran.status.used / ran.seconds, ran.status.dropped + ran.status.skipped
    bound, met = f"at least {required_rate:g} a second", rate >= _KEPT_UP * required_rate
    return (
        Target("frames that were used", bound, f"{rate:.1f} a second", met),
        Target("frames dropped or skipped", "none", f"{lost} of {ran.status.frames}", lost == 0),
    )


def judge_rotation(ran: Ran, rms: float) -> tuple[Target, ...]:
    """Return the targets of updates, their latency, and the difference from the converged heights."""
    rate, shown = ran.status.updates / ran.seconds, ran.status.latency[RAISED]
    median, p99 = 1e3 * shown.median, 1e3 * shown.p99
    what = "frame in to height out"
    return (
        Target("updates", f"at least {_UPDATES} a second", f"{rate:.1f} a second", rate >= _UPDATES),
        Target(f"{what}, median", f"at most {_MEDIAN} ms", f"{median:.1f} ms", median <= _MEDIAN),
        Target(f"{what}, 99 %", f"at most {_SLOWEST} ms", f"{p99:.1f} ms", p99 <= _SLOWEST),
        Target("heights compared with the converged ones", f"within {_NEAR:g}", f"{rms:.1e}", rms <= _NEAR),
    )


def _notes(ran: Ran) -> tuple[str, ...]:
    """Return counts, latencies and the load of the machine."""
    status = ran.status
    stages = "; ".join(
        f"{stage} {1e3 * latency.median:.2f} (99 % below {1e3 * latency.p99:.2f})"
        for stage, latency in status.latency.items()
        if math.isfinite(latency.median)
    )
    counts = (
        f"{status.frames} frames in {ran.seconds:.1f} s, {status.used} used, {status.skipped} skipped,"
        f" {status.dropped} dropped; {status.updates} updates"
    )
    return counts, f"milliseconds, median: {stages}", f"load of the machine before: {ran.load:.2f}"


def _case(case: LiveCase, run: Callable[[LiveCase, Device, bool], Case]) -> dict[str, Run]:
    short = replace(case, shape=(48, 64), rate=100.0, seconds=0.3)
    return {case.name: lambda device, quick: run(short if quick else case, device, quick)}


CASES: Cases = {
    **_case(LiveCase("live-vertical-vga", (480, 640), 1000.0, 60.0, least=1000.0), run_press),
    **_case(LiveCase("live-vertical-1920x1200", (1200, 1920), 165.0, 30.0, least=150.0), run_press),
    **_case(LiveCase("live-axial-vga", (480, 640), 66.0, 60.0), run_rotation),
}
