"""A source that edits the blocks of another source, such as the phase of each frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from mirrorskin.io import Block, Source
from mirrorskin.io.types import Closing


class EditedSource(Closing):
    """A source whose blocks are edited after they are read; it does not close the other source."""

    def __init__(self, source: Source, edit: Callable[[Block], Block]) -> None:
        self._source, self._edit = source, edit
        self.name, self.header, self.shape = source.name, source.header, source.shape
        self.dtype, self.motion, self.rewindable = source.dtype, source.motion, source.rewindable

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._source.rewind()

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames."""
        block = self._source.read(out)
        return block and self._edit(block)
