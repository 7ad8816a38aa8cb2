"""What a TIFF says of its pages: OpenCV passes over pages that it cannot reach, and over odd samples."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from mmap import mmap
from typing import NamedTuple

# Tags, and what they are where they are absent (TIFF 6.0, sections 8 and 19).
_BITS, _SAMPLES, _FORMAT = 258, 277, 339
_ABSENT = {_BITS: 1, _SAMPLES: 1, _FORMAT: 1}

_FORMATS = {1: "uint", 2: "int", 3: "float"}
_INTEGERS = {1: "B", 3: "H", 4: "I", 16: "Q"}


class Page(NamedTuple):
    """How many samples a pixel of a page has, and their type, as in ``uint16``."""

    samples: int
    dtype: str


def find_pages(data: mmap) -> list[Page]:
    """Follow a TIFF's chain of directories, one a page.

    Parameters
    ----------
    data : mmap
        The file: classic or big, of either byte order.

    Raises
    ------
    ValueError
        It is no TIFF, damaged, or cut off; the message says which.
    """
    file = _File(data)
    pages: list[Page] = []
    seen: set[int] = set()
    try:
        place = file.first
        while (directory := file.number(file.offset, place)) and directory not in seen:
            seen.add(directory)
            tags = _ABSENT | dict(file.tags(directory))
            pages.append(Page(tags[_SAMPLES], f"{_FORMATS.get(tags[_FORMAT], 'sample')}{tags[_BITS]}"))
            place = file.end(directory)
    except (struct.error, OverflowError) as error:
        raise ValueError("is cut off") from error
    if directory or not pages:
        raise ValueError("is damaged")
    return pages


class _File:
    """Reads numbers by the layout that the file begins with."""

    def __init__(self, data: mmap) -> None:
        self._data = data
        self._order = {b"II": "<", b"MM": ">"}.get(data[:2], "")
        version = data[2:4].strip(b"\0")
        if not self._order or version not in (b"*", b"+"):
            raise ValueError("is neither a PNG nor a TIFF")
        self.first, self._count, self.offset = (4, "H", "I") if version == b"*" else (8, "Q", "Q")
        self._entry = 4 + 2 * struct.calcsize(self.offset)

    def number(self, kind: str, place: int) -> int:
        return int(struct.unpack_from(self._order + kind, self._data, place)[0])

    def end(self, directory: int) -> int:
        """Return where the offset of the next directory stands."""
        return directory + struct.calcsize(self._count) + self._entry * self.number(self._count, directory)

    def tags(self, directory: int) -> Iterator[tuple[int, int]]:
        """Return the first value of each tag that matters here."""
        for place in range(directory + struct.calcsize(self._count), self.end(directory), self._entry):
            tag, kind = self.number("H", place), _INTEGERS.get(self.number("H", place + 2))
            if tag in _ABSENT and kind is not None:
                width = struct.calcsize(self.offset)
                value = place + 4 + width
                if self.number(self.offset, place + 4) * struct.calcsize(kind) > width:
                    value = self.number(self.offset, value)
                yield tag, self.number(kind, value)
