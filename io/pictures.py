"""Frames from pictures: a folder of numbered ones, or the pages of a TIFF; and pictures for printing."""

from __future__ import annotations

import logging
import re
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.atomic import write_new
from mirrorskin.io.frames import FrameSequence, quiet_opencv
from mirrorskin.io.positions import Positions
from mirrorskin.io.types import FRAME_DTYPES, Header, InputError

TIFF_SUFFIXES = (".tif", ".tiff")
PICTURE_SUFFIXES = (".png", *TIFF_SUFFIXES)

_DTYPES = [dtype.name for dtype in FRAME_DTYPES]
_PNG_MARK = b"\x89PNG\r\n\x1a\n"
_TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_HEAD = 33  # bytes of the mark and the first chunk, after which the pixels' size may be written
_INCH = 0.0254  # m
_FORMATS = {1: "uint", 2: "int", 3: "float"}  # of samples (TIFF 6.0, section 19)
_UNDECODABLE = "cannot be decoded: it is damaged, or of a kind that OpenCV does not read"


def read_picture(path: Path) -> NDArray[Any]:
    """Read the only picture of a PNG or TIFF, (H, W), uint8, uint16 or float32.

    Colour becomes grey: where the channels are equal, their common value; else the luma of ITU-R BT.601,
    0.299 R + 0.587 G + 0.114 B, as OpenCV computes it. Opacity is ignored.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    if data[:8] != _PNG_MARK:
        if count_pages(path) != 1:
            raise InputError(f"{path} holds several pages: put it alone, or save each page as a picture")
        return next(read_pages(path, 0, 1))[1]
    with quiet_opencv() as cv2:
        try:
            picture = cv2.imdecode(np.frombuffer(_essential_png(data, path), np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            picture = None
    if picture is None:
        raise InputError(f"{path} {_UNDECODABLE}")
    return _grey(picture)


def count_pages(path: Path) -> int:
    """Count the pages of a TIFF, all of samples that frames can have."""
    import tifffile

    remedy = "copy it again, or save it anew"
    with _quiet_tifffile():
        try:
            with tifffile.TiffFile(path) as file:
                pages: list[Any] = [file.pages.get(number) for number in range(len(file.pages))]
                kinds = [
                    (page.samplesperpixel, f"{_FORMATS.get(page.sampleformat, '')}{page.bitspersample}")
                    for page in pages
                ]
                file.filehandle.seek(file.pages.next_page_offset or 0)
                end = file.filehandle.read(file.tiff.offsetsize)
                complete = len(end) == file.tiff.offsetsize and not any(end)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
        except Exception:  # of many kinds
            complete = False
    if not complete:
        with path.open("rb") as unread:
            known = unread.read(4) in _TIFF_MARKS
        wrong = "is damaged or cut off" if known else "is neither a PNG nor a TIFF"
        raise InputError(f"{path} {wrong}: {remedy}")
    for number, (samples, dtype) in enumerate(kinds, 1):
        if samples not in (1, 3, 4) or dtype not in _DTYPES:
            raise InputError(
                f"{path} (page {number}) has {samples} {dtype} a pixel: "
                "save it in grey, as uint8, uint16 or float32"
            )
    return len(kinds)


def read_pages(path: Path, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Read pages ``start`` to ``stop - 1`` of a TIFF, each with what to call it in messages."""
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
    """Write a grey picture (H, W) as a PNG that says how large its pixels are, whole or not at all."""
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


class Pictures(FrameSequence):
    """A stack of PNG or TIFF pictures, 8 or 16 bits or (TIFF) float32, as a source that can be rewound.

    In a folder, the frames are the pictures whose names are alike but for one number, the last that differs,
    and they come in its order: ``image2.png`` before ``image10.png``. Numbers may start anywhere; one that is
    missing is a frame that was lost, so the block after it says ``dropped``. A TIFF's pages are in order.
    Colour becomes grey as in ``read_picture``.
    """

    def __init__(
        self,
        path: str | Path,
        header: Header,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
    ) -> None:
        self._path = Path(path)
        self._folder = _find_sequence(self._path) if self._path.is_dir() else None
        count = len(self._folder.files) if self._folder else _count_frames(self._path)
        self._first, first = next(self._pictures(0, 1))
        super().__init__(
            str(path),
            header,
            (count, *first.shape),
            first.dtype,
            travel=travel,
            phase=phase,
            lost=self._folder.lost if self._folder else None,
            left_out=self._folder.left_out if self._folder else (),
        )

    def _fill(self, start: int, out: NDArray[Any]) -> None:
        for frame, (label, picture) in zip(out, self._pictures(start, start + len(out)), strict=True):
            if picture.shape != frame.shape or picture.dtype != frame.dtype:
                raise InputError(
                    f"{label} is {_kind(picture)}, but {self._first} is {_kind(frame)}: "
                    "all frames must have the same size and depth"
                )
            frame[...] = picture

    def _pictures(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        if self._folder is None:
            return read_pages(self._path, start, stop)
        return ((str(file), read_picture(file)) for file in self._folder.files[start:stop])


class _Folder(NamedTuple):
    files: list[Path]
    lost: list[int]
    left_out: tuple[str, ...]


def _find_sequence(folder: Path) -> _Folder:
    """Find the numbered pictures of a folder, in order, and how many are missing before each."""
    try:
        files = sorted(file for file in folder.iterdir() if file.is_file())
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from error
    families = _families([f for f in files if f.suffix.lower() in PICTURE_SUFFIXES and f.name[0] != "."])
    if not families:
        raise InputError(
            f"{folder} holds no numbered PNG or TIFF pictures: name them frame1.png, frame2.png, ..."
        )
    most = max(map(len, families.values()))
    rivals = [family for family in families if len(families[family]) >= min(most, 2)]
    if len(rivals) > 1:
        patterns = ", ".join(f"{before}#{after}" for before, after in rivals[:3])
        raise InputError(f"{folder} holds {len(rivals)} sequences, {patterns}: keep one in the folder")
    frames = sorted(families[rivals[0]])
    for (number, file), (following, twin) in pairwise(frames):
        if number == following:
            raise InputError(f"{file} and {twin.name} have the same number: remove one of them")
    numbers = [number for number, _ in frames]
    chosen = {file: None for _, file in frames}
    lost = [0, *(after - before - 1 for before, after in pairwise(numbers))]
    return _Folder(list(chosen), lost, tuple(file.name for file in files if file not in chosen))


def _families(files: list[Path]) -> dict[tuple[str, str], list[tuple[int, Path]]]:
    """Group files by what stands before and after the last number in which some of them differ."""
    places = {
        file: [
            (file.stem[: match.start()], int(match.group()), file.stem[match.end() :])
            for match in re.finditer("[0-9]+", file.stem)
        ]
        for file in files
    }
    alike = Counter((before, after) for found in places.values() for before, _, after in found)
    families = defaultdict(list)
    for file, found in places.items():
        if found:
            differing = [place for place in found if alike[place[0], place[2]] > 1]
            before, number, after = (differing or found)[-1]
            families[before, after].append((number, file))
    return families


def _count_frames(path: Path) -> int:
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if path.suffix.lower() not in TIFF_SUFFIXES:
        raise InputError(f"{path} is no stack of frames: name the folder that its pictures are in")
    return count_pages(path)


def _kind(picture: NDArray[Any]) -> str:
    rows, columns = picture.shape
    return f"{columns} x {rows} {picture.dtype}"


def _essential_png(data: bytes, path: Path) -> bytes:
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


@contextmanager
def _quiet_tifffile() -> Iterator[None]:
    """Keep what tifffile says of damaged files off the terminal."""
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
