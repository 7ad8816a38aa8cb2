"""The twin as a real-time camera: frames arrive when they are due."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.io.base.types import Block, Closing, Header, InputError
from mirrorskin.twin.twin import Twin

_QUEUE = 8  # frames that wait for a late reader, as in a camera's driver


class Live(Closing):
    """A source of the twin's frames at a fixed rate, starting with the first read.

    A read waits for the next frame, and also returns the frames that have become due since the previous read.
    A reader that is late by more than 8 frames loses the oldest of them; the block contains their number.

    Parameters
    ----------
    twin : Twin
        It is rewound.
    rate : float, optional
        Frames per second; by default that of the twin's camera.
    clock : Clock
        Clock to wait with.

    Attributes
    ----------
    name, header, shape, dtype, motion, rewindable
        As for every source; it cannot be rewound.

    Raises
    ------
    InputError
        The rate is not above zero.
    """

    name: str
    header: Header
    motion: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    rewindable = False

    def __init__(self, twin: Twin, rate: float | None = None, clock: Clock = SYSTEM) -> None:
        rate = twin.frame_rate if rate is None else rate
        if not (math.isfinite(rate) and rate > 0):
            raise InputError(f"{twin.name}: {rate} frames per second is not possible: give more than 0")
        self.name, self.header, self.motion = twin.name, twin.header, twin.motion
        self.shape, self.dtype = twin.shape, twin.dtype
        self._twin = twin
        twin.rewind()
        self._rate = rate
        self._clock = clock
        self._start: float | None = None
        self._given = 0

    def rewind(self) -> None:
        """Raise: a live source cannot be rewound."""
        raise RuntimeError("a live source cannot be rewound")

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Wait for the next frame; see ``Source.read``."""
        if out is None:
            out = np.empty((1, *self.shape[1:]), self.dtype)
        if self._given == self.shape[0]:
            return None
        due = self._wait()
        dropped = max(0, due - self._given - _QUEUE)
        self._twin.skip(dropped)
        self._given += dropped
        block = self._twin.read(out[: max(1, due - self._given)])
        if block is None:
            return None
        self._given += len(block.frames)
        frame = np.arange(block.index, block.index + len(block.frames))
        return replace(block, dropped=dropped, time=frame / self._rate)

    def _wait(self) -> int:
        """Wait until the next frame is due, and return the number of frames due."""
        if self._start is None:
            self._start = self._clock.now()
        early = self._start + self._given / self._rate - self._clock.now()
        if early > 0:
            self._clock.sleep(early)
        passed = self._clock.now() - self._start
        return min(self.shape[0], max(self._given + 1, math.floor(passed * self._rate) + 1))
