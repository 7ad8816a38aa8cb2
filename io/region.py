"""A rectangle of the picture."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from mirrorskin.io.types import InputError

_TEXT = re.compile("([0-9]{1,9}),([0-9]{1,9}),([1-9][0-9]{0,8})x([1-9][0-9]{0,8})")


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of the picture, in pixels; as with slices, the end is the first that is left out.

    Attributes
    ----------
    rows, columns : (int, int)
        First and end.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]

    @classmethod
    def whole(cls, picture: tuple[int, int]) -> Self:
        """Return all of a picture of so many rows and columns."""
        return cls((0, picture[0]), (0, picture[1]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of its first pixel."""
        return self.rows[0], self.columns[0]

    @property
    def slices(self) -> tuple[slice, slice]:
        """What cuts it out of a map."""
        return slice(*self.rows), slice(*self.columns)

    @classmethod
    def read(cls, text: str) -> Self | None:
        """Return the region that ``text`` tells as the property ``text`` does; None of anything else."""
        found = _TEXT.fullmatch(text)
        if found is None:
            return None
        column, row, columns, rows = map(int, found.groups())
        return cls((row, row + rows), (column, column + columns))

    @property
    def text(self) -> str:
        """Its first column and row, and how many of each, as in ``100,50,640x480``."""
        (rows, columns), (row, column) = self.shape, self.origin
        return f"{column},{row},{columns}x{rows}"

    def __str__(self) -> str:
        return f"rows {self.rows[0]}:{self.rows[1]} and columns {self.columns[0]}:{self.columns[1]}"

    def holds(self, other: Region) -> bool:
        """Tell whether another region lies within this."""
        return all(
            mine[0] <= its[0] and its[1] <= mine[1]
            for mine, its in ((self.rows, other.rows), (self.columns, other.columns))
        )

    def within(self, outer: Region) -> tuple[slice, slice]:
        """Return what cuts this out of a map of another region."""
        (top, left), (rows, columns) = outer.origin, self.slices
        return slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)

    def centre(self, picture: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[float, float]:
        """Return where its centre is, mm to the right and up from the centre of a picture of that size."""
        down = (sum(self.rows) - picture[0]) / 2
        right = (sum(self.columns) - picture[1]) / 2
        return right * pixel_size[0], -down * pixel_size[1]

    def check(self, picture: tuple[int, int], name: str) -> None:
        """Raise InputError if it does not lie within a picture of so many rows and columns."""
        for axis, (start, stop), count in zip(
            ("rows", "columns"), (self.rows, self.columns), picture, strict=True
        ):
            if not 0 <= start < stop <= count:
                raise InputError(
                    f"{name}: a region of {axis} {start} to {stop}, where the picture has {count}: "
                    f"give a start from 0 and a larger end up to {count}"
                )


def part_of(process: Mapping[str, object]) -> Region | None:
    """Return the part of the picture that a result says it was made of; None where it says nothing.

    Parameters
    ----------
    process : mapping
        Of the result; one of 'fuse' tells the part of both recordings, which is the same.
    """
    told = (Region.read(str(process.get(name, ""))) for name in ("source_region", "vertical_source_region"))
    return next((region for region in told if region is not None), None)
