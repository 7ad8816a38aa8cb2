"""Trackers with inputs from memory at their times: pose, slip and force of each frame.

Processor time is that of frames one after the other. Then they come at a pace: a frame that is due while an
earlier one is computed is lost, unless it is the newest. Latency is the time from when a frame was due to its
result.
"""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.suite.harness import Cases
from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.engine.force import ForceTracker
from mirrorskin.engine.pose import PoseTracker
from mirrorskin.engine.slip import SlipTracker
from mirrorskin.evaluation.scenes.inputs import wavy_dome
from mirrorskin.io import Result, pixel_axes
from mirrorskin.kernels.device import Device

_SHAPES = (120, 160), (240, 320), (480, 640)
_JUDGED, _QUICK = (240, 320), (60, 80)
_FRAMES = 24  # different frames, along a circle
_RATE, _SECONDS = 1000.0, 10.0
_ROUNDS = 20  # of all frames, for the processor time
_STEP, _TURN = 0.01, math.radians(0.3)  # of a frame to the next, mm and rad
_SLIDE = 0.2  # radius of the circle of a texture, pixels
_FIELD, _WAIT = 8.0, 2e-4  # width of a picture, mm; seconds before a frame in which nothing sleeps
_LATENCY = 3.0  # ms, 99 % of the frames
_PROCESSOR = {"pose": 0.7, "slip": 0.8, "force": 1.0}  # ms of processor time a frame

Push = Callable[[Any], object]


class Paced(NamedTuple):
    """What a run took: seconds of each result."""

    processor: list[float]  # one after the other
    latency: list[float]  # at a pace
    lost: int
    rate: float

    def describe(self, what: str) -> str:
        """Return the numbers in words."""
        cost, delay = (1e3 * np.array(values) for values in (self.processor, self.latency))
        return (
            f"{what}: processor time {np.median(cost):.2f} ms a frame (fastest tenth"
            f" {np.percentile(cost, 10):.2f} ms); {self.rate:.0f} results a second, {self.lost} of"
            f" {self.lost + len(delay)} frames lost; latency {np.median(delay):.2f} ms, 99 % below"
            f" {np.percentile(delay, 99):.2f} ms"
        )


def run_paced(push: Push, inputs: Sequence[Any], rate: float, seconds: float, rounds: int) -> Paced:
    """Push inputs, again and again, when they are due; the newest one if several are."""
    for frame in inputs:
        push(frame)
    processor, latency = [], []
    for _ in range(rounds):
        for frame in inputs:
            started = time.process_time()
            push(frame)
            processor.append(time.process_time() - started)
    number, lost, count = 0, 0, round(rate * seconds)
    begun = time.perf_counter()
    while number < count:
        early = begun + number / rate - time.perf_counter()
        if early > _WAIT:
            time.sleep(early - _WAIT)
            continue
        if early > 0:
            continue
        newest = min(number + int(-early * rate), count - 1)
        lost, number = lost + newest - number, newest
        push(inputs[number % len(inputs)])
        latency.append(time.perf_counter() - begun - number / rate)
        number += 1
    return Paced(processor, latency, lost, len(latency) / (time.perf_counter() - begun))


def _places() -> NDArray[np.float64]:
    """Return the angles of a circle's points."""
    return 2 * math.pi * np.arange(_FRAMES) / _FRAMES


def _pose(shape: tuple[int, int], device: Device) -> tuple[Push, Sequence[Any]]:
    radius = _STEP * _FRAMES / (2 * math.pi)
    turn = _TURN * _FRAMES / (2 * math.pi)
    results = [
        wavy_dome(shape, radius * math.sin(a), radius * (1 - math.cos(a)), turn * math.sin(a), seed)
        for seed, a in enumerate(_places())
    ]
    return PoseTracker(device=device).push, results


