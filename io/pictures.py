"""Picture files: PNG, TIFF with one or several pages; and pictures for printing."""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import write_new
from mirrorskin.io.os_errors import check_regular, check_unpacked, open_regular, read_regular
from mirrorskin.io.types import FRAME_DTYPES, InputError

TIFF_SUFFIXES = (".tif", ".tiff")
PICTURE_SUFFIXES = (".png", *TIFF_SUFFIXES)

_DTYPES = [dtype.name for dtype in FRAME_DTYPES]
_PNG_MARK = b"\x89PNG\r\n\x1a\n"
_TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_HEAD = 33  # bytes of the signature and the first chunk; the pixel size may follow
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_PIECE = 1 << 20  # bytes unpacked at a time
_INCH = 0.0254  # m
_FORMATS = {1: "uint", 2: "int", 3: "float"}  # sample formats (TIFF 6.0, section 19)
_JPEG_MARK = b"\xff\xd8"
_JPEG_BYTES = 8  # bytes per pixel in a decoder: a progressive JPEG has three coefficients of 2 bytes
_SMALLER = "save it as smaller pictures"
_UNDECODABLE = "cannot be decoded: it is damaged, or of a kind that OpenCV does not read"


def read_picture(path: Path) -> NDArray[Any]:
    """Read the only picture in a PNG or TIFF, (H, W), uint8, uint16 or float32.

    Colour is converted to grey: to the common value of equal channels, otherwise to the luma of ITU-R BT.601,
    0.299 R + 0.587 G + 0.114 B, as computed by OpenCV. Opacity is ignored.
    """
    return _grey(decode_picture(path))


def decode_picture(path: Path, dtypes: Sequence[str] = _DTYPES) -> NDArray[Any]:
    """Decode the only picture in a PNG or TIFF as stored, (H, W) or (H, W, channels)."""
    data = read_regular(path)
    if data[:8] == _PNG_MARK:
        return _decode_png(data, str(path), -1)
    if count_pages(path, dtypes) != 1:
        raise InputError(f"{path} holds several pages, and one is needed: save each page as a picture")
    return _decode(data, str(path), -1)


def decode_grey(data: bytes, name: str) -> NDArray[Any]:
    """Decode a PNG or JPEG in memory as grey samples, (H, W), of 8 or 16 bits."""
    import cv2

    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    if data[:8] == _PNG_MARK:
        return _decode_png(data, name, flags)
    check_unpacked(_JPEG_BYTES * math.prod(_jpeg_size(data, name)), name, _SMALLER)
    return _decode(data, name, flags)


def _decode(data: bytes, name: str, flags: int) -> NDArray[Any]:
    with quiet_opencv() as cv2:
        try:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            picture = None
    if picture is None:
        raise InputError(f"{name} {_UNDECODABLE}")
    return np.asarray(picture)


def _decode_png(data: bytes, name: str, flags: int) -> NDArray[Any]:
    chunks = _essential_chunks(data, name)
    essential = b"".join([_PNG_MARK, *chunks])
    head = struct.unpack_from(">IIBB2xB", essential.ljust(_PNG_HEAD, b"\0"), 16)
    width, height, depth, colour, interlaced = head
    size = width * height * (2 if depth == 16 else 1) * (1 if colour == 0 else 4)
    check_unpacked(size, f"{name}: a picture of {width} x {height}", _SMALLER)
    needed = _png_bytes(width, height, depth * _PNG_CHANNELS.get(colour, 1), bool(interlaced))
    packed = (chunk[8:-4] for chunk in chunks if chunk[4:8] == b"IDAT")
    if [chunk[4:8] for chunk in chunks].count(b"IHDR") != 1 or not _unpack_to(packed, needed):
        raise InputError(f"{name} is damaged: it is not one picture of {width} x {height}. Copy it again")
    return _decode(essential, name, flags)


