"""Frames that only HDF5 can fetch."""

from __future__ import annotations

import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.stacks.stack import Cut, Place


class Through:
    """A dataset that HDF5 reads, in one thread.

    Parameters
    ----------
    dataset : h5py.Dataset
    place : Place
    why : str
        What keeps us from fetching its frames ourselves.
    """

    def __init__(self, dataset: h5py.Dataset, place: Place, why: str) -> None:
        self.shape = dataset.shape
        self.dtype: np.dtype[Any] = dataset.dtype.newbyteorder("=")
        self.chunk = dataset.chunks or (1, *dataset.shape[1:])
        self.rooms = math.prod(self.chunk) * self.dtype.itemsize
        self.how = f"through HDF5 ({why})"
        self._dataset, self._place = dataset, place

    def fetch(self, cut: Cut, out: NDArray[Any]) -> None:
        """Write a part into ``out``."""
        room = out if out.flags.c_contiguous else np.empty(out.shape, out.dtype)
        with self._place.reading(*cut.frames):
            self._dataset.read_direct(room, (slice(*cut.frames), *cut.region.slices))
        if room is not out:
            out[...] = room

    def close(self) -> None:
        """Do nothing: the file is the recording's to close."""
