"""Gwyddion: its Simple Field (GSF), written and read, and its own files (GWY), read.

The first row is at the top, and the offsets are those of the top left corner, with y down.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import InputError
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    Encoded,
    check_points,
    comment_of,
    grid_of,
    millimetres_per,
    pixel_size_of,
    result_of_surface,
)
from mirrorskin.io.model.result import Result

GSF = Format(
    name="GSF",
    suffixes=(".gsf",),
    content="a surface",
    encoder="encode_gsf",
    decoder="decode_gsf",
    signatures=(b"Gwyddion Simple Field 1.0\n", b"Gwyddion Simple Field 1.0\r"),
    exported=(
        (
            "`.gsf`",
            "heights, Gwyddion Simple Field, float32",
            "m; size and position of the picture",
            "NaN",
            "number of them in `Comment`",
            "Gwyddion; gsffile",
        ),
    ),
    decoded=(
        "`.gsf`",
        "Gwyddion Simple Field, float32",
        "`XYUnits` and `ZUnits`",
        "NaN",
        "`XOffset` and `YOffset`, unless both are 0",
        "no size, no unit, values that are no lengths",
    ),
)
GWY = Format(
    name="GWY",
    suffixes=(".gwy",),
    decoder="decode_gwy",
    signatures=(b"GWYP",),
    decoded=(
        "`.gwy`",
        "Gwyddion's own files: the channel of a file that has one of heights",
        "`si_unit_xy` and `si_unit_z`",
        "its mask, NaN",
        "`xoff` and `yoff`, unless both are 0",
        "several channels of heights",
    ),
)

_METRE = 1e-3  # of a millimetre
_MAGIC = "Gwyddion Simple Field 1.0"
_ATOMS = {b"b": "?", b"c": "c", b"i": "<i", b"q": "<q", b"d": "<d"}  # types of components, and of numbers
_ARRAYS = {b"C": "S1", b"I": "<i4", b"Q": "<i8", b"D": "<f8"}
_DEEPEST = 16  # objects within objects
_MOST = 100_000  # components of a file


def encode_gsf(result: Result) -> Encoded:
    """Encode heights as a Gwyddion Simple Field: float32 in metres, with the origin at the top left."""
    height, x, y = grid_of(result)
    width, step = pixel_size_of(x, y)
    rows, columns = height.shape
    fields = {
        "XRes": columns,
        "YRes": rows,
        "XReal": columns * width * _METRE,
        "YReal": rows * step * _METRE,
        "XOffset": (float(x[0]) - width / 2) * _METRE,
        "YOffset": -(float(y[0]) + step / 2) * _METRE,  # down the picture
        "Title": "height",
        "XYUnits": "m",
        "ZUnits": "m",
        "Comment": comment_of(result).replace("=", ":"),
    }
    head = "".join(f"{line}\n" for line in (_MAGIC, *(f"{name} = {value}" for name, value in fields.items())))
    header = head.encode()
    values = (height * np.float64(_METRE)).astype("<f4")
    parts = [header, bytes(4 - len(header) % 4), values.tobytes()]
    return Encoded(parts, f"{rows} x {columns} heights")


def decode_gsf(content: bytes) -> Result:
    """Return the surface in a Gwyddion Simple Field."""
    if not content.startswith(_MAGIC.encode()):
        raise InputError("it is not a Gwyddion Simple Field: name it by what it is")
    end = content.find(b"\0")
    if end < 0:
        raise InputError("it is cut short in its header: copy it again")
    fields = _fields(content[:end].decode(errors="replace"))
    columns, rows = (int(_number(fields, name, needed=True)) for name in ("XRes", "YRes"))
    check_points(rows, columns)
    start = end + 4 - end % 4
    data = content[start:]
    if len(data) != 4 * rows * columns:
        there = f"{len(data)} bytes of points where {rows} x {columns} x 4 are stated"
        raise InputError(f"it has {there}: copy it again")
    unit = millimetres_per(fields.get("XYUnits", ""), "positions")
    height = np.frombuffer(data, "<f4", rows * columns).reshape(rows, columns).astype(np.float64)
    size = [_number(fields, name, needed=True) * unit for name in ("XReal", "YReal")]
    corner = [_number(fields, name) * unit for name in ("XOffset", "YOffset")]
    facts = {"title": one_line(fields["Title"])} if fields.get("Title", "height") != "height" else {}
    return result_of_surface(
        height * millimetres_per(fields.get("ZUnits", ""), "heights"),
        (size[0] / columns, size[1] / rows),
        _first(corner, size, (rows, columns)),
        comment=fields.get("Comment", ""),
        facts=facts,
    )


def _fields(header: str) -> dict[str, str]:
    """Return the fields of a header, by name."""
    pairs = (line.split("=", 1) for line in header.splitlines()[1:] if "=" in line)
    return {name.strip(): value.strip() for name, value in pairs}


def _number(fields: Mapping[str, Any], name: str, needed: bool = False) -> float:
    """Return a number of a header, 0 if there is none; InputError if it is needed, or is no number."""
    if name not in fields:
        if needed:
            raise InputError(f"it states no {name}: save it with one")
        return 0.0
    try:
        value = float(fields[name])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"its {name} is {one_line(fields[name])[:40]!r}, which is no number: save it again")
    return value


def _first(corner: list[float], size: list[float], shape: tuple[int, int]) -> tuple[float, float] | None:
    """Return the position of the first pixel, mm, y up; None if the corner is at 0, as of most files."""
    if not any(corner):
        return None
    rows, columns = shape
    return corner[0] + size[0] / columns / 2, -(corner[1] + size[1] / rows / 2)


def decode_gwy(content: bytes) -> Result:
    """Return the surface in a file of Gwyddion: its only channel of heights, without masked points."""
    if not content.startswith(b"GWYP"):
        raise InputError("it is not a file of Gwyddion: name it by what it is")
    try:
        channels = _object(content, 4, [_MOST])
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"it is damaged or cut short ({one_line(error)[:80]}): copy it again") from None
    found, others = _heights_in(channels)
    if len(found) != 1:
        names = ", ".join(_title(channels, number) for number in found[:5]) or "none"
        raise InputError(f"it has {len(found)} channels of heights ({names}): save one of them alone")
    number = found[0]
    field = channels[f"/{number}/data"]
    rows, columns = (int(_number(field, name, needed=True)) for name in ("yres", "xres"))
    check_points(rows, columns)
    height = _values(field, rows, columns)
    findings = []
    mask = channels.get(f"/{number}/mask")
    if isinstance(mask, dict):
        masked = _values(mask, rows, columns) > 0
        height = np.where(masked, np.nan, height)
        findings.append(Finding("surface file", f"masked points left out: {np.count_nonzero(masked)}", False))
    if others:
        findings.append(Finding("surface file", f"channels left out: {', '.join(others)}", False))
    unit = millimetres_per(_unit(field, "si_unit_xy"), "positions")
    size = [_number(field, name, needed=True) * unit for name in ("xreal", "yreal")]
    corner = [_number(field, name) * unit for name in ("xoff", "yoff")]
    return result_of_surface(
        height * millimetres_per(_unit(field, "si_unit_z"), "heights"),
        (size[0] / columns, size[1] / rows),
        _first(corner, size, (rows, columns)),
        facts={"title": _title(channels, number)},
        findings=findings,
    )


def _heights_in(channels: Mapping[str, Any]) -> tuple[list[int], list[str]]:
    """Return the numbers of the channels whose unit is a length, and the titles of the others."""
    found, others = [], []
    for name, field in channels.items():
        match = re.fullmatch(r"/(\d{1,9})/data", name)
        if match and isinstance(field, dict):
            number = int(match[1])
            try:
                millimetres_per(_unit(field, "si_unit_z"), "heights")
            except InputError:
                others.append(_title(channels, number))
            else:
                found.append(number)
    return found, others


def _title(channels: Mapping[str, Any], number: int) -> str:
    return one_line(channels.get(f"/{number}/data/title", f"channel {number}"))[:60]


def _unit(field: Mapping[str, Any], name: str) -> str:
    unit = field.get(name)
    return str(unit.get("unitstr", "")) if isinstance(unit, dict) else ""


def _values(field: Mapping[str, Any], rows: int, columns: int) -> NDArray[np.float64]:
    """Return the values of a field, (H, W)."""
    values = field.get("data")
    if not isinstance(values, np.ndarray) or values.dtype != np.float64 or values.size != rows * columns:
        raise InputError(f"a field of {columns} x {rows} points has not as many values: copy it again")
    return values.reshape(rows, columns)


def _object(content: bytes, place: int, left: list[int], depth: int = 0) -> dict[str, Any]:
    """Return the components of an object that begins at a place; ValueError if it is damaged."""
    if depth > _DEEPEST:
        raise ValueError("objects too deep")
    _, place = _string(content, place)
    (size,) = struct.unpack_from("<I", content, place)
    end = place + 4 + size
    if end > len(content):
        raise ValueError(f"{len(content)} of at least {end} bytes")
    return dict(_components(content, place + 4, end, left, depth))


def _components(
    content: bytes, place: int, end: int, left: list[int], depth: int
) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of components; those of other types have None."""
    while place < end:
        left[0] -= 1
        if left[0] < 0:
            raise ValueError("too many components")
        name, place = _string(content, place)
        kind, place = content[place : place + 1], place + 1
        value: Any = None
        if kind in _ATOMS:
            (value,) = struct.unpack_from(_ATOMS[kind], content, place)
            place += struct.calcsize(_ATOMS[kind])
        elif kind == b"s":
            value, place = _string(content, place)
        elif kind == b"o":
            value = _object(content, place, left, depth + 1)
            place = _after(content, place)
        else:
            (count,) = struct.unpack_from("<I", content, place)
            place += 4
            if kind in _ARRAYS:
                value = np.frombuffer(content, _ARRAYS[kind], count, place)
                place += value.nbytes
            elif kind in (b"S", b"O"):
                for _ in range(min(count, end - place + 1)):
                    place = _after(content, place) if kind == b"O" else _string(content, place)[1]
            else:
                raise ValueError(f"a component of type {kind!r}")
        yield name, value


def _after(content: bytes, place: int) -> int:
    """Return the place after an object."""
    _, place = _string(content, place)
    (size,) = struct.unpack_from("<I", content, place)
    return int(place + 4 + size)


def _string(content: bytes, place: int) -> tuple[str, int]:
    """Return a text that ends with 0, and the place after it."""
    end = content.index(b"\0", place)
    return content[place:end].decode(), end + 1