def _slip(shape: tuple[int, int], device: Device) -> tuple[Push, Sequence[Any]]:
    rng, (rows, columns) = np.random.default_rng(1), shape
    texture = cv2.GaussianBlur(rng.normal(100, 90, shape).astype(np.float32), (0, 0), 1.5)
    frames = []
    for a in _places():
        shift = np.array([[1, 0, _SLIDE * math.sin(a)], [0, 1, _SLIDE * (1 - math.cos(a))]])
        moved = cv2.warpAffine(
            texture, shift, (columns, rows), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
        )
        frames.append(np.clip(np.rint(moved + rng.normal(0, 1, shape)), 0, 255).astype(np.uint8))
    y, x = np.indices(shape)
    contact = np.hypot(x - columns / 2, y - rows / 2) < 0.4 * rows
    return SlipTracker(contact, _FIELD / columns, device=device).push, frames


def _force(shape: tuple[int, int], device: Device) -> tuple[Push, Sequence[Any]]:
    rng = np.random.default_rng(2)
    x, y = pixel_axes(shape, (_FIELD / shape[1], _FIELD / shape[1]))
    sigma = np.full(shape, 1e-3, np.float32)
    results = []
    for a in _places():
        away = (x - 0.05 * math.sin(a)) ** 2 + (y[:, np.newaxis] - 0.05 * math.cos(a)) ** 2
        height = (-away / 10 + rng.normal(0, 1e-3, shape)).astype(np.float32)
        moved = np.broadcast_to(np.array([0.05 * math.sin(a), 0.0], np.float32), (*shape, 2))
        results.append(
            Result(
                height=height,
                height_sigma=sigma,
                displacement=moved,
                displacement_sigma=np.full((*shape, 2), 1e-3, np.float32),
                x=x,
                y=y,
            )
        )
    push = ForceTracker(modulus=0.1).push
    return lambda result: push(result, 0.3), results


_TRACKERS = {"pose": _pose, "slip": _slip, "force": _force}


def _run(push: Push, inputs: Sequence[Any], quick: bool) -> Paced:
    return run_paced(push, inputs, _RATE, 0.05 if quick else _SECONDS, 1 if quick else _ROUNDS)


def run_tracker(name: str, device: Device, quick: bool) -> Case:
    """Run a tracker at all sizes."""
    notes, targets = [f"load of the machine before: {os.getloadavg()[0]:.2f}"], []
    for shape in (_QUICK,) if quick else _SHAPES:
        paced = _run(*_TRACKERS[name](shape, device), quick)
        notes.append(paced.describe(" x ".join(map(str, shape))))
        if shape == _JUDGED:
            cost, limit = 1e3 * float(np.median(paced.processor)), _PROCESSOR[name]
            bound = f"at most {limit:g} ms"
            targets.append(Target("processor time of a frame", bound, f"{cost:.2f} ms", cost <= limit))
    title = f"{name} of frames at {_RATE:.0f} a second, from memory"
    return Case(f"live-{name}", title, notes=tuple(notes), targets=tuple(targets))


def run_both(device: Device, quick: bool) -> Case:
    """Run pose and slip, one after the other for each frame."""
    shape = _QUICK if quick else _JUDGED
    (pose, results), (slip, frames) = _pose(shape, device), _slip(shape, device)

    def push(pair: tuple[Any, Any]) -> None:
        pose(pair[0])
        slip(pair[1])

    pairs = list(zip(results, frames, strict=True))
    paced = _run(push, pairs, quick)
    late = 1e3 * float(np.percentile(paced.latency, 99))
    targets = (
        Target("latency, 99 %", f"at most {_LATENCY:g} ms", f"{late:.2f} ms", late <= _LATENCY),
        Target("frames lost", "none", f"{paced.lost}", paced.lost == 0),
    )
    title = f"pose and slip of the same frames at {_RATE:.0f} a second, from memory"
    note = paced.describe(" x ".join(map(str, shape)))
    return Case("live-pose-and-slip", title, notes=(note,), targets=() if quick else targets)


CASES: Cases = {
    **{f"live-{name}": functools.partial(run_tracker, name) for name in _TRACKERS},
    "live-pose-and-slip": run_both,
}
