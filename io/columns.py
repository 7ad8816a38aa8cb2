"""Numbers of each frame, in a file that grows."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

_AT_ONCE = 1 << 14  # rows for which there is room at once


class Column:
    """A dataset with one row a frame, to which rows are appended.

    Parameters
    ----------
    file : h5py.File
    name : str
    unit : str or None
    dtype : dtype
    expected : int
        How many rows there will be; there may be more.
    width : tuple of int, optional
        Shape of a row.
    """

    def __init__(
        self,
        file: h5py.File,
        name: str,
        unit: str | None,
        dtype: Any,
        expected: int,
        width: tuple[int, ...] = (),
    ) -> None:
        chunk = (min(max(expected, 64), _AT_ONCE), *width)
        # With a first row, its place in the file is found before the first frame.
        blank = np.zeros((1, *width), dtype)
        self._dataset = file.create_dataset(name, data=blank, chunks=chunk, maxshape=(None, *width))
        if unit is not None:
            self._dataset.attrs["units"] = unit
        self._width, self._count, self._waiting = width, 0, list[NDArray[Any]]()

    def append(self, rows: NDArray[Any] | None, count: int) -> None:
        """Take the rows of so many frames more, NaN if they are unknown; ``flush`` writes them."""
        self._waiting.append(np.full((count, *self._width), np.nan) if rows is None else np.array(rows))

    def flush(self) -> None:
        """Give HDF5 the rows that wait."""
        if self._waiting:
            self.write(self._count, np.concatenate(self._waiting))
            self._waiting.clear()

    def write(self, start: int, rows: NDArray[Any]) -> None:
        """Write rows, also over others."""
        stop = start + len(rows)
        if stop > self._count:
            self._dataset.resize(stop, axis=0)
            self._count = stop
        self._dataset[start:stop] = rows

    def correct(self, rows: NDArray[Any]) -> None:
        """Replace the first rows by better ones, where these are finite."""
        rows = rows[: self._count]
        kept = self._dataset[: len(rows)]
        self.write(0, np.where(np.isfinite(rows), rows, kept))


class Marks:
    """Whether each frame was used, which may be told of frames that were written already, or are yet to be.

    Parameters
    ----------
    column : Column
        Of one byte a frame.
    """

    def __init__(self, column: Column) -> None:
        self._column = column
        self._used = bytearray()
        self._first = 0  # of those that changed

    def mark(self, index: int, used: NDArray[np.bool_]) -> None:
        """Say whether frames, from number ``index`` on, were used."""
        self._extend(index + len(used))
        self._used[index : index + len(used)] = used.tobytes()
        self._first = min(self._first, index)

    def flush(self, count: int) -> None:
        """Give HDF5 what is new of so many frames; those that nobody marked were used."""
        self._extend(count)
        if self._first < count:
            rows = np.frombuffer(bytes(self._used[self._first : count]), np.uint8)
            self._column.write(self._first, rows)
        self._first = max(self._first, count)

    def _extend(self, count: int) -> None:
        self._used.extend(b"\1" * (count - len(self._used)))
