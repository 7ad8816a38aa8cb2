"""Correlation with a rotation's phase: the engine against the limits and against peers, on one stack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS, our_works
from mirrorskin.bench.peers.correlation import Peer, Wave, find_peers
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import check_correlation
from mirrorskin.bench.turns import STEPS, fill, phases
from mirrorskin.engine import Correlator
from mirrorskin.engine.rotation.design_matrix import basis
from mirrorskin.engine.streaming import push_block
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError

_MAPS = 4 * 4  # bytes of a pixel: mean, cosine, sine and residual
_ROOM = 128  # bytes of a pixel for what all works keep
_STATE = 4 * 4  # bytes of a pixel's sums over a window
_UNITS = 2**17  # of a cosine in a peer's sums


@dataclass(frozen=True, slots=True)
class CorrelationCase:
    """A stack of uint8 frames, several turns long.

    Attributes
    ----------
    name : str
    shape : (int, int, int)
        Frames, rows and columns.
    """

    name: str
    shape: tuple[int, int, int]

    @property
    def pixels(self) -> int:
        """Of a frame."""
        return self.shape[1] * self.shape[2]

    @property
    def size(self) -> str:
        """Of the stack, in words."""
        return f"{' x '.join(map(str, self.shape))} uint8"


def run_correlation(case: CorrelationCase, device: Device, rounds: int) -> Case:
    """Time the fit of a wave to a stack, the limits and the peers; their maps must be the same first.

    Bytes are those of the frames, each once, and of the four maps; of frames alone where those are only
    pushed.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DeviceError
        The device has no room for the stack at once.
    DisagreementError
        A peer returned other maps.
    """
    count, pixels = case.shape[0], case.pixels
    check_memory(case.name, (2 * count + _MAPS + _ROOM) * pixels)
    correlator = Correlator(case.shape[1:], np.uint8, device=device, memory_limit=2 * count * pixels)
    frames = correlator.room[:count]
    if len(frames) < count:
        raise DeviceError(f"{device.info.title} has no room for {count} frames at once: use --quick")
    fill(frames)
    phase = phases(count)
    limits = Limits(device, np.resize(frames, (count + _MAPS) * pixels))
    ours = our_works(correlator, Block(frames, 0, phase=phase))
    peers, absent = find_peers()
    theirs: dict[str, Work] = {peer.name: partial(peer.correlate, frames, phase) for peer in peers}

    def check(results: dict[str, Any]) -> None:
        for name in theirs:
            check_correlation(name, results[OURS], results[name])

    measured = take_turns({**limits.works(), **ours, **theirs}, rounds, device.profile, check)
    moved = dict.fromkeys((*ours, *theirs), (count + _MAPS) * pixels)
    moved[f"{OURS}, push only"] = count * pixels
    rows = [Row(name, measured[name], size, count) for name, size in moved.items()]
    title = f"mean, cosine, sine and residual; {case.size}"
    return Case(case.name, title, limits.rows(measured, first="triad") + rows, absent)


def run_sliding(case: CorrelationCase, device: Device, rounds: int) -> Case:
    """Time a window of one turn whose frames are pushed one by one, from memory that is not the engine's.

    A turn is a whole stack, and ends when the device is done. Bytes are, of each frame, its own, those of the
    frame that leaves, and those of the window's sums, once read and once written. The limits are those of as
    many bytes as one frame moves.

    Raises
    ------
    DisagreementError
        The wave at the end is not that of a peer's sums.
    """
    count, pixels = case.shape[0], case.pixels
    a_frame = (2 + 2 * _STATE) * pixels
    frames = np.empty(case.shape, np.uint8)
    fill(frames)
    phase = phases(count)
    correlator = Correlator(case.shape[1:], np.uint8, window=STEPS, device=device)
    peers, absent = find_peers()
    windows = {peer.name: _Window(peer, frames, phase) for peer in peers}

    def check(_: dict[str, Any]) -> None:
        for name, window in windows.items():
            check_correlation(name, correlator.result(), window.wave())

    limits = Limits(device, np.zeros(a_frame, np.uint8))
    ours = {OURS: _push_all(correlator, frames, phase)}
    works = {**limits.works(), **ours, **{name: window.push_all for name, window in windows.items()}}
    measured = take_turns(works, rounds, device.profile, check)
    rows = [Row(name, measured[name], count * a_frame, count) for name in (*ours, *windows)]
    title = f"one new frame into a window of {STEPS}; {case.size}"
    return Case(case.name, title, limits.rows(measured, first="triad") + rows, absent)


class _Window:
    """A peer's window: the last frames in a ring, and their sums."""

    def __init__(self, peer: Peer, frames: NDArray[np.uint8], phase: NDArray[np.float64]) -> None:
        self._slide, self._frames = peer.slide, frames
        self._ring = np.zeros((STEPS, *frames.shape[1:]), np.uint8)
        self._sums = np.zeros((4, *frames.shape[1:]), np.int32)
        self._phase = phase[-STEPS:]
        rows = np.rint(basis(phase) * [1, _UNITS, _UNITS])
        self._rows = np.hstack([rows, np.roll(rows, STEPS, axis=0)]).astype(np.int32)

    def push_all(self) -> None:
        """Push a whole stack."""
        for number, (frame, row) in enumerate(zip(self._frames, self._rows, strict=True)):
            gone = self._ring[number % STEPS]
            self._slide(self._sums, frame, gone, row)
            gone[:] = frame

    def wave(self) -> Wave:
        """Return the fit that the sums tell."""
        total, cosine, sine, square = self._sums.astype(np.float64)
        model, rounded = basis(self._phase), self._rows[-STEPS:, :3] / [1, _UNITS, _UNITS]
        sums = np.stack([total, cosine / _UNITS, sine / _UNITS])
        wave = np.tensordot(np.linalg.inv(rounded.T @ model), sums, 1)
        told = np.sum(wave * np.tensordot(model.T @ model, wave, 1), axis=0)
        left = np.maximum(square - told, 0)
        return Wave(*np.stack([*wave, np.sqrt(left / (STEPS - 3))]).astype(np.float32))


def _push_all(
    correlator: Correlator, frames: NDArray[np.uint8], phase: NDArray[np.float64]
) -> Callable[[], None]:
    blocks = [Block(frames[k : k + 1], k, phase=phase[k : k + 1]) for k in range(len(frames))]

    def work() -> None:
        for block in blocks:
            push_block(correlator, block)
        correlator.device.finish()

    return work
