"""Room on the disk that is taken before it is needed, so that a full one is met between two writes."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

from mirrorskin.io.atomic import MAKE_ROOM
from mirrorskin.io.types import InputError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNABLE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


class Reserve:
    """The bytes of a file that the disk has promised.

    Parameters
    ----------
    path : Path
        What to call the file in messages.
    descriptor : int
        Of the open file; it is grown.
    step : int
        Bytes that are asked for at once, if there are so many.
    """

    def __init__(self, path: Path, descriptor: int, step: int) -> None:
        self._path, self._descriptor, self._step = path, descriptor, step
        self._end: float = 0

    def hold(self, end: int) -> None:
        """See that the file can be written up to some byte.

        A disk that cannot promise anything is believed to have room.

        Raises
        ------
        InputError
            The disk is full, or no file may be so large.
        """
        if self._end < math.inf:
            self._end = min(self._end, os.fstat(self._descriptor).st_size)  # HDF5 may have cut it off
        if end > self._end and not self._grow(end + self._step):
            self._grow(end, last=True)

    def _grow(self, end: int, last: bool = False) -> bool:
        start = int(self._end)
        try:
            os.posix_fallocate(self._descriptor, start, end - start)
        except OSError as error:
            if error.errno in _UNABLE:
                self._end = math.inf
                return True
            if error.errno not in _FULL:
                raise
            if last:
                why = os.strerror(error.errno)
                raise InputError(f"{self._path}: the disk is full ({why}); {MAKE_ROOM}") from error
            return False
        self._end = end
        return True