def _png_bytes(width: int, height: int, bits: int, interlaced: bool) -> int:
    """Return the unpacked size of the pixels of a PNG in bytes (PNG, section 7)."""
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = ((-((left - width) // across), -((top - height) // down)) for left, top, across, down in passes)
    return sum(rows * (1 + -(-columns * bits // 8)) for columns, rows in sizes if columns > 0)


def _unpack_to(pieces: Iterable[bytes], size: int) -> bool:
    """Return whether the pixels of a PNG have at least ``size`` bytes; libpng prints messages about fewer."""
    unpacker = zlib.decompressobj()
    try:
        for packed in pieces:
            while packed and size > 0:
                size -= len(unpacker.decompress(packed, _PIECE))
                packed = unpacker.unconsumed_tail
    except zlib.error:
        return False
    return size <= 0


def _jpeg_size(data: bytes, name: str) -> tuple[int, int]:
    """Return the rows and columns stated by a JPEG (ITU-T T.81, B.2.2)."""
    at = 2 if data[:2] == _JPEG_MARK else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            rows, columns = struct.unpack_from(">HH", data, at + 5)
            return rows, columns
        at += 1 if marker == 0xFF else 2 + length
    raise InputError(f"{name} is neither a PNG nor a JPEG, or is damaged: save it as PNG or JPEG")


def count_pages(path: Path, dtypes: Sequence[str] = _DTYPES) -> int:
    """Count the pages of a TIFF, which must have one size and one of the supported data types."""
    import tifffile

    remedy = "copy it again, or save it again"
    check_regular(path, remedy)
    with _quiet_tifffile():
        try:
            with tifffile.TiffFile(path) as file:
                kinds = [_page_kind(file.pages.get(number)) for number in range(len(file.pages))]
                file.filehandle.seek(file.pages.next_page_offset or 0)
                end = file.filehandle.read(file.tiff.offsetsize)
                complete = len(end) == file.tiff.offsetsize and not any(end)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
        except Exception:  # of many types
            complete = False
    if not complete:
        with open_regular(path) as unread:
            known = unread.read(4) in _TIFF_MARKS
        wrong = "is damaged or cut off" if known else "is neither a PNG nor a TIFF"
        raise InputError(f"{path} {wrong}: {remedy}")
    for number, kind in enumerate(kinds, 1):
        if kind.samples not in (1, 3, 4) or kind.dtype not in dtypes:
            raise InputError(
                f"{path} (page {number}) has {kind.samples} {kind.dtype} a pixel: "
                "save it in grey, as uint8, uint16 or float32"
            )
        size = kind.rows * kind.columns * kind.samples * np.dtype(kind.dtype).itemsize
        check_unpacked(size, f"{path} (page {number}): a picture of {kind.columns} x {kind.rows}", _SMALLER)
        if (kind.rows, kind.columns) != (kinds[0].rows, kinds[0].columns):
            raise InputError(
                f"{path} (page {number}) is {kind.columns} x {kind.rows} {kind.dtype}, but "
                f"{path} (page 1) is {kinds[0].columns} x {kinds[0].rows} {kinds[0].dtype}: "
                "all frames must have the same size and depth"
            )
    return len(kinds)


class _PageKind(NamedTuple):
    rows: int
    columns: int
    samples: int
    dtype: str


def _page_kind(page: Any) -> _PageKind:
    dtype = f"{_FORMATS.get(page.sampleformat, '')}{page.bitspersample}"
    return _PageKind(page.imagelength, page.imagewidth, page.samplesperpixel, dtype)


def read_pages(path: Path, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Read pages ``start`` to ``stop - 1`` of a TIFF, each with its name in messages."""
    with quiet_opencv() as cv2:
        try:
            _, pages = cv2.imreadmulti(str(path), start, stop - start, flags=cv2.IMREAD_UNCHANGED)
        except cv2.error:
            pages = ()
    for index in range(start, stop):
        label = f"{path} (page {index + 1})"
        if index - start >= len(pages):
            raise InputError(f"{label} {_UNDECODABLE}")
        yield label, _grey(pages[index - start])


def save_print(picture: NDArray[np.uint8], path: str | Path, dots_per_inch: float) -> None:
    """Write a grey picture (H, W) as a PNG with its pixel size; the file appears complete or not at all."""
    size = _INCH / dots_per_inch
    write_new(Path(path), encode_png(picture, (size, size)))


def encode_png(
    picture: NDArray[Any], pixel_size: tuple[float, float], texts: Iterable[tuple[str, str]] = ()
) -> list[bytes]:
    """Encode a grey picture (H, W) as a PNG with the width and height of its pixels, m, and named texts."""
    with quiet_opencv() as cv2:
        _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    png = encoded.tobytes()
    x, y = (round(1 / size) for size in pixel_size)
    chunks = [_png_chunk(b"pHYs", struct.pack(">IIB", x, y, 1)), *(_png_text(*text) for text in texts)]
    return [png[:_PNG_HEAD], *chunks, png[_PNG_HEAD:]]


def _png_text(name: str, text: str) -> bytes:
    try:
        return _png_chunk(b"tEXt", f"{name}\0{text}".encode("latin-1"))
    except UnicodeEncodeError:
        return _png_chunk(b"iTXt", f"{name}\0\0\0\0\0{text}".encode())


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _essential_chunks(data: bytes, name: str) -> list[bytes]:
    """Check each chunk of a PNG, and keep those needed for the picture: libpng prints about the others."""
    kept, at, kind = list[bytes](), len(_PNG_MARK), b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        chunk, at = data[at : at + 12 + size], at + 12 + size
        kind = chunk[4:8]
        if at > len(data) or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            raise InputError(f"{name} is damaged or cut off: copy it again")
        if kind[:1].isupper():
            kept.append(chunk)
    return kept


@contextmanager
def quiet_opencv() -> Iterator[Any]:
    """Yield OpenCV with its messages turned off: callers report errors themselves."""
    import cv2  # slower to import than the rest of mirrorskin.io together

    # OpenCV 5 moved this function.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    level = set_level(0)
    try:
        yield cv2
    finally:
        set_level(level)


@contextmanager
def _quiet_tifffile() -> Iterator[None]:
    """Keep tifffile's messages about damaged files off the terminal."""
    logger = logging.getLogger("tifffile")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


def _grey(picture: NDArray[Any]) -> NDArray[Any]:
    if picture.ndim == 2:
        return picture
    first = picture[..., 0]
    if all(np.array_equal(first, picture[..., channel], equal_nan=True) for channel in (1, 2)):
        return first
    with quiet_opencv() as cv2:
        return np.asarray(cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY))
