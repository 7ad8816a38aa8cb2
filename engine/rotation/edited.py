"""Sources that change what another source reads, such as the phase of each frame."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from mirrorskin.io import Block, Source


class DerivedSource:
    """Base of sources that read another source, and have its properties."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name, self.header, self.shape = source.name, source.header, source.shape
        self.dtype, self.motion, self.rewindable = source.dtype, source.motion, source.rewindable

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._source.rewind()

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._source.__exit__(kind, error, trace)


class EditedSource(DerivedSource):
    """A source whose blocks are edited after they are read."""

    def __init__(self, source: Source, edit: Callable[[Block], Block]) -> None:
        super().__init__(source)
        self._edit = edit

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames."""
        block = self._source.read(out)
        return block and self._edit(block)
