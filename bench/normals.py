"""Normals from one turn of axial rotation: the engine against the limits and against peers, on one stack."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Measured, Work, take_turns
from mirrorskin.bench.limits import Arithmetic, Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS, our_works
from mirrorskin.bench.peers.normals import Turn, find_peers
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import check_normals
from mirrorskin.bench.turns import SCALES, STEPS, TILT, fill, noise_of, phases
from mirrorskin.engine import NormalEstimator
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device

CACHED = f"{OURS}, in the cache"

_MAPS = 3 * 4 + 4 + 1 + 4  # bytes of a pixel: normal, sigma, contact and mean
_ROOM = 160  # bytes of a pixel for what all works keep
_SMALL = (256, 1024)  # rows and columns of a stack that stays in the cache, and is no trifle to launch


@dataclass(frozen=True, slots=True)
class NormalsCase:
    """A turn's frames.

    Attributes
    ----------
    name : str
    shape : (int, int)
        Rows and columns.
    dtype : dtype
    """

    name: str
    shape: tuple[int, int]
    dtype: np.dtype[Any]

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        shape = " x ".join(map(str, (STEPS, *self.shape)))
        return f"exact method to normals, sigma, contact and mean; {shape} {self.dtype.name}"

    @property
    def pixels(self) -> int:
        """Of a frame."""
        return self.shape[0] * self.shape[1]

    @property
    def bytes(self) -> int:
        """Of the frames, each once, and of the maps that are asked for."""
        return self.pixels * (STEPS * self.dtype.itemsize + _MAPS)

    @property
    def turn(self) -> Turn:
        """What is known before the frames are looked at."""
        offset, gain, _ = SCALES[self.dtype.name]
        low, high = (0.0, float(np.iinfo(self.dtype).max)) if self.dtype.kind == "u" else (-np.inf, np.inf)
        return Turn(phases(STEPS), TILT, offset, gain, noise_of(self.dtype), low, high)


def run_normals(case: NormalsCase, device: Device, rounds: int) -> Case:
    """Time normals, the limits and the peers on one stack; their maps must be the same first.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DisagreementError
        A peer returned other maps.
    """
    check_memory(case.name, 3 * case.bytes + _ROOM * case.pixels)
    frames, ours = _prepare(case, device)
    small = replace(case, shape=(min(case.shape[0], _SMALL[0]), min(case.shape[1], _SMALL[1])))
    repeats = -(-case.pixels // small.pixels)
    cached = partial(_repeat, _kernel_alone(small, device), repeats)
    limits = Limits(device, np.resize(frames.view(np.uint8), case.bytes))
    arithmetic = Arithmetic(device, case.pixels)
    peers, absent = find_peers()
    theirs: dict[str, Work] = {peer.name: partial(peer.normals, frames, case.turn) for peer in peers}

    def check(results: dict[str, Any]) -> None:
        for name in theirs:
            check_normals(name, results[OURS], results[name], frames, case.turn)

    works: dict[str, Work] = {**limits.works(), **arithmetic.works(), CACHED: cached, OURS: ours, **theirs}
    measured = take_turns(works, rounds, device.profile, check)
    rows = [*limits.rows(measured, first="triad"), arithmetic.row(measured)]
    inside = Row(CACHED, _kernels_of(measured[CACHED]), repeats * small.bytes, repeats * STEPS)
    rows += [inside, *(Row(name, measured[name], case.bytes, STEPS) for name in (OURS, *theirs))]
    return Case(case.name, case.title, rows, absent, _notes(case, {row.name: row for row in rows}))


def _prepare(case: NormalsCase, device: Device) -> tuple[NDArray[Any], Work]:
    """Return a stack in the estimator's room, and the work that answers it."""
    estimator = _estimator(case, device)
    frames = estimator.room[:STEPS]
    fill(frames)
    return frames, our_works(estimator, Block(frames, 0, phase=case.turn.phase))[OURS]


def _kernel_alone(case: NormalsCase, device: Device) -> Work:
    """Return a work whose maps stay where they are: a turn that is over, because the next one begins."""
    estimator = _estimator(case, device)
    frames = estimator.room[: STEPS + 1]
    fill(frames[:STEPS])
    frames[STEPS] = frames[0]
    block = Block(frames, 0, phase=np.append(case.turn.phase, case.turn.phase[0] + 2 * np.pi))
    return our_works(estimator, block)[f"{OURS}, push only"]


def _estimator(case: NormalsCase, device: Device) -> NormalEstimator:
    turn = case.turn
    return NormalEstimator(
        case.shape,
        case.dtype,
        tilt=turn.tilt,
        gain=turn.gain,
        offset=turn.offset,
        noise=turn.noise,
        longest=STEPS,
        device=device,
        memory_limit=0,
    )


def _repeat(work: Work, times: int) -> None:
    for _ in range(times):
        work()


def _kernels_of(measured: Measured) -> Measured:
    """Return the device's account of kernels alone: of short runs, the host's clock tells what calls cost."""
    return replace(measured, wall=measured.device["kernel"])


def _notes(case: NormalsCase, rows: dict[str, Row]) -> tuple[str, ...]:
    """Say which limit binds."""
    a_pixel = case.bytes / case.pixels
    memory, arithmetic, ours = (
        rows[name].kernel_bandwidth / a_pixel for name in ("triad limit", CACHED, OURS)
    )
    least, binds = min((memory, "memory"), (arithmetic, "arithmetic"))
    rate = rows["multiply-add limit"].operations / rows["multiply-add limit"].measured.kernel
    return (
        f"{a_pixel:.0f} bytes a pixel: memory (triad) would do {memory / 1e6:.0f} Mpixel/s, "
        f"arithmetic (the same kernel on a stack in the cache) {arithmetic / 1e6:.0f}",
        f"{binds} binds: the kernel reaches {100 * ours / least:.0f} % of that limit",
        f"at most {rate / 1e9:.0f} G multiply-adds/s: {rate / arithmetic:.0f} in a pixel's time in the cache",
    )
