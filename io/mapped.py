"""Frames that lie in one piece in a file: the file's pages are the memory."""

from __future__ import annotations

import ctypes
import functools
import math
import mmap
import os
import signal
import sys
from contextlib import suppress
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.selection import Place, Region, Span

PADDING = 64
"""Bytes behind the last sample that must be there, too: kernels load their last word whole."""


class MappedFrames:
    """Frames in one piece, from some byte of an open file on; whole ones are lent where they lie.

    OSError: the file is too short, or cannot be mapped. The descriptor may be closed afterwards. At most
    ``span`` bytes are lent at once, and at most a quarter of the machine's memory: a kernel that comes by
    them again and again must find them there.
    """

    length, how, scratch_bytes = 1, "mapped", 0

    def __init__(
        self,
        file: int,
        place: Place,
        offset: int,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        span: int,
    ) -> None:
        self._place, self._frame = place, math.prod(shape[1:]) * dtype.itemsize
        self._end = offset + shape[0] * self._frame
        size = os.fstat(file).st_size
        _check_length(size, self._end)
        base = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        self._map: mmap.mmap | None = _map(file, base, min(size, self._end + PADDING) - base)
        self._offset = offset - base
        self._frames = np.ndarray(shape, dtype, self._map, self._offset)
        # Whole pages are mapped, to the end of the last.
        reach = -(-len(self._map) // mmap.PAGESIZE) * mmap.PAGESIZE
        self._lendable = (reach - PADDING - self._offset) // self._frame if self._frames.flags.aligned else 0
        self._longest = max(1, min(span, _machine_memory() // 4) // self._frame)
        self._used = self._dropped = 0

    def lend(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return whole frames where they lie, perhaps fewer; None if the first cannot be lent."""
        stop = min(stop, start + self._longest, self._lendable)
        if stop <= start:
            return None
        self._turn_to(start, stop)
        return self._frames[start:stop]

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Copy a part into ``out``."""
        self._turn_to(*frames)
        out[...] = self._frames[slice(*frames), *region.slices]

    def close(self) -> None:
        """Let go of the pages; those that were lent live on with the frames."""
        self._frames = self._frames[:0].copy()  # a view would hold the mapping
        self._map = None

    def _turn_to(self, start: int, stop: int) -> None:
        """See that frames are there, and let go of those before the block before."""
        with self._place.reading(start, stop):
            if self._map is None:
                raise ValueError("(it is closed)")
            _check_length(self._map.size(), self._end)
            # Pages that were used count to the memory of this process.
            behind = self._offset + min(self._used, start) * self._frame
            behind -= behind % mmap.PAGESIZE
            if behind > self._dropped:
                self._map.madvise(mmap.MADV_DONTNEED, self._dropped, behind - self._dropped)
            self._dropped, self._used = behind, start


def _check_length(size: int, end: int) -> None:
    if size < end:
        raise OSError("truncated: the file became shorter")


@functools.cache
def _machine_memory() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


# Whoever touches a page that its file has no longer gets SIGBUS, which ends the program: a kernel's thread
# may do so between the check of a block and its end. Such pages are replaced by empty ones; that the file is
# not as it was is told by the check of the next block, or by that of the source's fingerprint at the end.

_maps: WeakKeyDictionary[mmap.mmap, tuple[int, int]] = WeakKeyDictionary()
"""Pages of files: their address, and where they begin in the file."""

_FIXED, _WITH_ADDRESS = 0x10, 4  # MAP_FIXED, SA_SIGINFO
_FAULT = 16  # bytes from the begin of a siginfo_t to the address that was touched
_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t)


class _Action(ctypes.Structure):
    """A struct sigaction of Linux's C libraries."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_char * 128),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


def _map(file: int, base: int, length: int) -> mmap.mmap:
    if sys.platform == "linux":
        _survive_lost_pages()
    pages = mmap.mmap(file, length, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ, offset=base)
    _maps[pages] = np.frombuffer(pages, np.uint8).ctypes.data, base
    return pages


@functools.cache
def _survive_lost_pages() -> Any:
    """Replace lost pages when one is touched; any other SIGBUS is left to who had it before."""
    libc, before = ctypes.CDLL(None), _Action()
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    libc.mmap.restype = ctypes.c_void_p

    def replace(number: int, info: int, _: int) -> None:
        touched = ctypes.c_size_t.from_address(info + _FAULT).value
        with suppress(OSError):  # a file that does not even tell its size
            for pages, (address, base) in list(_maps.items()):
                kept = max(0, -(-(pages.size() - base) // mmap.PAGESIZE)) * mmap.PAGESIZE
                if address + kept <= touched < address + -(-len(pages) // mmap.PAGESIZE) * mmap.PAGESIZE:
                    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _FIXED
                    libc.mmap(address + kept, len(pages) - kept, mmap.PROT_READ, flags, -1, 0)
                    return
        libc.sigaction(number, ctypes.byref(before), None)

    handler = _HANDLER(replace)
    action = _Action(ctypes.cast(handler, ctypes.c_void_p).value, flags=_WITH_ADDRESS)
    libc.sigaction(signal.SIGBUS, ctypes.byref(action), ctypes.byref(before))
    return handler  # kept, since the system calls it
