"""Memory that many small files need one after the other."""

from __future__ import annotations

import ctypes

# Of malloc.h of the GNU C library.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGE = 8 << 20  # room for frames is larger, and often not touched: that costs nothing only if it is new
_SPARE = 256 << 20


def keep_memory() -> None:
    """Let this process keep pieces of memory up to 8 MiB that are freed, 256 MiB in all, for the next file.

    The GNU C library gives a map's memory back to the system when the map is gone, and gets it again, page by
    page and full of zeros, for the next one. That took a third of the time of small recordings: 4100 pages of
    each of 32 x 640 x 480. With another C library nothing is done.
    """
    tune = getattr(ctypes.CDLL(None), "mallopt", None)
    if tune is not None:
        tune(_MMAP_THRESHOLD, _LARGE)
        tune(_TRIM_THRESHOLD, _SPARE)
