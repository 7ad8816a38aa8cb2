"""What other programs read: PLY, STL, XYZ, PNG, TIFF and NPZ."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.mesh import Mesh, face_vectors
from mirrorskin.io.os_errors import legible
from mirrorskin.io.result import UNITS
from mirrorskin.io.types import Floats, InputError, Result

SOFTWARE, DATE, SOURCE = "software", "date", "source"
_TOLD = {SOURCE: "source", DATE: "date", "turn": "turn"}


def notes_of(result: Result) -> dict[str, str]:
    """Tell where heights come from, from where they count, and how many were not measured."""
    process = result.process
    maker = " ".join(str(process[name]) for name in ("program", "version") if name in process)
    notes = {name: _line(process[key]) for name, key in _TOLD.items() if key in process}
    if maker:
        notes[SOFTWARE] = _line(maker)
    notes["heights"] = tell_zero(result)
    if result.height is not None and result.filled is not None and result.filled.any():
        known = np.isfinite(result.height)
        filled, of = np.count_nonzero(known & (result.filled > 0)), np.count_nonzero(known)
        notes["filled"] = f"{filled} of {of} heights were not measured but filled"
    return notes


def tell_zero(result: Result) -> str:
    """Say from where heights count: not from the rest sheet where their offset is unknown."""
    unknown = result.offset_unknown
    count, of = (0, 0) if unknown is None else (np.count_nonzero(unknown), unknown.size)
    if not count:
        return "from the sheet at rest"
    return f"relative{'' if count == of else f' in {count} of {of} pieces'}: the mean of a piece is 0"


def _line(value: object) -> str:
    return legible(" ".join(str(value).split()))


NORMAL = "nx", "ny", "nz"
POINT_UNITS = dict.fromkeys(("x", "y", "z", "sigma"), "mm")
"""Of a point's columns; the others have none."""


def grid_of(result: Result) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Return the heights and the places of a result that is known to have them."""
    assert result.height is not None
    assert result.x is not None
    assert result.y is not None
    return result.height, result.x, result.y


def points_of(result: Result, pixels: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """Return columns, one value a point."""
    height, x, y = grid_of(result)
    chosen = np.flatnonzero(np.isfinite(height)) if pixels is None else pixels
    row, column = np.unravel_index(chosen, height.shape)
    columns: dict[str, NDArray[Any]] = {
        "x": x[column].astype(np.float32),
        "y": y[row].astype(np.float32),
        "z": height[row, column],
    }
    if result.normals is not None:
        columns |= dict(zip(NORMAL, result.normals[row, column].T, strict=True))
    if result.height_sigma is not None:
        columns["sigma"] = result.height_sigma[row, column]
    if result.filled is not None:
        columns["filled"] = (result.filled[row, column] > 0).astype(np.uint8)
    return columns


_MOST = np.iinfo(np.uint16).max
_FLAT = 1e-6  # mm a count, where all heights are one


@dataclass(frozen=True, slots=True)
class Counts:
    """A map of heights in 16 bits: its height is ``offset + step * counts``."""

    values: NDArray[np.uint16]
    offset: float
    step: float
    pixel_size: tuple[float, float]
    first: tuple[float, float]

    @property
    def highest(self) -> float:
        """The height at the highest count, mm."""
        return self.offset + self.step * _MOST

    def __str__(self) -> str:
        return f"height in mm = {self.offset!r} + {self.step!r} x count; count 0: no answer"


def counts_of(result: Result) -> Counts:
    """Spread the known heights of a result over 16 bits."""
    height, x, y = grid_of(result)
    known = np.isfinite(height)
    heights = np.where(known, height, np.nan).astype(np.float64)
    lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
    step = (highest - lowest) / (_MOST - 1) or _FLAT
    values = np.rint((np.where(known, heights, lowest) - lowest) / step) + 1
    first = float(x[0]), float(y[0])
    return Counts(np.where(known, values, 0).astype(np.uint16), lowest - step, step, _pixel_size(x, y), first)


def _pixel_size(x: Floats, y: Floats) -> tuple[float, float]:
    """Tell the size of a pixel from the places; of a single row or column it is as long as it is wide."""
    sizes = [abs(float(axis[-1] - axis[0])) / (len(axis) - 1) for axis in (x, y) if len(axis) > 1]
    if not sizes:
        raise InputError("a result of one pixel does not tell how large that is: export it as .xyz or .npz")
    return sizes[0], sizes[-1]


_NAMES = {"f4": "float", "u1": "uchar"}


def ply(
    columns: Mapping[str, NDArray[Any]], faces: NDArray[np.int32] | None, notes: Mapping[str, str]
) -> list[bytes]:
    """Encode a surface, or points alone."""
    vertices = np.empty(
        len(columns["x"]), [(name, f"<{values.dtype.str[1:]}") for name, values in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {name}: {_ascii(said)}" for name, said in notes.items()]
    head += [f"element vertex {len(vertices)}"]
    head += [f"property {_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    body = [vertices.tobytes()]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        triangles["count"], triangles["vertices"] = 3, faces
        body.append(triangles.tobytes())
    return ["\n".join([*head, "end_header\n"]).encode("ascii"), *body]


def _ascii(text: str) -> str:
    return text.encode("ascii", "backslashreplace").decode()


_HEAD = 80  # bytes of free text, which must not begin with "solid": that would be STL as text


def stl(mesh: Mesh, title: str) -> list[bytes]:
    """Encode a surface."""
    normals = face_vectors(mesh)
    triangles = np.zeros(
        len(normals), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = mesh.vertices[mesh.faces]
    head = title.encode("ascii", "backslashreplace")[:_HEAD].ljust(_HEAD, b" ")
    return [head, np.uint32(len(triangles)).astype("<u4").tobytes(), triangles.tobytes()]


_TOGETHER = 1 << 16  # rows


def xyz(
    columns: Mapping[str, NDArray[Any]], units: Mapping[str, str], notes: Mapping[str, str]
) -> list[bytes]:
    """Encode points, one a line, after comments that begin with ``#``; the last names the columns."""
    names = [f"{name}[{units[name]}]" if name in units else name for name in columns]
    head = [*(f"{name}: {said}" for name, said in notes.items()), " ".join(names)]
    parts = ["".join(f"# {line}\n" for line in head).encode()]
    line = " ".join("%d" if values.dtype.kind == "u" else "%.6f" for values in columns.values()) + "\n"
    rows = np.stack([values.astype(np.float64) for values in columns.values()], axis=1)
    for start in range(0, len(rows), _TOGETHER):
        some = rows[start : start + _TOGETHER]
        parts.append((line * len(some) % tuple(some.ravel().tolist())).encode())
    return parts


