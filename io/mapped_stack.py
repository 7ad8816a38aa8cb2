"""Frames that lie in one piece in a file: the file's pages are the memory."""

from __future__ import annotations

import math
import mmap
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.selection import Place, Selection

PADDING = 64
"""Bytes behind the last sample that must be there, too: kernels load their last word whole."""


class MappedStack:
    """Frames in one piece, from some byte of an open file on; whole ones are lent where they lie.

    OSError: the file is too short, or cannot be mapped. The descriptor may be closed afterwards.
    """

    def __init__(
        self,
        file: int,
        place: Place,
        offset: int,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        part: Selection,
        how: str = "mapped",
    ) -> None:
        self.shape, self.dtype, self.how = part.shape, dtype, how
        self._place, self._first = place, part.frames[0]
        self._end = offset + math.prod(shape) * dtype.itemsize
        size = os.fstat(file).st_size
        _check_length(size, self._end)
        base = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        length = min(size, self._end + PADDING) - base
        pages = mmap.mmap(file, length, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ, offset=base)
        self._map: mmap.mmap | None = pages
        self._offset = offset - base
        self._frame = math.prod(shape[1:]) * dtype.itemsize
        whole = np.ndarray(shape, dtype, pages, self._offset)
        self._frames = whole[slice(*part.frames), *part.region.slices]
        # Whole pages are mapped, to the end of the last.
        reach = -(-length // mmap.PAGESIZE) * mmap.PAGESIZE
        lendable = whole.flags.aligned and part.region.shape == shape[1:]
        self._lendable = (reach - PADDING - self._offset) // self._frame if lendable else 0
        self._used = self._dropped = 0

    def end(self, start: int, stop: int) -> int:
        """Return ``stop``: a read may end anywhere."""
        return stop

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Lend frames, or copy them into ``out``."""
        first, last = self._first + start, self._first + stop
        with self._place.reading(first, last):
            if self._map is None:
                raise ValueError("(it is closed)")
            _check_length(self._map.size(), self._end)
            self._drop_pages(self._map, start)
        frames = self._frames[start:stop]
        if last <= self._lendable:
            return frames
        room = out[: stop - start]
        room[...] = frames
        return room

    def close(self) -> None:
        """Let go of the pages; those that were lent live on with the frames."""
        self._frames = np.empty((0, *self.shape[1:]), self.dtype)  # a view would hold the mapping
        self._map = None

    def _drop_pages(self, pages: mmap.mmap, start: int) -> None:
        """Take the pages before the block before out of this process, whose memory they count to."""
        behind = self._offset + (self._first + min(self._used, start)) * self._frame
        behind -= behind % mmap.PAGESIZE
        if behind > self._dropped:
            pages.madvise(mmap.MADV_DONTNEED, self._dropped, behind - self._dropped)
        self._dropped, self._used = behind, start


def _check_length(size: int, end: int) -> None:
    if size < end:
        raise OSError("truncated: the file became shorter")
