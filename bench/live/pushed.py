"""Frames as a camera brings them: one a push, from memory that is not the engine's."""

from __future__ import annotations

from typing import Any

import numpy as np

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.onset import OnsetCase
from mirrorskin.bench.peers.onset.numpy_ import PEER, first_light, heights
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import check_frames, check_heights
from mirrorskin.bench.stacks import fill
from mirrorskin.engine import OnsetSearch
from mirrorskin.engine.streaming import push_block
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device


def run_live(cases: dict[str, OnsetCase], device: Device, rounds: int) -> Case:
    """Time whole presses whose frames are pushed one by one, the limits on one frame beside them.

    A turn begins with a reset and ends when the device is done; its frame rate is that of the mean frame.

    Parameters
    ----------
    cases : dict of OnsetCase
        What is asked, by the name of its row; all of one shape, type and stack.
    device : Device
    rounds : int

    Raises
    ------
    DisagreementError
        The maps at the end are not those of NumPy.
    """
    case = next(iter(cases.values()))
    frames = np.empty(case.shape, case.dtype)
    fill(frames, case.stack)
    travel = np.arange(len(frames), dtype=np.float64) * 0.05
    blocks = [Block(frames[t : t + 1], t, travel=travel[t : t + 1]) for t in range(len(frames))]
    searches = {
        name: OnsetSearch(case.shape[1:], case.dtype, **asked.options(), device=device)
        for name, asked in cases.items()
    }

    def check(_: dict[str, Any]) -> None:
        for name, asked in cases.items():
            found = searches[name].result()
            if asked.full:
                check_heights(PEER.name, found, heights(frames, travel, asked.known(), found.noise))
            else:
                check_frames(PEER.name, found, first_light(frames, asked.known().light, asked.hold))

    limits = Limits(device, frames[0])
    works = limits.works() | {name: _press(search, blocks) for name, search in searches.items()}
    measured = take_turns(works, rounds, device.profile, check)
    rows = [Row(name, measured[name], case.bytes, len(frames)) for name in cases]
    title = f"one frame a push; {' x '.join(map(str, case.shape))} {case.dtype.name}, {case.stack}"
    return Case(case.name, title, limits.rows(measured) + rows, {})


def _press(search: OnsetSearch, blocks: list[Block]) -> Work:
    def press() -> None:
        search.reset()
        for block in blocks:
            push_block(search, block)
        search.device.finish()

    return press
