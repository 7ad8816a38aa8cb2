"""Parts of a stack: a rectangle of the picture, and a range of frames."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple, Self

from mirrorskin.io.base.types import InputError

Span = tuple[int, int]  # first and end

_TEXT = re.compile("([0-9]{1,9}),([0-9]{1,9}),([1-9][0-9]{0,8})x([1-9][0-9]{0,8})")


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of the picture, in pixels; the end is excluded, as for slices.

    Attributes
    ----------
    rows, columns : (int, int)
        First and end.

    Examples
    --------
    >>> Region.read("100,50,640x480").rows
    (50, 530)
    """

    rows: Span
    columns: Span

    @classmethod
    def whole(cls, picture: tuple[int, int]) -> Self:
        """Return the region of a whole picture with the given rows and columns."""
        return cls((0, picture[0]), (0, picture[1]))

    @classmethod
    def read(cls, text: str) -> Self | None:
        """Return the region written by the property ``text``; None for any other text."""
        match = _TEXT.fullmatch(text)
        if match is None:
            return None
        column, row, columns, rows = map(int, match.groups())
        return cls((row, row + rows), (column, column + columns))

    @property
    def text(self) -> str:
        """Its first column and row, and the numbers of columns and rows, as in ``100,50,640x480``."""
        (rows, columns), (row, column) = self.shape, self.origin
        return f"{column},{row},{columns}x{rows}"

    def __str__(self) -> str:
        return f"rows {self.rows[0]}:{self.rows[1]} and columns {self.columns[0]}:{self.columns[1]}"

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
        """The slices that crop a map of the picture to this region."""
        return slice(*self.rows), slice(*self.columns)

    def holds(self, other: Region) -> bool:
        """Return whether this region contains another."""
        return all(
            mine[0] <= its[0] and its[1] <= mine[1]
            for mine, its in ((self.rows, other.rows), (self.columns, other.columns))
        )

    def within(self, outer: Region) -> tuple[slice, slice]:
        """Return the slices that crop a map of another region to this one."""
        (top, column), (rows, columns) = outer.origin, self.slices
        return slice(rows.start - top, rows.stop - top), slice(columns.start - column, columns.stop - column)

    def centre(self, picture: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[float, float]:
        """Return the position of its centre relative to the centre of a picture, mm to the right and up."""
        down = (sum(self.rows) - picture[0]) / 2
        right = (sum(self.columns) - picture[1]) / 2
        return right * pixel_size[0], -down * pixel_size[1]

    def check(self, picture: tuple[int, int], name: str) -> None:
        """Raise InputError if it is not within a picture of the given rows and columns."""
        for axis, (start, stop), count in (
            ("rows", self.rows, picture[0]),
            ("columns", self.columns, picture[1]),
        ):
            if not 0 <= start < stop <= count:
                raise InputError(
                    f"{name}: a region of {axis} {start} to {stop}, where the picture has {count}: "
                    f"give a start from 0 and a larger end up to {count}"
                )


class Selection(NamedTuple):
    """A part of a dataset: the frames, first and end, and the region of the picture."""

    frames: Span
    region: Region


@dataclass(frozen=True, slots=True)
class FrameLabel:
    """Source of frames, for messages: the file, as the user named it, and the dataset."""

    path: str
    dataset: str

    def name(self, start: int, stop: int) -> str:
        """Return the name of the frames ``start`` to ``stop - 1`` in errors of reading them."""
        frames = f"frame {start}" if stop == start + 1 else f"frames {start} to {stop - 1}"
        return f"{self.path}: {frames} of {self.dataset} cannot be read"
