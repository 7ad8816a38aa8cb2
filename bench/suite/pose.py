"""The motion of an object along a stream of results."""

from __future__ import annotations

import math
import time

import numpy as np

from mirrorskin.bench.suite.harness import Cases
from mirrorskin.cli.commands.bench.limits import time_works
from mirrorskin.cli.commands.bench.records import Case, Target
from mirrorskin.cli.commands.bench.scenes import wavy_dome
from mirrorskin.cli.commands.bench.timing import OURS, Work
from mirrorskin.engine.pose import Pose, PoseTracker
from mirrorskin.kernels.device import Device

_SHAPE, _QUICK = (240, 320), (60, 80)
_FRAMES = 24  # number of frames along a circle that ends at its start
_REACH, _TURN = 0.4, 0.2  # amplitudes of position and angle, mm and rad
_BYTES = 32  # bytes of the record of a pixel
_RATE = 200.0  # target, results per second


def run_track(device: Device, quick: bool) -> Case:
    """Time a tracker along a closed path: from results to the motion since the first result.

    The bytes of the records of both compared maps are counted once.
    """
    shape = _QUICK if quick else _SHAPE
    angles = 2 * math.pi * np.arange(_FRAMES + 1) / _FRAMES
    path = [(_REACH * math.sin(a), _REACH * (1 - math.cos(a)), _TURN * math.sin(a)) for a in angles]
    results = [wavy_dome(shape, *place, seed) for seed, place in enumerate(path)]
    seconds: list[float] = []

    def follow() -> Pose:
        tracker = PoseTracker(device=device)
        for result in results:
            start = time.perf_counter()
            pose = tracker.push(result)
            seconds.append(time.perf_counter() - start)
        return pose

    last = follow()
    seconds.clear()
    moved = 2 * _BYTES * math.prod(shape)
    works = {OURS: Work(follow, len(results) * moved, len(results))}
    rows = time_works(works, moved, device, quick, first="triad")
    lower, middle, upper = np.percentile(seconds, [25, 50, 75])
    drift = math.degrees(float(np.linalg.norm(last.rotation)))
    notes = (
        f"a result: median {1e3 * middle:.2f} ms, quartiles {1e3 * lower:.2f}-{1e3 * upper:.2f}",
        f"back at the start after {_FRAMES} results: off by {drift:.4f} degrees and"
        f" {1e3 * float(np.linalg.norm(last.translation)):.2f} micrometres",
    )
    met = bool(1 / middle >= _RATE)
    target = Target(OURS, f"at least {_RATE:.0f} results a second", f"{1 / middle:.0f}", met)
    title = f"motion along results of {' x '.join(map(str, shape))}: heights, normals and their sigmas"
    absent = {"NormalFlow": "not available as a package"}
    return Case("pose-track", title, list(rows.values()), absent, notes, () if quick else (target,))


CASES: Cases = {"pose-track": run_track}
