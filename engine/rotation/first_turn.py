"""The first turn of a rotation, kept in memory to be looked at more than once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.rotation.turns import LONGEST, cut_into_turns
from mirrorskin.io import Block, Source, check_phase


class FirstTurn:
    """The frames of a source's first turn, as a source.

    Parameters
    ----------
    source : Source
        Of axial motion, which can be rewound. It is read up to the first frame of the second turn, and to 64
        frames at most.

    Attributes
    ----------
    name, header, motion, dtype
        Those of the source.
    shape : (int, int, int)
    phase : ndarray, (T,), float64
    rewindable : bool
        True.

    Raises
    ------
    mirrorskin.io.InputError
        A phase is missing, or the source cannot be read.
    """

    rewindable = True

    def __init__(self, source: Source) -> None:
        self.name, self.header, self.motion, self.dtype = (
            source.name,
            source.header,
            source.motion,
            source.dtype,
        )
        frames: list[NDArray[Any]] = []
        phase = np.empty(0)
        source.rewind()
        while len(frames) < LONGEST and (block := source.read()) is not None:
            phase = np.concatenate(
                [phase, check_phase(block.phase, len(block.frames), f"{self.name}: phase")]
            )
            if len(cut_into_turns(phase)) > 1:
                break
            frames.extend(block.frames.copy())
        self._frames = np.stack(frames) if frames else np.empty((0, *source.shape[1:]), source.dtype)
        self.phase = phase[: len(frames)]
        self.shape = self._frames.shape
        self._next = 0

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames; see ``Source.read``."""
        count = min(1 if out is None else len(out), self.shape[0] - self._next)
        if count == 0:
            return None
        part = slice(self._next, self._next + count)
        self._next = part.stop
        block = Block(self._frames[part], part.start, phase=self.phase[part])
        if out is None:
            return block
        out[:count] = block.frames
        return replace(block, frames=out[:count])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass
