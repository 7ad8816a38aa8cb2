"""Frames fetched from a file, and nothing done with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  the filters that it brings
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.ours import OURS
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Recording

READ, H5PY = f"{OURS}, frames read", "h5py, frames read"

_PAGE = 4096


def room_of(recording: Recording) -> NDArray[Any]:
    """Make as much room for frames as a reconstruction has by default."""
    length = MEMORY_LIMIT // (2 * int(np.prod(recording.shape[1:])) * recording.dtype.itemsize)
    return np.zeros((min(max(1, length), recording.shape[0]), *recording.shape[1:]), recording.dtype)


def fetch(recording: Recording, room: NDArray[Any]) -> None:
    """Read all frames, of those that are lent one byte a page."""
    recording.rewind()
    while (block := recording.read(room)) is not None:
        if block.lent:
            block.frames.reshape(-1).view(np.uint8)[::_PAGE].max()


def read_with_h5py(path: Path, dataset: str) -> None:
    """Read all frames, one by one, into the same memory."""
    with h5py.File(path) as file:
        stack = file[dataset]
        frame = np.empty(stack.shape[1:], stack.dtype)
        for number in range(len(stack)):
            stack.read_direct(frame, np.s_[number])
