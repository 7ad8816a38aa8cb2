"""What all ways of fetching frames have in common."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.plain import plainly
from mirrorskin.io.region import Region

Span = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Cut:
    """What is wanted of a dataset.

    Attributes
    ----------
    frames : (int, int)
        First frame and end.
    region : Region
    """

    frames: tuple[int, int]
    region: Region

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""
        return (self.frames[1] - self.frames[0], *self.region.shape)

    @property
    def spans(self) -> tuple[Span, Span, Span]:
        """First and end of the frames, the rows and the columns."""
        return self.frames, self.region.rows, self.region.columns

    def overlap(self, other: Cut) -> Cut:
        """Return what is in both; there must be something."""
        frames, rows, columns = (
            (max(a, c), min(b, d)) for (a, b), (c, d) in zip(self.spans, other.spans, strict=True)
        )
        return Cut(frames, Region(rows, columns))

    def within(self, outer: Cut) -> tuple[slice, slice, slice]:
        """Return what cuts this out of an array that holds another cut."""
        frames, rows, columns = (
            slice(a - c, b - c) for (a, b), (c, _) in zip(self.spans, outer.spans, strict=True)
        )
        return frames, rows, columns


class Stack(Protocol):
    """The frames of a dataset, or a cut of them, which are numbered from 0."""

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""

    def end(self, start: int, stop: int) -> int:
        """Return where a read that begins at ``start`` had better end, at most ``stop``."""

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Return frames ``start`` to ``stop``, where ``end`` said so, in ``out`` or in memory of the stack's.

        Nobody writes to memory of the stack's as long as someone refers to it.

        Raises
        ------
        InputError
            They are damaged, or not there any more.
        """

    def close(self) -> None:
        """Let go of the file; what was lent lives on."""


class Chunks(Protocol):
    """A dataset in chunks, of which any part can be asked for."""

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    chunk: tuple[int, int, int]
    rooms: int
    """Bytes that unpacking takes, besides where frames are wanted."""

    @property
    def how(self) -> str:
        """How frames are fetched, for people."""

    def fetch(self, cut: Cut, out: NDArray[Any]) -> None:
        """Write a part into ``out``; every chunk that it touches is decoded once."""

    def close(self) -> None:
        """Let go of the file."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where frames come from, for messages.

    Attributes
    ----------
    path : str
        As the user calls the file.
    dataset : str
    """

    path: str
    dataset: str

    def reading(self, start: int, stop: int) -> AbstractContextManager[None]:
        """Name the frames, ``start`` to ``stop`` of the whole stack, if it fails to read them."""
        frames = f"frame {start}" if stop == start + 1 else f"frames {start} to {stop - 1}"
        return plainly(f"{self.path}: {frames} of {self.dataset} cannot be read")
