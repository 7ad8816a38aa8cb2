"""Reading of TIFF files page by page, as the series of frames described by their metadata."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.content import TIFF_MARKS, identified
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import check_picture, decode, is_coloured, to_grey
from mirrorskin.io.base.system import check_regular, open_regular
from mirrorskin.io.base.types import FRAME_DTYPES, InputError
from mirrorskin.io.formats.colour_table import ColourTable
from mirrorskin.io.formats.loss import loss_of_jpeg
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.tiff_pages import (
    compare_pages,
    described_pages,
    in_one_piece,
    pictures_in,
    pixel_size,
)
from mirrorskin.io.model.frames import CONVERTED_COLOUR, WholeFrames, lossy, lost_frames

TIFF = Format(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    source="TIFF",
    reader="TiffFrames",
    takes=("dataset", "channel"),
)


_REMEDY = "copy it again, or save it again"
_DTYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64")
_KINDS = ("frame", "imagej", "multipage", "ome", "shaped", "sis", "tiled", "uniform", "virtual")
"""Kinds of TIFF whose metadata are read; the metadata of others may name other files."""

_DESCRIBED = ("imagej", "ome", "shaped")  # kinds whose metadata state the number of pages

_FRAME_AXES = "TZIQ"  # time, depth, and pages in order
_COLOURS = 4  # maximum number of channels that can be colours of one picture; more are frames
_FORMATS = {1: "uint", 2: "int", 3: "float"}  # sample formats (TIFF 6.0, section 19)
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _PALETTE = 0, 1, 3  # photometric interpretations
_PLAIN = tuple(dtype.name for dtype in FRAME_DTYPES)  # types accepted for colour samples as well
_DECODED = {1, 5, 6, 7, 8, 32773, 32946}  # compressions: none, LZW, JPEG, deflate, PackBits
_NONE, _LOSSY = 1, {6: "JPEG", 7: "JPEG", 34892: "JPEG"}  # compressions
_FLOATING = 3  # predictor: the bytes of floating-point samples are reordered
_SEPARATE = 2  # planar configuration: one plane per colour
# Tags of a page that describe the packing of its samples: type and number.
_PACKING = {266: "H", 317: "H", 322: "I", 323: "I", 278: "I"}
_JPEG_TABLES, _SUBSAMPLING, _ORIENTATION = 347, 530, 274
_LAST_UPRIGHT = 4  # orientation; in the others rows and columns are exchanged


class TiffFrames(WholeFrames):
    """The frames of a TIFF: pages, or the time or depth of ImageJ and OME, (T, H, W).

    Samples are read as stored, with three exceptions. If white is zero, they are inverted, so that more light
    is a larger number. Indices of a colour table become the values of the table if it is grey, and are
    unchanged if its brightness increases; any other table is refused. Colours become grey as in ``to_grey``.

    Parameters
    ----------
    path : Path
    dataset : str, optional
        Number of the series, if the file has several.
    channel : int, optional
        Channel of a stack with several, or colour; the first is 0.
    dtypes : sequence of str, optional
        Accepted types of grey samples.
    """

    how = "page by page"
    random_access = True

    def __init__(
        self,
        path: Path,
        dataset: str | None = None,
        channel: int | None = None,
        dtypes: Sequence[str] = _DTYPES,
    ) -> None:
        self._path, self.files, self._channel = path, (path,), channel
        check_regular(path, _REMEDY)
        with _quiet_tifffile(), ExitStack() as opening:
            try:
                self._file = opening.enter_context(_open(path))
                series = list(self._file.series)
                shaped = bool(series) and all(part.kind == "shaped" for part in series)
                if shaped and len(series) > 1 and dataset is None:
                    plain = opening.enter_context(_open(path, "shaped"))
                    if sum(map(pictures_in, series)) == sum(map(pictures_in, plain.series)):  # were appended
                        self._file, series = plain, list(plain.series)
                if not series or not self._ends():
                    raise self._damaged()
                self._metadata = self._file
                series = self._compare_pages(series, opening)
                self._take(_chosen(path, series, dataset), dtypes)
            except InputError:
                raise
            except OSError as error:
                raise InputError(f"{path} cannot be read: {error.strerror or error}") from None
            except Exception as error:  # of many types
                raise self._damaged() from error
            self._close = opening.pop_all().close  # the file stays open until `close`

    def close(self) -> None:
        """Close the file."""
        self._close()

    def _compare_pages(self, series: list[Any], opening: ExitStack) -> list[Any]:
        """Return the series of the metadata, or that of all pages if the metadata state another number.

        The finding for another number is stored.
        """
        path, pages = self._path, self._file.pages
        described = described_pages(self._file, path)
        alone = any(in_one_piece(part, pages) for part in series)
        if alone and len(pages) > len(series):
            raise InputError(f"{path} has pages that its metadata do not describe: save it again")
        if described is None or alone or described.frames == len(pages):
            return series
        if described.by == "ImageJ" and len(pages) == 1:  # its pictures follow each other, as far as they go
            present = max(0, self._file.filehandle.size - pages[0].dataoffsets[0]) // pages[0].nbytes
            raise self._damaged(f" ({described.frames} pictures are stated, and {present} are present)")
        if series[0].kind == "ome" and any(page is None for page in series[0].pages):
            finding = compare_pages(described, sum(page is not None for page in series[0].pages), path)
        else:
            plain = opening.enter_context(_open(path, *_DESCRIBED))
            alike = [part for part in plain.series if part.keyframe.shape == series[0].keyframe.shape]
            if len(alike) != 1:
                return series
            finding = compare_pages(described, pictures_in(alike[0]), path)
            if finding is not None:
                self._file, series = plain, alike
        self.findings = () if finding is None else (finding,)
        return series

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode frames."""
        for number in range(start, stop):
            name = self._name(number)
            yield name, to_grey(self.page(number), name, self._colour)

    def page(self, number: int) -> NDArray[Any]:
        """Decode a frame, (H, W) or (H, W, channels): blue, green, red, opacity."""
        name, index = self._name(number), int(self._numbers[number])
        with _quiet_tifffile():
            try:
                samples = self._stored(index, name)
            except InputError:
                raise
            except Exception as error:  # of many types
                raise InputError(f"{name} cannot be read: it is damaged or cut off; copy it again") from error
        if self._table is not None:
            samples = self._table.look_up(samples)
        if self._inverted:
            samples = ~samples
        return _upright(samples, self._orientation)

    def _damaged(self, how: str = "") -> InputError:
        with open_regular(self._path) as unread:
            is_tiff = unread.read(4) in TIFF_MARKS
        if not is_tiff and (kind := identified(self._path)):
            return InputError(f"{self._path} is not a TIFF, but {kind}")
        wrong = "is damaged or cut off" if is_tiff else "is not a TIFF"
        return InputError(f"{self._path} {wrong}{how}: {_REMEDY}")

    def _ends(self) -> bool:
        """Return whether the chain of pages ends; it does not in a truncated file."""
        self._file.filehandle.seek(self._file.pages.next_page_offset or 0)
        end = self._file.filehandle.read(self._file.tiff.offsetsize)
        return len(end) == self._file.tiff.offsetsize and not any(end)

    def _name(self, number: int) -> str:
        return f"{self._path} (page {int(self._numbers[number]) + 1})"

    def _take(self, series: Any, dtypes: Sequence[str]) -> None:
        """Check the pages of a series, and find the frames among them."""
        page, name = series.keyframe, str(self._path)
        dtype = f"{_FORMATS.get(page.sampleformat, '')}{page.bitspersample}"
        several = page.samplesperpixel > 1 or page.photometric != _BLACK_IS_ZERO
        if page.samplesperpixel not in (1, 3, 4) or dtype not in (_PLAIN if several else dtypes):
            raise InputError(
                f"{name} (page {page.index + 1}) has {page.samplesperpixel} {dtype} a pixel: "
                "save it in grey, as uint8, uint16 or float32"
            )
        if page.compression not in _DECODED:
            kind = getattr(page.compression, "name", page.compression)
            raise InputError(f"{name} is compressed by {kind}: save it with LZW or deflate, or uncompressed")
        if dtype == "float16" and page.predictor == _FLOATING:
            raise InputError(f"{name} is {dtype}, compressed with a predictor: save it uncompressed")
        self.dtype, lines = np.dtype(dtype), _frames_in_lines(series)
        rows, columns = self._picture = lines[1:] if lines else (page.imagelength, page.imagewidth)
        size = rows * columns * page.samplesperpixel * self.dtype.itemsize
        packed = 0 if page.compression == _NONE else min(sum(page.databytecounts), self._file.filehandle.size)
        where, samples = f"{name} (page {page.index + 1})", page.samplesperpixel
        check_picture(where, columns, rows, self.dtype.itemsize, samples, packed, copies=1)
        if lines:
            self._numbers, self._colour = np.arange(lines[0], dtype=np.intp), self._channel
        else:
            self._numbers, self._colour = _numbers(name, series, self._channel)
        if None in series.pages:
            self._leave_out(np.array([page is not None for page in series.pages])[self._numbers])
        self._orientation = _orientation(page)
        turned = self._orientation > _LAST_UPRIGHT
        self.shape = (len(self._numbers), *((columns, rows) if turned else (rows, columns)))
        self._page, self._pages, self._offset = page, series.pages, series.dataoffset
        self._size, self._stored_size = self._file.filehandle.size, size
        self._check_complete()
        self._inverted = page.photometric == _WHITE_IS_ZERO
        if self._inverted and self.dtype.kind == "f":
            raise InputError(
                f"{name}: white is zero, but samples are {self.dtype}: save them with black as zero"
            )
        self._table = _table(name, page) if page.photometric == _PALETTE else None
        self.findings += tuple(self._find(series))

    def _leave_out(self, present: NDArray[np.bool_]) -> None:
        """Leave out frames that the file does not contain, and count those before each of the others."""
        places = np.flatnonzero(present)
        if not places.size:
            raise self._damaged()
        self.lost = (np.diff(places, prepend=-1) - 1).astype(np.int32)
        self._numbers, self.findings = self._numbers[places], (*self.findings, *lost_frames(self.lost))

    def _check_complete(self) -> None:
        """Check that the file contains the samples of all frames."""
        if self._offset is not None:
            end = self._offset + self._stored_size * (int(self._numbers.max(initial=0)) + 1)
            if end > self._size:
                raise self._damaged()
            return
        for number in self._numbers.tolist():
            page = self._pages[number]
            missing = page is None or not page.dataoffsets
            if missing or max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True))) > self._size:
                raise self._damaged()

    def _find(self, series: Any) -> Iterator[Finding]:
        page = self._page
        if page.compression in _LOSSY and loss_of_jpeg(self._first_segment()):
            yield lossy(_LOSSY[page.compression])
        if self._inverted:
            text = "white is zero: samples are inverted, so that more light is more counts"
            yield Finding("white is zero", text, warning=False)
        if self._table is not None:
            yield from self._table.findings
        if page.samplesperpixel > 1 and page.planarconfig == _SEPARATE:
            yield Finding(
                "planar colour",
                f"the {page.samplesperpixel} planes of a picture are read as its colours: if they are frames,"
                " save them with photometric='minisblack'",
            )
        if page.samplesperpixel > 1 and self._colour is None and is_coloured(self.page(0)):
            yield CONVERTED_COLOUR
        if "C" in series.axes and series.axes[0] == "C":
            text = f"{self.shape[0]} channels are read as frames"
            yield Finding("channels", text, warning=False)
        pixel = pixel_size(self._metadata)
        if pixel:
            text = f"the file states pixels of {pixel}: give --pixel-size if this is their size at the sheet"
            yield Finding("pixel size", text, warning=False)

    def _first_segment(self) -> bytes:
        """Return the first strip or tile of the first frame, packed."""
        page = self._pages[int(self._numbers[0])]
        self._file.filehandle.seek(page.dataoffsets[0])
        return bytes(self._file.filehandle.read(page.databytecounts[0]))

    def _stored(self, index: int, name: str) -> NDArray[Any]:
        """Return the samples of a page, (H, W) or (H, W, channels): blue, green, red, opacity."""
        page, (rows, columns) = self._page, self._picture
        samples = page.samplesperpixel
        planar = samples > 1 and page.planarconfig == _SEPARATE
        shape = (samples, rows, columns) if planar else (rows, columns, samples)
        if self._offset is not None:
            place = self._offset + index * self._stored_size
            self._file.filehandle.seek(place)
            data = self._file.filehandle.read(self._stored_size)
            values = np.frombuffer(data, self.dtype.newbyteorder(self._file.byteorder)).reshape(shape)
        elif page.compression == _NONE:
            values = np.asarray(self._pages[index].asarray(maxworkers=1)).reshape(shape)
        else:
            return self._decode(self._pages[index], planar, name)
        values = values.astype(self.dtype, copy=False)
        values = np.moveaxis(values, 0, -1) if planar else values
        return values[..., 0] if samples == 1 else values[..., [2, 1, 0, 3][:samples]]

    def _decode(self, page: Any, planar: bool, name: str) -> NDArray[Any]:
        """Decode the samples of a compressed page with OpenCV, as a TIFF of one page."""
        offsets, counts = page.dataoffsets, page.databytecounts
        planes = self._page.samplesperpixel if planar else 1
        each = len(offsets) // planes
        decoded = []
        for plane in range(planes):
            part = slice(plane * each, (plane + 1) * each)
            segments = []
            for offset, count in zip(offsets[part], counts[part], strict=True):
                self._file.filehandle.seek(offset)
                segments.append(self._file.filehandle.read(count))
            decoded.append(decode(self._packed(segments, 1 if planar else self._page.samplesperpixel), name))
        if self.dtype == np.float16 and decoded[0].dtype == np.uint16:
            decoded = [plane.view(np.float16) for plane in decoded]
        if decoded[0].dtype != self.dtype:
            raise InputError(f"{name} is compressed, and of type {self.dtype}: save it uncompressed")
        return np.stack(decoded[2::-1] + decoded[3:], axis=-1) if planar else decoded[0]

    def _packed(self, segments: list[bytes], samples: int) -> bytes:
        """Return a TIFF of one page whose samples OpenCV decodes without conversion."""
        page, order = self._page, self._file.byteorder
        tags: dict[int, tuple[str, Sequence[int] | bytes]] = {
            256: ("I", [page.imagewidth]),
            257: ("I", [page.imagelength]),
            258: ("H", [page.bitspersample] * samples),
            259: ("H", [int(page.compression)]),
            262: ("H", [int(page.photometric) if samples > 1 else 1]),
            277: ("H", [samples]),
            284: ("H", [1]),
            339: ("H", [1 if self.dtype == np.float16 else int(page.sampleformat)] * samples),
        }
        for code, kind in _PACKING.items():
            if code in page.tags:
                tags[code] = kind, [int(page.tags[code].value)]
        for code, kind in ((_JPEG_TABLES, "B"), (_SUBSAMPLING, "H")):
            if code in page.tags:
                tags[code] = kind, page.tags[code].value
        if samples == 4:
            tags[338] = "H", [1]  # otherwise colours are multiplied by the opacity
        tiled = page.is_tiled
        tags[325 if tiled else 279] = "I", [len(segment) for segment in segments]
        tags[324 if tiled else 273] = "I", [0] * len(segments)
        return _write(tags, 324 if tiled else 273, segments, order)


