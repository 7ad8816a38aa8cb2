"""What an estimator is, and the one loop: frames of a source into an estimator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from numpy.typing import NDArray

from mirrorskin.io import Block, Source
from mirrorskin.kernels.device import Device

Progress = Callable[[int], None]


class Estimator(Protocol):
    """Takes frames as they come, and returns maps of those so far.

    ``push(frames)`` takes the next frames, (n, H, W), any number of them. What it needs to know of each frame
    besides, it names as parameters: ``push(frames, *, travel)`` of a press, ``push(frames, *, phase)`` of a
    rotation; see `mirrorskin.io.Block`. The memory of frames may be written anew when it returns. The same
    frames give the same result, bit by bit, however they are cut into pushes.

    ``result()`` returns the maps of the frames so far as plain arrays, by name or in a data class. It changes
    nothing: it may be called again, and more frames may follow. ``reset()`` forgets the frames, and what was
    estimated from them; parameters, references and device buffers stay.

    Several threads may use an estimator of this package; see `mirrorskin.engine.thread_safe.ThreadSafe`.
    """

    def push(self, *args: Any, **kwargs: Any) -> None:
        """Take in the next frames."""

    def result(self) -> Any:
        """Return the maps of the frames so far."""

    def reset(self) -> None:
        """Forget the frames so far."""


class DeviceEstimator(Estimator, Protocol):
    """An estimator that says where frames are to be read to, and where it works.

    ``push(frames, travel=..., lent=False)`` or ``push(frames, phase=..., lent=False)``: a device that shares
    the host's memory reads frames where they lie, and ``push`` waits until it has; ``lent=True`` says that
    nobody writes to their memory as long as it is referred to, so it need not wait. Only what kernels cannot
    read in place is copied, such as frames that are not in C order.
    """

    position: str
    """The keyword of ``push`` that says where the body was: "travel" or "phase"."""

    @property
    def device(self) -> Device:
        """Where it works."""

    @property
    def room(self) -> NDArray[Any]:
        """Where the next frames may be written, (n, H, W)."""


def feed(
    source: Source,
    estimator: DeviceEstimator,
    frames: range,
    progress: Progress | None = None,
    long: bool = False,
) -> None:
    """Push frames of a source into an estimator.

    A device that shares the host's memory works on frames where they were read or lie. For one with memory of
    its own, and of frames in Zarr, the next are read and decoded while those before are copied and worked on.

    Parameters
    ----------
    source : Source
        It is rewound first, if it can be.
    estimator : DeviceEstimator
    frames : range
        Which of them, in steps of 1; those before are read and dropped.
    progress : callable, optional
        Called with the number of frames so far.
    long : bool
        Whether to push as many frames at once as a mapped file lends, not as many as there is room for: where
        kernels are quick beside loading what they keep of each pixel.
    """
    if source.rewindable:
        source.rewind()
    shared = estimator.device.info.shares_memory
    done = 0
    for block in _read_in_place(source, estimator, frames.start):
        done += len(block.frames)
        if progress:
            progress(done)
    ahead = not shared or getattr(source, "read_ahead", False)
    read = _read_ahead if ahead else _lent_or_read if long else _read_in_place
    with ThreadPoolExecutor(1, "mirrorskin-fingerprint") as beside:
        # It is needed for the result, and is there by then.
        known = beside.submit(source.fingerprint) if hasattr(source, "fingerprint") else None
        for block in read(source, estimator, len(frames)):
            push_block(estimator, block)
            done += len(block.frames)
            if progress:
                progress(done)
    if known is not None:
        known.result()


def push_block(estimator: DeviceEstimator, block: Block, part: slice = slice(None)) -> None:
    """Push what a source yields, or a part of it: frames and their positions."""
    where = getattr(block, estimator.position)
    known = {estimator.position: None if where is None else where[part]}
    estimator.push(block.frames[part], **known, lent=block.lent)


def _read_in_place(source: Source, estimator: DeviceEstimator, count: int) -> Iterator[Block]:
    """Read frames to where the estimator wants them."""
    while count > 0:
        block = source.read(estimator.room[:count])
        if block is None:
            return
        yield block
        count -= len(block.frames)


def _lent_or_read(source: Source, estimator: DeviceEstimator, count: int) -> Iterator[Block]:
    """Take frames where they lie, as many at once as is possible, as long as the source lends them."""
    lend: Callable[[int], Block | None] = getattr(source, "lend", lambda most: None)
    most = max(1, estimator.device.max_allocation // (math.prod(source.shape[1:]) * source.dtype.itemsize))
    while count > 0 and (block := lend(min(count, most))) is not None:
        yield block
        count -= len(block.frames)
    yield from _read_in_place(source, estimator, count)


def _read_ahead(source: Source, estimator: DeviceEstimator, count: int) -> Iterator[Block]:
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
