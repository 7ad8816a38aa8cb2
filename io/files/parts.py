"""Stacks in several datasets, such as those that the master file of a detector links to, as one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.selection import Region
from mirrorskin.io.files.stacks import find_stack, names_of_stack
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.model.frames import JoinedFrames, WholeFrames
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.stack import Stack
from mirrorskin.io.storage.zarr import ZarrFile, open_file

_AT_ONCE = 16  # frames that are read at once


class _Part(WholeFrames):
    """The frames of one dataset."""

    random_access = True

    def __init__(self, file: Hdf5File, name: str, channel: int | None, memory_limit: int | None) -> None:
        dataset, state, decoding, self.findings = find_stack(
            file, name, False, channel, None, memory_limit, 1
        )
        self.shape, self.dtype = (state.count, *decoding.shape(dataset.shape)[1:]), decoding.dtype
        self.files = (Path(dataset.file.filename),) if not isinstance(file, ZarrFile) else ()
        self.findings += decoding.findings
        self._label = file.where(dataset)
        self._stack = Stack(
            dataset,
            str(file.path),
            state.count,
            np.arange(state.count),
            Region.whole(self.shape[1:]),
            memory_limit,
            None,
            decoding,
            file.frames(dataset) if isinstance(file, ZarrFile) else None,
        )
        self.how = self._stack.how

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Read frames."""
        while start < stop:
            buffer = np.empty((min(_AT_ONCE, stop - start), *self.shape[1:]), self.dtype)
            for frame in self._stack.read(start, buffer):
                yield self._label, frame
                start += 1

    def close(self) -> None:
        """End the threads that read."""
        self._stack.close()


class PartsOfStack(JoinedFrames):
    """The numbered parts of a stack in an HDF5 file, in the files that it links to, or in Zarr."""

    def __init__(self, path: Path, channel: int | None = None, memory_limit: int | None = None) -> None:
        with ExitStack() as opening:
            file = opening.enter_context(open_file(path, memory_limit))
            names = names_of_stack(file, None)
            parts = [opening.enter_context(_Part(file, name, channel, memory_limit)) for name in names]
            super().__init__(parts, [f"{path}: {name}" for name in names])
            text = f"{len(names)} parts, {names[0]} to {names[-1]}, are joined; --dataset reads one of them"
            self.findings = (Finding("parts", text, warning=False), *self.findings)
            self.files = (*([path] if path.is_file() else []), *(part for part in self.files if part != path))
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Close all files."""
        self._opened.close()


PARTS = Format(
    name="stack in parts",
    suffixes=(),
    reader="PartsOfStack",
    takes=("channel", "memory_limit"),
    module=__name__,
)
