"""The onset of the light state: the engine against the limits and against peers, on one stack in memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS, our_works
from mirrorskin.bench.peers.onset import Peer, References, find_peers
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import check_frames, check_heights
from mirrorskin.bench.stacks import LEVELS, StackName, fill, noise_of, references
from mirrorskin.engine import OnsetSearch
from mirrorskin.engine.frames import estimate_noise, reference_maps, thin_out
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.kernels.onset import onset_levels

_THRESHOLD = 0.5
_MAPS = 64  # bytes a pixel for all maps
_LARGE = 10**9  # bytes of frames from which no peer may take as much again


@dataclass(frozen=True, slots=True)
class OnsetCase:
    """A stack and what is asked of it.

    Attributes
    ----------
    name : str
    shape : (int, int, int)
        Frames, rows and columns.
    dtype : dtype
    full : bool
        The full default: references of each pixel, hold 2, sub-frame; heights, sigma and status are
        compared. Else one threshold for all pixels, and the numbers of the frames (equation 4).
    hold : int
    stack : {"press", "random"}
    """

    name: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    full: bool
    hold: int
    stack: StackName

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        what = "full default" if self.full else f"frame of the onset, one threshold, hold {self.hold}"
        return f"{what}; {' x '.join(map(str, self.shape))} {self.dtype.name}, {self.stack}"

    @property
    def bytes(self) -> int:
        """Of the frames."""
        return int(np.prod(self.shape)) * self.dtype.itemsize

    def options(self) -> dict[str, Any]:
        """Return what `OnsetSearch` is told."""
        if self.full:
            dark, bright = references(self.shape[1:], self.dtype)
            return {"dark": dark, "bright": bright}
        low, high = LEVELS[self.dtype.name]
        noise = noise_of(self.dtype)
        return {"dark": low, "bright": high, "hold": self.hold, "subframe": False, "noise": noise}

    def known(self) -> References:
        """Return what peers are told: the same, prepared in the same way."""
        shape = self.shape[1:] if self.full else ()
        options = self.options()
        dark, bright = reference_maps(options["dark"], options["bright"], shape, self.dtype)  # type: ignore[arg-type]
        level, plateau, light = onset_levels(bright, dark, _THRESHOLD, self.dtype)
        return References(np.asarray(level), np.asarray(light), plateau)


def run_onset(case: OnsetCase, device: Device, rounds: int) -> Case:
    """Time the onset, the limits and the peers on one stack; their maps must be the same first.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory.
    DeviceError
        The device has no room for the stack at once.
    DisagreementError
        A peer returned other maps.
    """
    check_memory(case.name, 2 * case.bytes + _MAPS * case.shape[1] * case.shape[2])
    search = OnsetSearch(
        case.shape[1:], case.dtype, **case.options(), device=device, memory_limit=2 * case.bytes
    )
    frames = search.room[: case.shape[0]]
    if len(frames) < case.shape[0]:
        raise DeviceError(f"{device.info.title} has no room for {case.shape[0]} frames at once: use --quick")
    fill(frames, case.stack)
    travel = np.arange(len(frames), dtype=np.float64) * 0.05
    limits = Limits(device, frames)
    ours = our_works(search, Block(frames, 0, travel=travel))
    theirs, absent = _peer_works(case, frames, travel)

    def check(results: dict[str, Any]) -> None:
        for name in theirs:
            (check_heights if case.full else check_frames)(name, results[OURS], results[name])

    works = {**limits.works(), **ours, **theirs}
    measured = take_turns(works, rounds, device.profile, check)
    rows = [Row(name, measured[name], case.bytes, len(frames)) for name in (*ours, *theirs)]
    return Case(case.name, case.title, limits.rows(measured) + rows, absent)


def _peer_works(
    case: OnsetCase, frames: NDArray[Any], travel: NDArray[np.float64]
) -> tuple[dict[str, Work], dict[str, str]]:
    peers, absent = find_peers()
    known = case.known()

    def heights(peer: Peer) -> object:
        assert peer.heights is not None
        noise = estimate_noise(thin_out(frames[0]), thin_out(frames[1]), case.dtype.kind == "u")
        return peer.heights(frames, travel, known, noise)

    works: dict[str, Work] = {}
    for peer in peers:
        if peer.whole_stack and case.bytes >= _LARGE:
            absent[peer.name] = "takes as much memory again"
        elif not case.full:
            works[peer.name] = partial(peer.first_light, frames, known.light, case.hold)
        elif peer.heights is not None:
            works[peer.name] = partial(heights, peer)
    return works, absent