def _open(path: Path, *without: str) -> Any:
    """Open a TIFF; its metadata are read only if their kind is supported, and not in ``without``."""
    import tifffile

    others = (tifffile.TIFF.FILE_FLAGS - {*_KINDS}) | {*without}
    flags: dict[str, Any] = {f"is_{kind}": False for kind in others}
    return tifffile.TiffFile(path, _multifile=False, **flags)


def _write(
    tags: dict[int, tuple[str, Sequence[int] | bytes]], offsets: int, segments: list[bytes], order: str
) -> bytes:
    """Return the bytes of a TIFF; the values of the tag ``offsets`` are computed."""
    codes = {"B": 7, "H": 3, "I": 4}
    sizes = {code: struct.calcsize(f"={len(values)}{kind}") for code, (kind, values) in tags.items()}
    start = 8 + 2 + 12 * len(tags) + 4
    places = {}
    for code, size in sizes.items():
        if size > 4:
            places[code], start = start, start + size + size % 2
    at = []
    for segment in segments:
        at.append(start)
        start += len(segment)
    tags[offsets] = "I", at
    entries, extra = b"", b""
    for code in sorted(tags):
        kind, values = tags[code]
        packed = struct.pack(f"{order}{len(values)}{kind}", *values)
        entries += struct.pack(f"{order}HHI", code, codes[kind], len(values))
        entries += struct.pack(f"{order}I", places[code]) if code in places else packed.ljust(4, b"\0")
    for code in places:
        kind, values = tags[code]
        packed = struct.pack(f"{order}{len(values)}{kind}", *values)
        extra += packed + bytes(len(packed) % 2)
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, 8)
    return b"".join([head, struct.pack(f"{order}H", len(tags)), entries, bytes(4), extra, *segments])


