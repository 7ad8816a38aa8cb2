"""X3P (ISO 25178-72): heights for programs of surface metrology, and from instruments.

The first row is at the top in files of ISO 25178-72:2017 ("ISO5436 - 2000"), which are written. That edition
does not say where the first point is, and instruments, Gwyddion, surfalize, SurfaceTopography and x3ptools
have it at the top left, as in SUR and GSF. The amendment of 2020 says that y increases with the row in a
right-handed system, so the first row of its files is the lowest.
"""

from __future__ import annotations

import zipfile
from datetime import UTC, datetime
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.system import MAX_TEXT_BYTES, MAX_UNPACKED_BYTES, check_unpacked
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import Floats, InputError, ProcessValue
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    Encoded,
    comment_of,
    grid_of,
    pixel_size_of,
    result_of_surface,
)
from mirrorskin.io.model.result import Result

if TYPE_CHECKING:
    import x3pio

X3P = Format(
    name="X3P",
    suffixes=(".x3p",),
    content="a surface",
    encoder="encode_x3p",
    decoder="decode_x3p",
    package="x3pio",
    extra="metrology",
    exported=(
        (
            "`.x3p`",
            "heights, ISO 25178-72",
            "m; position of the first pixel; program, date and notes in the metadata",
            "NaN",
            "number of them in the comment",
            "programs of metrology, forensics; Gwyddion, surfalize, x3pio",
        ),
    ),
    decoded=(
        "`.x3p`",
        "ISO 25178-72, both editions: integers of 16 and 32 bits, float32, float64, in binary or XML",
        "m, by the standard",
        "NaN, and the mask of valid points",
        "offsets of the axes, unless both are 0; absolute x and y on a regular grid",
        "profiles, point clouds, several layers, irregular grids, wrong checksums of heights",
    ),
)


_METRE = 1e-3  # of a millimetre
_KINDS = {"Profile": "profile", "PointCloud": "cloud of points"}
_IRREGULAR = 0.02  # largest deviation of positions from a regular grid, in steps


def encode_x3p(result: Result) -> Encoded:
    """Encode heights as X3P (ISO 25178-72), float64 in metres; its y points down, as in SUR and GSF."""
    import x3pio

    height, x, y = grid_of(result)
    width, step = pixel_size_of(x, y)
    process = result.process
    program, version = (one_line(process.get(name, "")) for name in ("program", "version"))
    metadata = x3pio.Metadata.for_software(program or "mirrorskin", version, date=_date(result))
    metadata.comment = comment_of(result)
    file = BytesIO()
    surface = x3pio.Surface.from_array(
        height.astype(np.float64) * _METRE,
        x_scale=width * _METRE,
        y_scale=step * _METRE,
        metadata=metadata,
        placement=x3pio.Placement.translation(float(x[0]) * _METRE, -float(y[0]) * _METRE, 0.0),
        coordinate_system=x3pio.CoordinateSystem.VIEW,
        revision=x3pio.Revision.ISO5436_2000,
    )
    surface.save(file)
    rows, columns = height.shape
    return Encoded([file.getvalue()], f"{rows} x {columns} heights")


def _date(result: Result) -> datetime:
    """Return the date of a result, or now."""
    try:
        return datetime.fromisoformat(str(result.process["date"]))
    except (KeyError, ValueError):
        return datetime.now(UTC)


def decode_x3p(content: bytes) -> Result:
    """Return the surface in an X3P file."""
    import x3pio

    file, findings = _opened(content)
    if not isinstance(file, x3pio.Surface):
        raise InputError(
            f"it holds a {_KINDS.get(type(file).__name__, 'file')}, not a surface: save a surface"
        )
    if len(file.layers) != 1:
        raise InputError(f"it has {len(file.layers)} layers, and surfaces of one are read: save one of them")
    layer, offset = file.layers[0], file.placement.offset / _METRE
    down = file.revision is x3pio.Revision.ISO5436_2000
    height = layer.z / _METRE + offset[2]
    rows, columns = height.shape
    x, width = _positions("x", layer.header.x, layer.x, columns)
    y, step = _positions("y", layer.header.y, None if layer.y is None else layer.y.T, rows)
    first = (x + offset[0], (-1 if down else 1) * (y + offset[1]))
    step = -step if down else step
    # From here on x is to the right, and y up.
    if width < 0:
        height, first, width = height[:, ::-1], (first[0] + (columns - 1) * width, first[1]), -width
    if step > 0:
        height, first = height[::-1], (first[0], first[1] + (rows - 1) * step)
    if file.placement.has_rotation:
        findings.append(Finding("surface file", "the rotation in the file is not applied to heights", False))
    row = "top" if down else "lowest"
    findings.append(Finding("surface file", f"{file.revision}: its first row is the {row} one", False))
    stated = any(offset[:2]) or layer.x is not None or layer.y is not None
    return result_of_surface(
        height,
        (width, abs(step)),
        first if stated else None,
        comment=(file.metadata.comment or "") if file.metadata else "",
        facts=_facts(file.metadata),
        findings=findings,
    )


def _opened(content: bytes) -> tuple[x3pio.X3pFile, list[Finding]]:
    """Open a file; one whose description was edited later is read with a warning."""
    import x3pio

    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            for member in archive.infolist():
                what = f"the file {one_line(member.filename)[:40]} in it"
                is_text = member.filename.endswith(".xml")
                limit = MAX_TEXT_BYTES if is_text else MAX_UNPACKED_BYTES
                check_unpacked(member.file_size, what, "save heights in binary", limit)
        try:
            return x3pio.read(BytesIO(content)), []
        except x3pio.X3pChecksumError as error:
            if "main.xml" not in str(error):
                raise
        warning = "the checksum of main.xml does not match: it was edited, and heights are not verified"
        return x3pio.read(BytesIO(content), verify=False), [Finding("surface file", warning)]
    except (InputError, MemoryError):
        raise
    except Exception as error:  # damaged bytes raise errors of many types
        reason = one_line(error)[:200] or type(error).__name__
        raise InputError(f"it is not a sound X3P file ({reason}): copy it or save it again") from error


def _positions(name: str, axis: x3pio.Axis, stored: Floats | None, count: int) -> tuple[float, float]:
    """Return the first position along an axis and the step, mm; positions (N, count) may be stored."""
    if stored is None:
        return 0.0, axis.increment / _METRE
    index, known = np.broadcast_to(np.arange(count), stored.shape), np.isfinite(stored)
    index, places = index[known], stored[known] / _METRE
    if not index.size or np.ptp(index) == 0:
        raise InputError(f"its positions along {name} are unknown: save it with increments")
    step, start = np.polyfit(index, places, 1)
    if not np.max(np.abs(places - (start + step * index))) <= _IRREGULAR * abs(step):
        raise InputError(f"its positions along {name} are not on a regular grid: resample it")
    return float(start), float(step)


def _facts(metadata: x3pio.Metadata | None) -> dict[str, ProcessValue]:
    """Return what the file states of its origin."""
    if metadata is None:
        return {}
    instrument = metadata.instrument
    names = (instrument.manufacturer, instrument.model, instrument.version, instrument.serial)
    facts = {"instrument": " ".join(dict.fromkeys(one_line(name) for name in names if name))}
    facts["date"] = "" if metadata.date is None else metadata.date.isoformat()
    facts["creator"] = one_line(metadata.creator or "")
    return {name: fact for name, fact in facts.items() if fact}
