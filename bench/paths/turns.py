"""Whole paths of an axial rotation of very many turns, from a file to a result in a file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mirrorskin import io
from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.paths import files
from mirrorskin.bench.paths.cold import measure_cold
from mirrorskin.bench.paths.equal import check_equal
from mirrorskin.bench.paths.reading import H5PY, READ, fetch, read_with_h5py, room_of
from mirrorskin.bench.paths.whole import PATH, ROUNDS, to_new_results, to_result
from mirrorskin.bench.results import Case, Row, Target
from mirrorskin.bench.turns import SCALES, STEPS, TILT, fill, phases
from mirrorskin.engine import Correlation, Correlator, NormalEstimator, Normals
from mirrorskin.engine.streaming import push_block
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.kernels.device import Device

KERNEL = f"{OURS}, kernels and maps in memory"
CACHED = f"{OURS}, kernels in memory, frames in the cache"

_BOUND = 0.7
_UNLIKE = 64  # turns, after which the frames begin again
_CACHED = 4 * STEPS  # frames that stay in the cache
_REPEATS = 16
_MAPS = 128  # bytes a pixel for all maps


@dataclass(frozen=True, slots=True)
class TurnsCase(files.FileCase):
    """Whole turns, many of them, in a file, contiguous.

    Attributes
    ----------
    wanted : {"normals", "wave"}
        What is reconstructed: normals by the exact method, as with a zenith gain, or the wave of the
        brightness, as without one.
    """

    wanted: Literal["normals", "wave"]

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        told = "exact method to normals" if self.wanted == "normals" else "mean, cosine, sine and residual"
        size = " x ".join(map(str, self.shape))
        return f"{told}, mean of {self.shape[0] // STEPS} turns, no heights; {size} uint8, contiguous"

    @property
    def options(self) -> dict[str, Any]:
        """What `reconstruct` is told."""
        offset, gain, _ = SCALES["uint8"]
        return {"gain": gain, "offset": offset} if self.wanted == "normals" else {}


def make_turns(shape: tuple[int, int, int]) -> files.Frames:
    """Return a rotation without a zenith gain and a pixel size; its turns repeat after some."""
    frames = files.in_memory(shape, np.dtype(np.uint8))
    unlike = min(shape[0], _UNLIKE * STEPS)
    fill(frames[:unlike])
    for start in range(unlike, shape[0], unlike):
        part = frames[start : start + unlike]
        part[:] = frames[: len(part)]
    return files.Frames(frames, io.Header("axial", tilt=TILT), phases(shape[0]))


def run_turns(case: TurnsCase, device: Device, quick: bool) -> Case:
    """Time the path from file to result, warm and cold, beside the limits and the kernels in memory.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory, or room for files.
    DisagreementError
        The path gave other maps than the same frames in memory.
    """
    rounds, extra = 1 if quick else ROUNDS, _MAPS * math.prod(case.shape[1:])
    check_memory(case.name, 3 * case.bytes + MEMORY_LIMIT + extra)
    with files.new_folder(case.name, case.bytes + rounds * extra) as folder:
        turns, path = make_turns(case.shape), folder / "turns.h5"
        files.record(turns, path)
        rows = _measure_warm(case, turns, path, device, rounds)
        work = partial(to_result, path, folder / "cold.h5", device, **case.options)
        cold, absent = measure_cold(path, work, device, rounds, case.shape[0], case.bytes)
    targets = () if quick else (_judge({row.name: row for row in rows}),)
    return Case(case.name, case.title, rows + cold, absent, (), targets)


def _measure_warm(case: TurnsCase, turns: files.Frames, path: Path, device: Device, rounds: int) -> list[Row]:
    """Return the rows of all works that find the file in the page cache."""
    limits, target = Limits(device, turns.block.frames), path.with_name("result.h5")
    with io.open_recording(path) as recording:
        moving: dict[str, Work] = {
            KERNEL: partial(_answer, _estimator(case, device), turns.block, 1),
            PATH: to_new_results(path, target, device, **case.options),
            READ: partial(fetch, recording, room_of(recording)),
            H5PY: partial(read_with_h5py, path, recording.dataset),
        }
        works = {**limits.works(), **moving}
        if case.wanted == "normals":
            works[CACHED] = _in_the_cache(case, turns.block, device)
        check = partial(_check, target)
        measured = take_turns(works, rounds, device.profile, check)
    rows = limits.rows(measured)
    if CACHED in measured:
        # By the device's account: of short runs, the host's clock tells what calls cost.
        kernels = replace(measured[CACHED], wall=measured[CACHED].device["kernel"])
        frames = _REPEATS * min(_CACHED, case.shape[0])
        rows.append(Row(CACHED, kernels, frames * math.prod(case.shape[1:]), frames))
    return rows + [Row(name, measured[name], case.bytes, case.shape[0]) for name in moving]


def _estimator(case: TurnsCase, device: Device) -> Correlator | NormalEstimator:
    """Return the estimator that `reconstruct` makes."""
    shape, dtype = case.shape[1:], np.uint8
    if case.wanted == "wave":
        return Correlator(shape, dtype, device=device)
    return NormalEstimator(shape, dtype, tilt=TILT, longest=STEPS, device=device, **case.options)


def _answer(estimator: Correlator | NormalEstimator, block: io.Block, times: int) -> Correlation | Normals:
    """Push a block so many times, and return the maps."""
    estimator.reset()
    for _ in range(times):
        push_block(estimator, block)
    return estimator.result()


def _in_the_cache(case: TurnsCase, block: io.Block, device: Device) -> Work:
    assert block.phase is not None
    few = replace(block, frames=block.frames[:_CACHED], phase=block.phase[:_CACHED])
    return partial(_answer, _estimator(case, device), few, _REPEATS)


def _check(saved: Path, results: dict[str, Any]) -> None:
    """Compare what came of the file, in memory and in a file, with what came of the frames in memory."""
    found = results[KERNEL]
    expected: dict[str, NDArray[Any]] = {"mean": found.mean, "residual": found.residual}
    if isinstance(found, Normals):
        expected |= {"normals": found.vectors, "normal_sigma": found.sigma, "contact": found.contact}
    else:
        expected |= {"cosine": found.cosine, "sine": found.sine}
    check_equal(PATH, expected, results[PATH].maps(), KERNEL)
    check_equal(f"{PATH}, saved", expected, io.open_result(saved).maps(), KERNEL)


def _judge(rows: dict[str, Row]) -> Target:
    """Judge the path by the limit that binds: reading the frames, or what is computed of them."""
    limits = {"read": rows["read limit"].bandwidth}
    if CACHED in rows:
        limits["arithmetic"] = rows[CACHED].bandwidth
    binds = min(limits, key=lambda name: limits[name])
    share = rows[PATH].bandwidth / limits[binds]
    known = ", ".join(f"{name} {bandwidth / 1e9:.2f} GB/s" for name, bandwidth in limits.items())
    bound = f"at least {100 * _BOUND:.0f} % of read bandwidth, or of the arithmetic limit where that is less"
    told = f"{100 * share:.0f} % of {binds} ({rows[PATH].bandwidth / 1e9:.2f} GB/s; limits: {known})"
    return Target(PATH, bound, told, share >= _BOUND)
