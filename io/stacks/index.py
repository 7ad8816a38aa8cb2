"""Where the chunks of a dataset lie in its file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """The chunks of a dataset.

    Attributes
    ----------
    shape : (int, int, int)
        Of a chunk, in samples.
    offsets, sizes : ndarray, one element a chunk along each axis, int64
        Where the stored bytes begin, and how many they are.
    left_out : ndarray, likewise
        A bit for each filter that a chunk did not go through.
    """

    shape: tuple[int, int, int]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    left_out: NDArray[np.int64]

    def frame_by_frame(self, itemsize: int) -> ChunkIndex:
        """Return the index of raw chunks as if each were of one frame: parts of them can be read."""
        size = math.prod(self.shape[1:]) * itemsize
        steps = size * np.arange(self.shape[0])[:, None, None]
        offsets = (self.offsets[:, None] + steps).reshape(-1, *self.offsets.shape[1:])
        sizes = np.full_like(offsets, size)
        return ChunkIndex((1, *self.shape[1:]), offsets, sizes, np.zeros_like(offsets))

    def piece(self, shape: tuple[int, int, int]) -> int | None:
        """Return where raw chunks of one frame begin, if each begins where the one before ends."""
        offsets, sizes = self.offsets.ravel()[: shape[0]], self.sizes.ravel()[: shape[0] - 1]
        if self.shape != (1, *shape[1:]) or np.any(np.diff(offsets) != sizes):
            return None
        return int(offsets[0])


def chunk_index(dataset: h5py.Dataset, shape: tuple[int, int, int], size: int) -> ChunkIndex | str:
    """Return where the chunks lie, or why that cannot be said.

    Parameters
    ----------
    dataset : h5py.Dataset
    shape : (int, int, int)
        Its frames, or the first of them, rows and columns.
    size : int
        Bytes of the file.

    Raises
    ------
    OSError, ValueError
        The file is damaged: chunks are missing, or outside the file.
    """
    if dataset.file.userblock_size:
        return "user block"  # HDF5's versions differ in what they count from
    if not hasattr(dataset.id, "chunk_iter"):
        return "old HDF5"
    chunks: list[h5py.h5d.StoreInfo] = []
    dataset.id.chunk_iter(chunks.append)
    grid = tuple(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
    places = np.array([chunk.chunk_offset for chunk in chunks], np.int64) // dataset.chunks
    values = np.array([(chunk.byte_offset, chunk.size, chunk.filter_mask) for chunk in chunks], np.int64)
    wanted = np.all(places < grid, axis=1)
    places, values = places[wanted], values[wanted]
    offsets, sizes, left_out = np.full((3, *grid), -1, np.int64)
    for into, column in zip((offsets, sizes, left_out), values.T, strict=True):
        into[tuple(places.T)] = column
    if np.any(offsets < 0):
        raise ValueError("(chunks are missing)")
    if np.any(offsets + sizes > size):
        raise OSError("truncated: a chunk lies behind the end")
    if _raw_edges(dataset, shape, sizes, left_out):
        return "raw chunks at the edge"
    return ChunkIndex(dataset.chunks, offsets, sizes, left_out)


def _raw_edges(
    dataset: h5py.Dataset, shape: tuple[int, ...], sizes: NDArray[np.int64], left_out: NDArray[np.int64]
) -> bool:
    """Tell whether chunks that are partly outside the dataset may not have gone through its filters.

    A dataset can be made so, and HDF5 does not tell whether one is; but then they have the size of raw ones.
    """
    if not dataset.id.get_create_plist().get_nfilters():
        return False
    edge = np.zeros(sizes.shape, bool)
    for axis, (n, c) in enumerate(zip(shape, dataset.chunks, strict=True)):
        if n % c:
            np.moveaxis(edge, axis, 0)[-1] = True
    raw = math.prod(dataset.chunks) * dataset.dtype.itemsize
    return bool(np.any(edge & (sizes == raw) & (left_out == 0)))
