"""SUR (Digital Surf, MountainsMap): heights as counts of 16 or 32 bits after a header of 512 bytes.

A height is ``count * spacing + offset`` in the unit of the spacing, as a profile and the surface that it was
cut from show in files of MountainsMap. The first line is at the top. With special points, the counts next to
the range mark points that were not measured, and saturated ones.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import InputError, ProcessValue
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    Encoded,
    as_ascii,
    check_points,
    comment_of,
    grid_of,
    millimetres_per,
    pixel_size_of,
    result_of_surface,
)
from mirrorskin.io.model.result import Result

SUR = Format(
    name="SUR",
    suffixes=(".sur",),
    content="a surface",
    encoder="encode_sur",
    decoder="decode_sur",
    signatures=(b"DIGITAL SURF", b"DSCOMPRESSED"),
    exported=(
        (
            "`.sur`",
            "heights, Digital Surf, 32 bits",
            "µm; position of the first pixel",
            "their own code",
            "number of them in the comment",
            "MountainsMap, Gwyddion, surfalize, HyperSpy",
        ),
    ),
    decoded=(
        "`.sur`",
        "Digital Surf: 16 and 32 bits, plain and compressed; the heights of coloured surfaces",
        "of the spacing along z, in the header",
        "points not measured, and saturated ones",
        "offsets of the axes, unless both are 0",
        "profiles, images, series, byte order of Macintosh, values that are no lengths",
    ),
)


class _Header(NamedTuple):
    """The header of a surface; names of Digital Surf's specification in the order of the file."""

    signature: bytes
    byte_order: int  # 0 of PC, 257 of Macintosh
    objects: int
    version: int
    kind: int
    name: bytes
    operator: bytes
    layers: int
    acquisition: int
    range_type: int
    special: int  # whether there are points that were not measured
    absolute: int
    gauge: float
    bits: int
    lowest: int
    highest: int
    columns: int
    rows: int
    points: int
    step_x: float
    step_y: float
    step_z: float
    axis_x: bytes
    axis_y: bytes
    axis_z: bytes
    step_unit_x: bytes
    step_unit_y: bytes
    step_unit_z: bytes
    unit_x: bytes
    unit_y: bytes
    unit_z: bytes
    ratio_x: float
    ratio_y: float
    ratio_z: float
    replica: int
    inverted: int
    levelled: int
    second: int
    minute: int
    hour: int
    day: int
    month: int
    year: int
    weekday: int
    duration: float
    compressed_size: int
    comment_size: int
    private_size: int
    client: bytes
    offset_x: float
    offset_y: float
    offset_z: float
    step_t: float
    offset_t: float
    axis_t: bytes
    step_unit_t: bytes


_LAYOUT = struct.Struct("<12s4h30s30s5hf4xh5i3f" + 9 * "16s" + "3f3h12x7hfI6x2H128s5f13s13s")
_PLAIN, _PACKED = b"DIGITAL SURF", b"DSCOMPRESSED"
_SURFACE = 2
_KINDS = {1: "a profile", 3: "a binary image", 4: "profiles", 5: "a series of surfaces", 10: "an image"}
_KINDS |= {8: "a surface of several layers", 12: "an image"}
_WITH_SURFACE = {_SURFACE: "", 11: "intensity", 13: "colours", 16: "colours and intensity"}
_GWYDDION = 1  # kind of surfaces that Gwyddion exports
_MICROMETRE = 1e3  # of a millimetre
_HIGHEST = 2**31 - 2  # count of the highest height
_FINEST = 1e-6  # µm per count, at least
_AXES: dict[str, Any] = {f"axis_{axis}": axis.upper().encode().ljust(16) for axis in "xyz"}
_AXES |= {f"{what}_{axis}": b"\xb5m".ljust(16) for what in ("step_unit", "unit") for axis in "xyz"}
_AXES |= {f"ratio_{axis}": 1.0 for axis in "xyz"}
_AXES |= {"name": bytes(30), "operator": bytes(30), "axis_t": bytes(13), "step_unit_t": bytes(13)}
_AXES = {name: text.replace(b"\0", b" ") if isinstance(text, bytes) else text for name, text in _AXES.items()}
_COMMENT_MAX = 32_000  # bytes of a comment, whose length has 16 bits


def encode_sur(result: Result) -> Encoded:
    """Encode heights as SUR: counts of 32 bits from 0, on which all readers agree, and the position."""
    height, x, y = grid_of(result)
    width, step = pixel_size_of(x, y)
    heights = height.astype(np.float64) * _MICROMETRE
    known = np.isfinite(heights)
    lowest = _next_float32(np.min(heights[known]), -np.inf)
    extent = float(np.max(heights[known])) - lowest
    unit_z = _next_float32(max(extent / _HIGHEST, _FINEST), np.inf)
    counts = np.rint(np.where(known, heights - lowest, 0) / unit_z).clip(0, _HIGHEST).astype("<i4")
    counts[~known] = -2
    comment = as_ascii(comment_of(result)).encode()[:_COMMENT_MAX]
    rows, columns = counts.shape
    header = (
        _Header._make(_LAYOUT.unpack(bytes(_LAYOUT.size)))
        ._replace(
            signature=_PLAIN,
            objects=1,
            version=1,
            kind=_SURFACE,
            special=int(not known.all()),
            absolute=1,
            bits=32,
            highest=int(counts.max()),
            columns=columns,
            rows=rows,
            points=rows * columns,
            step_x=width * _MICROMETRE,
            step_y=step * _MICROMETRE,
            step_z=unit_z,
            comment_size=len(comment),
            client=b"exported by mirrorskin",
            offset_x=float(x[0]) * _MICROMETRE,
            offset_y=-float(y[0]) * _MICROMETRE,  # down the picture
            offset_z=lowest,
        )
        ._replace(**_AXES)
    )
    return Encoded([_LAYOUT.pack(*header), comment, counts.tobytes()], f"{rows} x {columns} heights")