_KEYWORDS = {SOURCE: "Title", DATE: "Creation Time", SOFTWARE: "Software"}
_INCH = 25.4  # mm
_METRE = 1e-3  # m a mm


def png(counts: Counts, notes: Mapping[str, str]) -> list[bytes]:
    """Encode heights as a grey picture.

    Its resolution is told in pixels a metre, and the scale of heights in texts: for people, in numbers, and
    under the keys that Gwyddion documents for pictures of 16 bits.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    texts = PngInfo()
    for name, said in (*_texts(counts, notes), *_gwyddion(counts, notes.get(SOURCE, "height"))):
        texts.add_text(name, said)
    width, height = counts.pixel_size
    file = BytesIO()
    Image.fromarray(counts.values).save(file, "png", pnginfo=texts, dpi=(_INCH / width, _INCH / height))
    return [file.getvalue()]


def _texts(counts: Counts, notes: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    yield "Description", str(counts)
    yield "height offset", f"{counts.offset!r} mm"
    yield "height step", f"{counts.step!r} mm"
    yield "pixel size", " ".join(f"{size!r}" for size in counts.pixel_size) + " mm"
    for name, said in notes.items():
        yield _KEYWORDS.get(name, name), said


def _gwyddion(counts: Counts, title: str) -> Iterator[tuple[str, str]]:
    """Yield lengths in metres, with y down the picture."""
    rows, columns = counts.values.shape
    (width, height), (x, y) = counts.pixel_size, counts.first
    lengths = {
        "XReal": columns * width,
        "YReal": rows * height,
        "XOffset": x - width / 2,
        "YOffset": -y - height / 2,
        "ZMin": counts.offset,
        "ZMax": counts.highest,
    }
    for name, length in lengths.items():
        yield f"Gwy::{name}", repr(length * _METRE)
    for name in ("XYUnit", "ZUnit"):
        yield f"Gwy::{name}", "m"  # as its source has them
        yield f"Gwy::{name}s", "m"  # as its guide has them
    yield "Gwy::Title", title


_CENTIMETRE = 10.0  # mm
_NO_DATA = 42113  # the tag by which GDAL names the value of holes


def tiff(counts: Counts, notes: Mapping[str, str]) -> list[bytes]:
    """Encode heights as a grey picture.

    Its resolution is told in pixels a centimetre, holes by GDAL's tag, and the scale of heights in a
    description of lines that ImageJ reads, so that it shows millimetres.
    """
    import tifffile

    width, height = counts.pixel_size
    file = BytesIO()
    tifffile.imwrite(
        file,
        counts.values,
        photometric="minisblack",
        resolution=(_CENTIMETRE / width, _CENTIMETRE / height),
        resolutionunit="CENTIMETER",
        description=_description(counts, notes).encode(),
        software=notes.get(SOFTWARE, ""),
        metadata=None,
        extratags=[(_NO_DATA, "s", 0, "0", True)],
    )
    return [file.getvalue()]


def _description(counts: Counts, notes: Mapping[str, str]) -> str:
    (width, height), (x, y) = counts.pixel_size, counts.first
    lines: dict[str, object] = {
        "ImageJ": "1.54",
        "unit": "cm",  # of the resolution
        "xorigin": -x / width,
        "yorigin": y / height,
        "inverty": "true",
        "cf": 0,  # heights are a straight line of counts: c0 + c1 x count
        "c0": counts.offset,
        "c1": counts.step,
        "vunit": "mm",
        "min": 1,
        "max": int(counts.values.max()),
        "scale": counts,
    }
    lines |= {name: said.replace("\\", r"\\") for name, said in notes.items()}  # which begins an escape
    return "".join(f"{name}={said}\n" for name, said in lines.items())


def npz(result: Result) -> list[bytes]:
    """Encode the maps, where the pixels are, and as JSON their units and how they came about.

    Nothing in it needs ``allow_pickle``.
    """
    arrays: dict[str, Any] = dict(result.maps())
    more = {"x": result.x, "y": result.y, "offset_unknown": result.offset_unknown}
    arrays |= {name: values for name, values in more.items() if values is not None}
    units = {name: unit for name, unit in {**UNITS, "x": "mm", "y": "mm"}.items() if name in arrays}
    arrays |= {"units": json.dumps(units), "process": json.dumps(dict(result.process))}
    file = BytesIO()
    np.savez(file, **arrays)
    return [file.getvalue()]
