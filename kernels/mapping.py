"""A device's buffer, mapped into the host's memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pyopencl as cl

from mirrorskin.kernels.waiting import keep_for_ever

READ_WRITE = cl.map_flags.READ | cl.map_flags.WRITE


class Mapping:
    """A buffer that is mapped until ``release``; an array for ``np.asarray``.

    A `pyopencl.MemoryMap` unmaps the buffer when it is destroyed. If that fails, because the device is lost
    or the buffer is unmapped already, pyopencl aborts the process. So the buffer is unmapped here, once, and
    a map that cannot be unmapped is never destroyed.
    """

    def __init__(
        self,
        queue: cl.CommandQueue,
        buffer: cl.Buffer,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        flags: Any = READ_WRITE,
        *,
        offset: int = 0,
        after: Sequence[cl.Event] = (),
    ) -> None:
        """Map a part of a buffer, starting at an offset in bytes, after some events."""
        self._maps: list[cl.MemoryMap] = []  # empty after the release
        view, _ = cl.enqueue_map_buffer(
            queue, buffer, flags, offset, shape, dtype, wait_for=after, is_blocking=True
        )
        self._maps.append(view.base)
        self.__array_interface__ = view.__array_interface__

    def __del__(self) -> None:
        with suppress(cl.Error):
            self.release()

    def release(self, queue: cl.CommandQueue | None = None) -> None:
        """Unmap the buffer if it is still mapped; by default on the queue that mapped it."""
        try:
            mapped = self._maps.pop()  # at once, so that no two threads have it
        except IndexError:
            return
        try:
            mapped.release(queue)
        except cl.Error:
            keep_for_ever(mapped)
            raise