def _next_float32(value: float, end: float) -> float:
    """Return the nearest number in 32 bits that is not less (or not more) than a value, towards an end."""
    nearest = np.float32(value)
    exceeds = nearest >= value if end > 0 else nearest <= value
    return float(nearest if exceeds else np.nextafter(nearest, np.float32(end)))


def decode_sur(content: bytes) -> Result:
    """Return the surface in a SUR file."""
    if not content.startswith((_PLAIN, _PACKED)):
        raise InputError("it is not a SUR file of Digital Surf: name it by what it is")
    if len(content) < _LAYOUT.size:
        raise InputError("it is cut short in its header: copy it again")
    header = _Header._make(_LAYOUT.unpack_from(content))
    _check(header)
    place = _LAYOUT.size + header.comment_size
    comment = content[_LAYOUT.size : place].rstrip(b"\0 ").decode("latin-1")
    counts = _counts(header, content[place + header.private_size :])
    unit_x, unit_y, unit_z = (
        millimetres_per(_text(unit), what)
        for unit, what in (
            (header.step_unit_x, "spacing along x"),
            (header.step_unit_y, "spacing along y"),
            (header.step_unit_z, "heights"),
        )
    )
    height = (counts * np.float64(header.step_z) + header.offset_z) * unit_z
    findings = _mark_special(header, counts, height)
    if header.inverted:
        text = "the file states that heights were inverted or mirrored: they are taken as stored"
        findings.append(Finding("surface file", text, False))
    if left_out := _WITH_SURFACE.get(header.kind):
        findings.append(Finding("surface file", f"its {left_out} are left out", False))
    first = (header.offset_x * unit_x, -header.offset_y * unit_y)
    return result_of_surface(
        height,
        (float(header.step_x) * unit_x, float(header.step_y) * unit_y),
        first if any(first) and np.isfinite(first).all() else None,
        comment=comment,
        facts=_facts(header),
        findings=findings,
    )


def _check(header: _Header) -> None:
    """Refuse what is no surface, or not laid out as expected."""
    if header.byte_order:
        raise InputError("its numbers are in the byte order of Macintosh: save it again in that of a PC")
    surface = header.kind in _WITH_SURFACE or (header.kind == _GWYDDION and header.rows > 1)
    if not surface or header.objects > 1:
        kind = _KINDS.get(header.kind, f"an object of kind {header.kind}")
        what = f"{header.objects} objects" if surface else kind
        raise InputError(f"it holds {what}: save one surface")
    if header.bits not in (16, 32):
        raise InputError(f"its points have {header.bits} bits, and 16 or 32 are read: save it again")
    check_points(header.rows, header.columns)
    if header.points != header.rows * header.columns:
        size = f"{header.columns} x {header.rows}"
        raise InputError(f"it states {header.points} points, which are not {size}: save it again")
    if not np.isfinite([header.step_z, header.offset_z]).all() or header.step_z == 0:
        raise InputError(f"the spacing of its heights is {header.step_z:g}: save it again")


def _counts(header: _Header, data: bytes) -> NDArray[Any]:
    """Return the stored counts, (H, W)."""
    size = header.points * header.bits // 8
    if header.signature == _PACKED:
        data = _unpacked(data, size)
    if len(data) < size:
        present = len(data) * 8 // header.bits
        raise InputError(f"it is cut short: {present} of {header.points} points are there; copy it again")
    return np.frombuffer(data, f"<i{header.bits // 8}", header.points).reshape(header.rows, header.columns)


def _unpacked(data: bytes, size: int) -> bytes:
    """Return unpacked data of a given size; it is in streams, whose sizes come first."""
    count = int.from_bytes(data[:4], "little")
    sizes = struct.unpack_from(f"<{2 * count}I", data, 4) if 4 + 8 * count <= len(data) else ()
    place, parts = 4 + 8 * count, list[bytes]()
    for packed_size in sizes[1::2]:
        stream = zlib.decompressobj()
        try:
            parts.append(stream.decompress(data[place : place + packed_size], size + 1))
        except zlib.error as error:
            raise InputError("its compressed heights are damaged: copy it again") from error
        place += packed_size
        size -= len(parts[-1])
        if size < 0 or not stream.eof:
            raise InputError("its compressed heights are cut short, or too many: copy it again")
    return b"".join(parts)


def _mark_special(header: _Header, counts: NDArray[Any], height: NDArray[np.float64]) -> list[Finding]:
    """Set heights that were not measured to NaN, and those that are saturated, which a note counts."""
    if not header.special:
        return []
    saturated = (counts == header.lowest - 1) | (counts == header.highest + 1)
    height[saturated | (counts == header.lowest - 2)] = np.nan
    number = np.count_nonzero(saturated)
    return [Finding("surface file", f"saturated points left out: {number}", False)] if number else []


def _text(text: bytes) -> str:
    """Return a text of the header, which may end in zeros or blanks; some programs write UTF-8."""
    text = text.split(b"\0", 1)[0].strip()
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def _facts(header: _Header) -> dict[str, ProcessValue]:
    """Return what the file states of its origin."""
    facts = {"title": one_line(_text(header.name)), "operator": one_line(_text(header.operator))}
    if header.year > 0:
        day = f"{header.year:04}-{header.month:02}-{header.day:02}"
        facts["date"] = f"{day}T{header.hour:02}:{header.minute:02}:{header.second:02}"
    return {name: fact for name, fact in facts.items() if fact}
