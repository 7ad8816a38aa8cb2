"""The one loop: from a source of frames into an estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from numpy.typing import NDArray

from mirrorskin.io import Block, Source
from mirrorskin.kernels.device import Device

Progress = Callable[[int], None]


class Estimator(Protocol):
    """What the loop feeds: it takes in blocks, and offers room to read them into."""

    @property
    def device(self) -> Device:
        """Where it works."""

    @property
    def room(self) -> NDArray[Any]:
        """Where the next frames may be written, (n, H, W)."""

    def push(self, block: Block) -> None:
        """Take in the next frames."""


def feed(source: Source, estimator: Estimator, frames: range, progress: Progress | None = None) -> None:
    """Push frames of a source into an estimator.

    A device that shares the host's memory works on frames where they were read or lie. For one with memory of
    its own, the next frames are read and decoded while those before are copied and worked on.

    Parameters
    ----------
    source : Source
        It is rewound first, if it can be.
    estimator : Estimator
    frames : range
        Which of them, in steps of 1; those before are read and dropped.
    progress : callable, optional
        Told the number of frames so far.
    """
    if source.rewindable:
        source.rewind()
    ahead = not estimator.device.info.shares_memory
    done = 0
    for block in _in_place(source, estimator, frames.start):
        done += len(block.frames)
        if progress:
            progress(done)
    for block in (_ahead if ahead else _in_place)(source, estimator, len(frames)):
        estimator.push(block)
        done += len(block.frames)
        if progress:
            progress(done)


def _in_place(source: Source, estimator: Estimator, count: int) -> Iterator[Block]:
    """Read frames to where the estimator wants them."""
    while count > 0:
        block = source.read(estimator.room[:count])
        if block is None:
            return
        yield block
        count -= len(block.frames)


def _ahead(source: Source, estimator: Estimator, count: int) -> Iterator[Block]:
    """Read frames to two places in turns, one while the other is copied from."""
    length = max(1, len(estimator.room) // 2)
    shape = max(1, min(length, count)), *estimator.room.shape[1:]
    rooms = [estimator.device.pinned(shape, source.dtype) for _ in range(2)]
    with ThreadPoolExecutor(1, "mirrorskin-read") as reader:
        coming = reader.submit(source.read, rooms[0][:count])
        while (block := coming.result()) is not None:
            rooms.reverse()
            count -= len(block.frames)
            if count > 0:
                coming = reader.submit(source.read, rooms[0][:count])
            yield block
            if count <= 0:
                return
