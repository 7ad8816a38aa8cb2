"""Picture files: PNG, TIFF, BMP, PGM and JPEG; and pictures for printing."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.content import TIFF_MARKS
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import check_picture, decode, encode, is_coloured, to_grey
from mirrorskin.io.base.system import check_regular, read_regular
from mirrorskin.io.base.types import FRAME_DTYPES, InputError
from mirrorskin.io.formats.colour_table import ColourTable
from mirrorskin.io.formats.loss import loss_of_jpeg
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.tiff import TIFF, TiffFrames
from mirrorskin.io.model.frames import CONVERTED_COLOUR, lossy
from mirrorskin.io.storage.atomic import write_new

PICTURE = Format(
    name="picture",
    suffixes=(".png", ".bmp", ".pgm", ".jpg", ".jpeg"),
    reader="refuse_picture",
)


PICTURE_SUFFIXES = (*PICTURE.suffixes, *TIFF.suffixes)

_DTYPES = (*(dtype.name for dtype in FRAME_DTYPES), "float16")
_PNG_MARK = b"\x89PNG\r\n\x1a\n"
_PNG_HEAD = 33  # bytes of the signature and the first chunk; the pixel size may follow
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_PNG_PALETTE = 3  # colour type
_PNG_COMPRESSION = 16  # cv2.IMWRITE_PNG_COMPRESSION
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_UNPACKED_BYTES = 1 << 20  # bytes unpacked at a time
_INCH = 0.0254  # m
_JPEG_MARK, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_SEQUENTIAL = (0xC0, 0xC1)  # markers of JPEGs that are decoded block by block
_BMP_HEAD = struct.Struct("<2x4s4xIIiiHHI12xI")  # file size, offset, then the header of Windows 3 or later
_BLANK = rb"\s+(?:#[^\n]*\n\s*)*"
_PGM_HEAD = re.compile(rb"P5%b(\d{1,9})%b(\d{1,9})%b(\d{1,5})\s" % (_BLANK, _BLANK, _BLANK))


class Picture(NamedTuple):
    """A decoded picture: (H, W), or (H, W, channels) of blue, green, red and opacity."""

    samples: NDArray[Any]
    findings: tuple[Finding, ...] = ()


def refuse_picture(path: Path) -> NoReturn:
    """Raise InputError: one picture is no stack of frames."""
    check_regular(path)
    raise InputError(f"{path} is one picture, not a stack: name the folder that contains its frames")


def read_picture(path: Path) -> NDArray[Any]:
    """Read the only picture in a file as grey, (H, W), uint8, uint16 or float32; see ``to_grey``."""
    return to_grey(decode_picture(path).samples, str(path))


def decode_picture(path: Path, dtypes: Sequence[str] = _DTYPES) -> Picture:
    """Decode the only picture in a file; ``dtypes`` are the accepted types of a TIFF's samples.

    Indices of a colour table become samples as in `TiffFrames`. Samples of fewer than 8 bits are scaled to 0
    to 255; others are returned unchanged, whatever the number of bits in use.
    """
    if path.suffix.lower() not in TIFF.suffixes:
        data = read_regular(path)
        if data[:4] not in TIFF_MARKS:
            return decode_bytes(data, str(path))
        del data
    with TiffFrames(path, None, None, dtypes) as tiff:
        if tiff.shape[0] != 1:
            raise InputError(f"{path} contains several pages, and one is needed: save each page as a picture")
        samples = tiff.page(0)
        return Picture(samples.astype(np.float32) if samples.dtype == np.float16 else samples, tiff.findings)


def decode_bytes(data: bytes, name: str) -> Picture:
    """Decode a PNG, JPEG, BMP or PGM in memory."""
    if data[:8] == _PNG_MARK:
        picture = _decode_png(data, name)
    elif data[:2] == _JPEG_MARK:
        picture = Picture(_decode_jpeg(data, name), (lossy("JPEG"),) if loss_of_jpeg(data) else ())
    elif data[:2] == b"BM":
        picture = _decode_bmp(data, name)
    elif data[:2] == b"P5":
        picture = Picture(_decode_pgm(data, name))
    else:
        raise InputError(f"{name} is not a PNG, TIFF, BMP, binary PGM or JPEG, or is damaged: save it as PNG")
    colour = (CONVERTED_COLOUR,) if is_coloured(picture.samples) else ()
    return picture._replace(findings=picture.findings + colour)


def _decode_jpeg(data: bytes, name: str) -> NDArray[Any]:
    marker, rows, columns, channels = _jpeg_frame(data, name)
    copies = 1 if marker in _SEQUENTIAL else 3  # the turned picture, and 2 bytes for a coefficient
    check_picture(name, columns, rows, 1, 1 if channels == 1 else 3, len(data), copies)
    if _JPEG_END not in data[-64:]:  # some cameras add padding; OpenCV fills missing parts with grey
        raise InputError(f"{name} is cut off: copy it again")
    return decode(data, name, upright=True)


def _decode_bmp(data: bytes, name: str) -> Picture:
    if len(data) < _BMP_HEAD.size:
        raise InputError(f"{name} is cut off: copy it again")
    _, start, head, width, height, _, bits, packing, colours = _BMP_HEAD.unpack_from(data)
    if head < 40:
        raise InputError(f"{name} is a BMP of OS/2: save it as PNG")
    check_picture(name, abs(width), abs(height), 1, 4 if bits > 24 else 3, len(data))
    if packing == 0 and len(data) < start + -(-width * bits // 32) * 4 * abs(height):
        raise InputError(f"{name} is cut off: copy it again")
    if bits > 8:
        return Picture(decode(data, name))
    count, place = colours or 1 << bits, 14 + head
    table = np.frombuffer(data[place : place + 4 * min(count, 256)], np.uint8).reshape(-1, 4)[:, 2::-1]
    # With a table of equal colours OpenCV returns the indices.
    equal = np.repeat(np.arange(len(table), dtype=np.uint8), 4).tobytes()
    view = memoryview(data)
    indices = decode(b"".join([view[:place], equal, view[place + len(equal) :]]), name)
    indices = indices if indices.ndim == 2 else indices[..., 0]
    colour_table = ColourTable(name, table)
    return Picture(colour_table.look_up(indices), colour_table.findings)


def _decode_pgm(data: bytes, name: str) -> NDArray[Any]:
    match = _PGM_HEAD.match(data)
    columns, rows, highest = map(int, match.groups()) if match else (0, 0, 0)
    kind = np.dtype(">u2" if highest > 255 else "u1")
    if match is None or not 0 < highest < 65536 or len(data) - match.end() < rows * columns * kind.itemsize:
        raise InputError(f"{name} is damaged or cut off: copy it again")
    check_picture(name, columns, rows, kind.itemsize, packed=len(data))
    samples = np.frombuffer(data, kind, rows * columns, match.end()).reshape(rows, columns)
    return samples.astype(kind.newbyteorder("="))


def _decode_png(data: bytes, name: str) -> Picture:
    chunks = _essential_chunks(data, name)
    head = bytes(chunks[0].whole[8:21]).ljust(13, b"\0")
    width, height, depth, colour, interlaced = struct.unpack_from(">IIBB2xB", head)
    channels = {0: 1, 2: 3}.get(colour, 4)
    # OpenCV holds a second picture, because a PNG may be animated.
    check_picture(name, width, height, 2 if depth == 16 else 1, channels, len(data), copies=1)
    needed = _png_bytes(width, height, depth * _PNG_CHANNELS.get(colour, 1), bool(interlaced))
    packed = (chunk.whole[8:-4] for chunk in chunks if chunk.kind == b"IDAT")
    if [chunk.kind for chunk in chunks].count(b"IHDR") != 1 or not _unpack_to(packed, needed):
        raise InputError(f"{name} is damaged: it is not one picture of {width} x {height}. Copy it again")
    tables = [chunk.whole[8:-4] for chunk in chunks if chunk.kind == b"PLTE"]
    if colour != _PNG_PALETTE or len(tables) != 1 or len(tables[0]) % 3:
        return Picture(decode(b"".join([_PNG_MARK, *(chunk.whole for chunk in chunks)]), name))
    # As a grey picture of the same bits, OpenCV returns the indices, scaled to 8 bits.
    grey = _png_chunk(b"IHDR", head[:9] + b"\0" + head[10:])
    others = (chunk.whole for chunk in chunks[1:] if chunk.kind != b"PLTE")
    indices = decode(b"".join([_PNG_MARK, grey, *others]), name)
    table = ColourTable(name, np.frombuffer(tables[0], np.uint8).reshape(-1, 3))
    indices //= 255 // ((1 << depth) - 1)
    return Picture(table.look_up(indices), table.findings)


def _png_bytes(width: int, height: int, bits: int, interlaced: bool) -> int:
    """Return the unpacked size of the pixels of a PNG in bytes (PNG, section 7)."""
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = ((-((first - width) // across), -((top - height) // down)) for first, top, across, down in passes)
    return sum(rows * (1 + -(-columns * bits // 8)) for columns, rows in sizes if columns > 0)


def _unpack_to(pieces: Iterable[bytes | memoryview], size: int) -> bool:
    """Return whether the pixels of a PNG have at least ``size`` bytes; otherwise libpng prints messages."""
    unpacker = zlib.decompressobj()
    try:
        for packed in pieces:
            while packed and size > 0:
                size -= len(unpacker.decompress(packed, _UNPACKED_BYTES))
                packed = unpacker.unconsumed_tail
    except zlib.error:
        return False
    return size <= 0


def _jpeg_frame(data: bytes, name: str) -> tuple[int, int, int, int]:
    """Return marker, rows, columns and channels of the frame of a JPEG (ITU-T T.81, B.2.2)."""
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return marker, *struct.unpack_from(">HHB", data, at + 5)
        at += 1 if marker == 0xFF else 2 + length
    raise InputError(f"{name} is damaged or cut off: copy it again")


def save_print(picture: NDArray[np.uint8], path: str | Path, dots_per_inch: float) -> None:
    """Write a grey picture (H, W) as a PNG with its pixel size; the file appears complete or not at all."""
    size = _INCH / dots_per_inch
    write_new(Path(path), encode_png(picture, (size, size)))


def encode_png(
    picture: NDArray[Any], pixel_size: tuple[float, float], texts: Iterable[tuple[str, str]] = ()
) -> list[bytes]:
    """Encode a grey picture (H, W) as a PNG with the width and height of its pixels, m, and named texts."""
    png = encode(".png", picture, (_PNG_COMPRESSION, 6))
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


class _Chunk(NamedTuple):
    kind: bytes
    whole: memoryview  # size, kind, contents and checksum


def _essential_chunks(data: bytes, name: str) -> list[_Chunk]:
    """Check each chunk of a PNG, and keep those needed for the picture: others may make libpng print."""
    kept, at, kind, view = list[_Chunk](), len(_PNG_MARK), b"", memoryview(data)
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        chunk, at = view[at : at + 12 + size], at + 12 + size
        kind = bytes(chunk[4:8])
        if at > len(data) or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            raise InputError(f"{name} is damaged or cut off: copy it again")
        if kind[:1].isupper():
            kept.append(_Chunk(kind, chunk))
    return kept
