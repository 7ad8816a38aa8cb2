"""One PNG or TIFF as grey frames: checked for damage, decoded by OpenCV."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.sequence import quiet_opencv
from mirrorskin.io.tiff import find_pages
from mirrorskin.io.types import FRAME_DTYPES, InputError

TIFF_SUFFIXES = (".tif", ".tiff")
PICTURE_SUFFIXES = (".png", *TIFF_SUFFIXES)

_DTYPES = [dtype.name for dtype in FRAME_DTYPES]
_PNG_MARK = b"\x89PNG\r\n\x1a\n"


def read_picture(path: Path) -> NDArray[Any]:
    """Read the only picture of a file.

    Parameters
    ----------
    path : Path
        PNG or TIFF.

    Returns
    -------
    ndarray, (H, W), uint8, uint16 or float32
        Colour becomes grey: where the channels are equal, their common value; else the luma of ITU-R BT.601,
        0.299 R + 0.587 G + 0.114 B, as OpenCV computes it. Opacity is ignored.

    Raises
    ------
    InputError
        The file is damaged, neither PNG nor TIFF, of several pages, or of another type of sample.
    """
    contents = _contents(path)
    encoded: bytes | mmap = contents
    if contents[:8] == _PNG_MARK:
        encoded = _essential_png(contents, path)
    elif _check_pages(contents, path) != 1:
        raise InputError(f"{path} holds several pages: put it alone, or save each page as a picture")
    with quiet_opencv() as cv2:
        try:
            picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            picture = None
    if picture is None:
        raise InputError(f"{path} cannot be decoded: it is damaged, or of a kind that OpenCV does not read")
    return _grey(picture)


def count_pages(path: Path) -> int:
    """Count the pages of a TIFF.

    Raises
    ------
    InputError
        The file cannot be read, is no TIFF, is cut off, or has samples of another type.
    """
    return _check_pages(_contents(path), path)


def read_pages(path: Path, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Read pages ``start`` to ``stop - 1`` of a TIFF, each with what to call it in messages.

    Raises
    ------
    InputError
        As for ``read_picture``.
    """
    with quiet_opencv() as cv2:
        try:
            _, pages = cv2.imreadmulti(str(path), start, stop - start, flags=cv2.IMREAD_UNCHANGED)
        except cv2.error:
            pages = ()
    for index in range(start, stop):
        label = f"{path} (page {index + 1})"
        if index - start >= len(pages):
            raise InputError(
                f"{label} cannot be decoded: it is damaged, or of a kind that OpenCV does not read"
            )
        yield label, _grey(pages[index - start])


def _contents(path: Path) -> mmap:
    try:
        with path.open("rb") as file:
            return mmap(file.fileno(), 0, access=ACCESS_READ)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} is empty: copy it again") from error


def _essential_png(data: mmap, path: Path) -> bytes:
    """Check each chunk of a PNG, and keep those that make the picture: libpng prints about the others."""
    kept, at, kind = [data[:8]], 8, b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        chunk, at = data[at : at + 12 + size], at + 12 + size
        kind = chunk[4:8]
        if at > len(data) or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            raise InputError(f"{path} is damaged or cut off: copy it again")
        if kind[:1].isupper():
            kept.append(chunk)
    return b"".join(kept)


def _check_pages(contents: mmap, path: Path) -> int:
    """Count the pages of a TIFF, all of samples that frames can have."""
    try:
        pages = find_pages(contents)
    except ValueError as error:
        raise InputError(f"{path} {error}: copy it again, or save it anew") from error
    for number, page in enumerate(pages, 1):
        if page.samples not in (1, 3, 4) or page.dtype not in _DTYPES:
            raise InputError(
                f"{path} (page {number}) has {page.samples} {page.dtype} a pixel: "
                "save it in grey, as uint8, uint16 or float32"
            )
    return len(pages)


def _grey(picture: NDArray[Any]) -> NDArray[Any]:
    if picture.ndim == 2:
        return picture
    first = picture[..., 0]
    if all(np.array_equal(first, picture[..., channel], equal_nan=True) for channel in (1, 2)):
        return first
    with quiet_opencv() as cv2:
        return np.asarray(cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY))
