"""Whole live runs: what rate is kept up, with how many losses and how late."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench import stacks, turns
from mirrorskin.bench.live.paced import Paced
from mirrorskin.bench.results import Case, Target
from mirrorskin.engine.live import (
    SHOWN,
    LiveEstimator,
    LivePress,
    LiveRotation,
    Status,
    Update,
    run,
)
from mirrorskin.io import Header
from mirrorskin.kernels.device import Device

_PIXEL = 0.03  # mm
_PRESS = 256  # frames that a press is made of; each is shown for as long as it takes
_TURNS = 64  # frames after which a rotation begins again
_DEPTH = 3.0  # mm
_KEPT_UP = 0.99  # share of the frames that were to come, that have
_NEAR = 1e-2  # of the range, by which the last heights may differ from those that fit best


@dataclass(frozen=True, slots=True)
class LiveCase:
    """Frames of uint8 that come from memory.

    Attributes
    ----------
    name : str
    shape : (int, int)
        Rows and columns.
    rate : float
        Frames a second that come.
    seconds : float
        For how long.
    least : float
        Frames a second that must be kept up with.
    """

    name: str
    shape: tuple[int, int]
    rate: float
    seconds: float
    least: float = 0.0

    @property
    def count(self) -> int:
        """Frames."""
        return round(self.rate * self.seconds)

    @property
    def size(self) -> str:
        """What comes, in words."""
        rows, columns = self.shape
        return f"{columns} x {rows} uint8, {self.rate:g} frames/s for {self.seconds:g} s"


@dataclass(frozen=True, slots=True)
class _Ran:
    """What came of a run."""

    status: Status
    seconds: float
    last: Update
    load: float


def run_press(case: LiveCase, device: Device, quick: bool) -> Case:
    """Let a press go on while heights are told."""
    frames = np.empty((_PRESS, *case.shape), np.uint8)
    stacks.fill(frames, "press")
    source = Paced(
        frames,
        lambda number: number * _PRESS // case.count,
        Header("vertical", pixel_size=(_PIXEL, _PIXEL)),
        lambda number: number * (_DEPTH / case.count),
        case.rate,
        case.count,
    )
    ran = _run(source, LivePress(source, device=device))
    targets = () if quick else (_judge_rate(ran, case.least), _judge_losses(ran))
    return Case(case.name, f"heights of a press while it goes on; {case.size}", [], {}, _notes(ran), targets)


def run_rotation(case: LiveCase, device: Device, quick: bool) -> Case:
    """Let a body go round while normals, edges and heights are told."""
    offset, gain, noise = turns.SCALES["uint8"]
    frames = np.empty((_TURNS, *case.shape), np.uint8)
    turns.fill(frames)
    source = Paced(
        frames,
        lambda number: number % _TURNS,
        Header(
            "axial",
            pixel_size=(_PIXEL, _PIXEL),
            tilt=turns.TILT,
            zenith_gain=np.asarray(gain),
            zenith_offset=np.asarray(offset),
        ),
        lambda number: number * (math.tau / turns.STEPS),
        case.rate,
        case.count,
    )
    known = math.hypot(noise, 1 / math.sqrt(12))
    estimator = LiveRotation(source, window=turns.STEPS, noise=known, device=device)
    drawn: set[int] = set()
    ran = _run(source, estimator, drawn)
    rms, most = _miss(ran.last, estimator)
    heights = f"the last heights miss those that fit best by {rms:.1e} of their range, at most {most:.1e}"
    notes = (*_notes(ran), heights, f"edges were drawn {len(drawn) / ran.seconds:.1f} times a second")
    targets = () if quick else _judge_rotation(ran, rms)
    title = f"normals, heights and edges of a rotation while it goes on; {case.size}"
    return Case(case.name, title, [], {}, notes, targets)


def _run(source: Paced, estimator: LiveEstimator, drawn: set[int] | None = None) -> _Ran:
    """Run, and keep the last update, and after how many updates edges were new."""
    last: list[Update] = []

    def keep(update: Update, status: Status) -> None:
        if drawn is not None and update.edges is not None and update.edges is not last[0].edges:
            drawn.add(status.updates)
        last[:] = [update]

    estimator.warm()
    load, begun = os.getloadavg()[0], time.monotonic()
    status = run(source, estimator, on_update=keep)
    return _Ran(status, time.monotonic() - begun, last[0], load)


def _miss(update: Update, estimator: LiveRotation) -> tuple[float, float]:
    """Return by how much heights miss those that fit best, root mean square and at most, of the range."""
    best = estimator.result().height
    assert best is not None
    assert update.height is not None
    off = np.abs(update.height - best)[np.isfinite(best)]
    span = float(np.nanmax(best) - np.nanmin(best))
    return _rms(off) / span, float(off.max()) / span


def _rms(values: NDArray[np.float32]) -> float:
    return math.sqrt(float(np.mean(np.square(values, dtype=np.float64))))


def _judge_rate(ran: _Ran, least: float) -> Target:
    rate = ran.status.used / ran.seconds
    met = rate >= _KEPT_UP * least
    return Target("frames that were used", f"at least {least:g} a second", f"{rate:.1f} a second", met)


def _judge_losses(ran: _Ran) -> Target:
    lost = ran.status.dropped + ran.status.skipped
    return Target("frames dropped or skipped", "none", f"{lost} of {ran.status.frames}", lost == 0)


def _judge_rotation(ran: _Ran, rms: float) -> tuple[Target, ...]:
    rate, shown = ran.status.updates / ran.seconds, ran.status.latency[SHOWN]
    median, p99 = 1e3 * shown.median, 1e3 * shown.p99
    return (
        Target("updates", "at least 60 a second", f"{rate:.1f} a second", rate >= 60),
        Target("frame in to height out, median", "at most 15 ms", f"{median:.1f} ms", median <= 15),
        Target("frame in to height out, 99 %", "at most 30 ms", f"{p99:.1f} ms", p99 <= 30),
        Target("heights beside those that fit best", f"within {_NEAR:g}", f"{rms:.1e}", rms <= _NEAR),
    )


def _notes(ran: _Ran) -> tuple[str, ...]:
    """Say how it went, and what else the machine was doing."""
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
