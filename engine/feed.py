"""The one loop: from a source of frames into an estimator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Block, Source

Progress = Callable[[int], None]


class Estimator(Protocol):
    """What the loop feeds: it takes in blocks, and offers room to read them into."""

    @property
    def room(self) -> NDArray[np.generic]:
        """Where the next frames may be written, (n, H, W)."""

    def push(self, block: Block) -> None:
        """Take in the next frames."""


def feed(source: Source, estimator: Estimator, frames: range, progress: Progress | None = None) -> None:
    """Push frames of a source into an estimator.

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
    done = 0
    while done < frames.stop:
        wanted = done >= frames.start
        block = source.read(estimator.room[: (frames.stop if wanted else frames.start) - done])
        if block is None:
            return
        if wanted:
            estimator.push(block)
        done += len(block.frames)
        if progress:
            progress(done)
