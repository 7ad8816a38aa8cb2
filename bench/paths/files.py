"""Recordings to measure on: made in a folder of their own, which is removed in the end."""

from __future__ import annotations

import gc
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Block, Compression, Header, InputError, Recorder
from mirrorskin.io.types import Closing, Floats

_PAGE = 4096
_SPARE = 64  # bytes behind the frames, so that a kernel may load its last word whole
_TRIES, _WAIT = 5, 0.2  # and seconds more from one to the next, for what a look begins to read
_FAR = 2**25  # bytes from one look into the page cache to the next: a look may bring in what is near it


@dataclass(frozen=True, slots=True)
class FileCase:
    """Frames in a file.

    Attributes
    ----------
    name : str
    shape : (int, int, int)
        Frames, rows and columns, of uint8.
    """

    name: str
    shape: tuple[int, int, int]

    @property
    def bytes(self) -> int:
        """Of the frames."""
        return math.prod(self.shape)


class Frames(Closing):
    """Frames in memory, as a source.

    Parameters
    ----------
    frames : ndarray, (T, H, W)
    header : Header
    positions : ndarray, (T,), float64
        Travel of a vertical motion, mm, or phase of an axial one, radians.
    """

    name = "frames in memory"
    rewindable = True

    def __init__(self, frames: NDArray[Any], header: Header, positions: Floats) -> None:
        self.header, self.motion = header, header.motion
        self.shape = (len(frames), frames.shape[1], frames.shape[2])
        self.dtype = frames.dtype
        self._frames, self._positions = frames, positions
        self._next = 0

    @property
    def block(self) -> Block:
        """All frames at once, for a device to work in."""
        return self._block(slice(0, len(self._frames)))

    def first(self, count: int) -> Frames:
        """Return the first frames as a source of their own."""
        return Frames(self._frames[:count], self.header, self._positions[:count])

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Return the next frames where they lie; see ``Source.read``."""
        part = slice(self._next, min(self._next + (1 if out is None else len(out)), len(self._frames)))
        self._next = part.stop
        return self._block(part) if part.start < part.stop else None

    def _block(self, part: slice) -> Block:
        axis = "travel" if self.motion == "vertical" else "phase"
        known: dict[str, Any] = {axis: self._positions[part]}
        return Block(self._frames[part], part.start, lent=True, **known)


def in_memory(shape: tuple[int, int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Make room for a stack in which a device may work: on a page's border, with some bytes to spare."""
    size = int(np.prod(shape)) * dtype.itemsize
    raw = np.empty(size + _PAGE + _SPARE, np.uint8)
    start = -raw.ctypes.data % _PAGE
    return raw[start : start + size].view(dtype).reshape(shape)


@contextmanager
def new_folder(name: str, needed: int) -> Iterator[Path]:
    """Make a folder where temporary files go, and remove it and what is in it afterwards.

    Parameters
    ----------
    name : str
        Of the case.
    needed : int
        Bytes that its files will take.

    Raises
    ------
    InputError
        There is no room for them.
    """
    with tempfile.TemporaryDirectory(prefix="mirrorskin-bench-") as made:
        free = shutil.disk_usage(made).free
        if free < needed:
            raise InputError(
                f"case {name} needs {needed / 1e9:.1f} GB in {tempfile.gettempdir()} and {free / 1e9:.1f} GB "
                "are free: choose another folder with --folder, or name other cases with --case"
            )
        yield Path(made)


def record(source: Frames, path: Path, compression: Compression = "raw") -> None:
    """Write a recording, and wait until the disk has it: nothing is left to write while others are timed."""
    source.rewind()
    with Recorder(source, path, compression) as recorder:
        recorder.drain(lambda count: None)
    settle(path)


def settle(path: Path) -> None:
    """Wait until the disk has all of a file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def drop(path: Path) -> None:
    """Drop a file from the page cache, if the system can do that."""
    gc.collect()  # pages that someone still has mapped stay
    if hasattr(os, "posix_fadvise"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def can_drop(path: Path) -> bool:
    """Drop a file from the page cache, and tell whether it is gone; pages that are in use may stay."""
    if not hasattr(os, "RWF_NOWAIT"):
        return False
    for attempt in range(_TRIES):
        time.sleep(attempt * _WAIT)
        drop(path)
        with path.open("rb") as file:
            places = range(0, path.stat().st_size, _FAR)
            if not any(_is_cached(file.fileno(), place) for place in places):
                return True
    return False


def read_plainly(path: Path, room: bytearray) -> None:
    """Read all of a file, in order."""
    with path.open("rb", buffering=0) as file:
        while file.readinto(room):
            pass


def _is_cached(file: int, offset: int) -> bool:
    try:
        os.preadv(file, [bytearray(1)], offset, os.RWF_NOWAIT)
    except BlockingIOError:
        return False
    except OSError:  # nobody can tell
        return True
    return True
