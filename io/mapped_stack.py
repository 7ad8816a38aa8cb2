"""Frames that lie in one piece in a file: the file's pages are the memory."""

from __future__ import annotations

import functools
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

    OSError: the file is too short, or cannot be mapped. The descriptor may be closed afterwards. At most
    ``span`` bytes are lent at once, and at most a quarter of the machine's memory: a kernel that comes by
    them again and again must find them there.
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
        span: int = 0,
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
        self._longest = max(1, min(span, _machine_memory() // 4) // self._frame)
        self._used = self._dropped = 0

    def end(self, start: int, stop: int) -> int:
        """Return ``stop``: a read may end anywhere."""
        return stop

    def lend(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return frames where they lie, perhaps fewer; None if the first cannot be lent."""
        stop = min(stop, start + self._longest, self._lendable - self._first)
        if stop <= start:
            return None
        self._turn_to(start, stop)
        return self._frames[start:stop]

    def read(self, start: int, stop: int, out: NDArray[Any]) -> NDArray[Any]:
        """Lend frames, or copy them into ``out``."""
        self._turn_to(start, stop)
        if self._first + stop <= self._lendable:
            return self._frames[start:stop]
        room = out[: stop - start]
        room[...] = self._frames[start:stop]
        return room

    def close(self) -> None:
        """Let go of the pages; those that were lent live on with the frames."""
        self._frames = np.empty((0, *self.shape[1:]), self.dtype)  # a view would hold the mapping
        self._map = None

    def _turn_to(self, start: int, stop: int) -> None:
        """See that frames are there, and let go of those before the block before."""
        with self._place.reading(self._first + start, self._first + stop):
            if self._map is None:
                raise ValueError("(it is closed)")
            _check_length(self._map.size(), self._end)
            self._drop_pages(self._map, start)

    def _drop_pages(self, pages: mmap.mmap, start: int) -> None:
        """Take pages out of this process, whose memory they count to."""
        behind = self._offset + (self._first + min(self._used, start)) * self._frame
        behind -= behind % mmap.PAGESIZE
        if behind > self._dropped:
            pages.madvise(mmap.MADV_DONTNEED, self._dropped, behind - self._dropped)
        self._dropped, self._used = behind, start


def _check_length(size: int, end: int) -> None:
    if size < end:
        raise OSError("truncated: the file became shorter")


@functools.cache
def _machine_memory() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
