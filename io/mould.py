"""Files of a form that was written before: the same bytes, but for the values in them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Mould:
    """What an HDF5 file has around its values, to be poured out around others of the same shapes and types.

    HDF5 takes longer to lay out a small file than it takes to write it. What it lays out depends on names,
    shapes and types alone; the values themselves lie untouched between.

    Attributes
    ----------
    order : tuple of bytes and int
        The file from begin to end: bytes, or the number of a value.
    """

    order: tuple[bytes | int, ...]

    @classmethod
    def of(cls, descriptor: int, places: Sequence[tuple[int, int]]) -> Self:
        """Take the mould of a file.

        Parameters
        ----------
        descriptor : int
            Of the file, which HDF5 is done with.
        places : sequence of (int, int)
            Where each value begins, and how many bytes it has.
        """
        order: list[bytes | int] = []
        end = 0
        for number in sorted(range(len(places)), key=places.__getitem__):
            start, size = places[number]
            if size:
                order += [os.pread(descriptor, start - end, end), number]
                end = start + size
        order.append(os.pread(descriptor, os.fstat(descriptor).st_size - end, end))
        return cls(tuple(order))

    def pour(self, descriptor: int, values: Sequence[NDArray[Any]]) -> None:
        """Write an empty file with values of the same shapes and types, in the same order."""
        with open(descriptor, "wb", closefd=False) as file:
            for piece in self.order:
                if isinstance(piece, bytes):
                    file.write(piece)
                else:
                    file.write(np.ascontiguousarray(values[piece]).reshape(-1).view(np.uint8).data)
