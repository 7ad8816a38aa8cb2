"""Some frames of a stack, as if there were no others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.stacks.stack import Stack


class Picked:
    """The frames of a stack that were chosen, numbered from 0; those between are not read.

    Parameters
    ----------
    stack : Stack
    frames : ndarray, (n,), int
        Their numbers in the stack, which increase.
    """

    def __init__(self, stack: Stack, frames: NDArray[np.intp]) -> None:
        self.shape, self.dtype = (len(frames), *stack.shape[1:]), stack.dtype
        self._stack = stack
        self._frames: list[int] = frames.tolist()
        # Frames that follow each other in the stack are a run, and are read together.
        breaks = np.flatnonzero(np.diff(frames) != 1) + 1
        ends = np.append(breaks, len(frames))
        self._ends: list[int] = np.repeat(ends, np.diff(ends, prepend=0)).tolist()

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""
        return self._stack.how

    def end(self, start: int, stop: int) -> int:
        """Return where a read that begins at ``start`` had better end, at the latest with its run."""
        first = self._frames[start]
        return start + self._stack.end(first, first + min(stop, self._ends[start]) - start) - first

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames of one run; see ``Stack.read``."""
        first = self._frames[start]
        return self._stack.read(first, first + stop - start, out)

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""
        self._stack.close()