def _chosen(path: Path, series: list[Any], name: str | None) -> Any:
    """Return a series of a file: the requested one, or the only one."""
    if name is None and len(series) == 1:
        return series[0]
    if name is not None and name.isdecimal() and int(name) < len(series):
        return series[int(name)]
    sizes = ", ".join(f"{number}: {_describe(part)}" for number, part in enumerate(series[:5]))
    if name is not None:
        raise InputError(f"{path} has no series {name!r}: choose from {sizes}")
    raise InputError(f"{path} contains {len(series)} series of pictures, {sizes}: choose one with --dataset")


def _describe(series: Any) -> str:
    return f"{' x '.join(map(str, series.shape))} {series.dtype} ({series.axes})"


def _frames_in_lines(series: Any) -> tuple[int, int, int] | None:
    """Return frames, rows and columns if each page is one line of a frame, because of axes of length 1."""
    page, shape = series.keyframe, [length for length in series.shape if length != 1]
    line = 1 in (page.imagelength, page.imagewidth) and page.samplesperpixel == 1
    if not line or series.dataoffset is None or len(shape) != 3 or series.kind != "shaped":
        return None
    frames, rows, columns = shape
    return frames, rows, columns


def _numbers(name: str, series: Any, channel: int | None) -> tuple[NDArray[np.intp], int | None]:
    """Return the pages of a series that are frames, in order, and the colour to read from each."""
    inner = len(series.keyframe.shape)  # axes within a page: rows, columns, and perhaps colours
    axes, shape = series.axes, series.shape
    if shape[-1] == 1 and axes[-1] not in series.keyframe.axes:
        axes, shape = axes[:-1], shape[:-1]
    axes, shape = axes[: len(axes) - inner], shape[: len(shape) - inner]
    pages = np.arange(int(np.prod(shape, dtype=np.int64)), dtype=np.intp).reshape(shape)
    long = {axis: length for axis, length in zip(axes, shape, strict=True) if length > 1}
    of_frames = [axis for axis, length in zip(axes, shape, strict=True) if length > 1 and axis in _FRAME_AXES]
    if len(of_frames) > 1 or set(long) - {*_FRAME_AXES, "C"}:
        sizes = " x ".join(f"{n} {axis}" for axis, n in zip(axes, shape, strict=True) if n > 1)
        raise InputError(
            f"{name} has the axes {series.axes} ({sizes}), but frames have one order: save one of them"
        )
    if "C" in long and (of_frames or long["C"] <= _COLOURS):
        count = long["C"]
        if channel is None or not 0 <= channel < count:
            what = f"--channel 0 to {count - 1} takes one of them"
            chosen = "" if channel is None else f", and none is number {channel}"
            alone = "" if of_frames else "; if they are frames, save them with the axes TYX"
            raise InputError(f"{name} has {count} channels{chosen}: {what}{alone}")
        return pages.take(channel, axis=axes.index("C")).reshape(-1), None
    if channel is not None and series.keyframe.samplesperpixel == 1:
        raise InputError(f"{name} has one channel: leave --channel out")
    return pages.reshape(-1), channel


def _orientation(page: Any) -> int:
    """Return the orientation of a page, 1 to 8 (TIFF 6.0, section 8)."""
    tag = page.tags.get(_ORIENTATION)
    value = 1 if tag is None else tag.value
    return int(value) if value in range(1, 9) else 1


def _upright(picture: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn and mirror a picture for display."""
    if orientation > _LAST_UPRIGHT:  # the first stored row is a column of the displayed picture
        picture = picture.swapaxes(0, 1)
    return picture[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def _table(name: str, page: Any) -> ColourTable:
    """Return the colour table of a page."""
    colours = (np.asarray(page.colormap).T >> 8).astype(np.uint8)  # of 16 bits
    return ColourTable(name, colours, np.dtype(f"u{page.bitspersample // 8}"))


@contextmanager
def _quiet_tifffile() -> Iterator[None]:
    """Suppress tifffile's messages about damaged files."""
    logger = logging.getLogger("tifffile")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
