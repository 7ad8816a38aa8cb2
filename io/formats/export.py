"""Export of results to the formats of other programs; the suffix selects the format."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.arguments import check_flag, check_kind, check_path, checked, unknown_argument
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.url import path_of
from mirrorskin.io.formats import pictures
from mirrorskin.io.formats.export_formats import FORMATS, ExportFormat, suffixes_with
from mirrorskin.io.formats.surface import (
    DATE,
    NORMAL,
    SOFTWARE,
    SOURCE,
    Encoded,
    as_ascii,
    check_heights,
    check_millimetres,
    grid_of,
    height_datum,
    notes_of,
    pixel_size_of,
    points_of,
    what_is,
)
from mirrorskin.io.model.mesh import Mesh, face_vectors, normals_around, surface_mesh
from mirrorskin.io.model.result import Result
from mirrorskin.io.storage.atomic import write_new

_POINT_UNITS = dict.fromkeys(("x", "y", "z", "sigma"), "mm")  # columns of points; the others have no unit
_MOST = np.iinfo(np.uint16).max
_FLAT = 1e-6  # mm per count, if all heights are equal
_PLY_TYPES = {"f4": "float", "u1": "uchar"}
_STL_HEAD = 80  # bytes of free text, which must not begin with "solid", the mark of a text STL
_PNG_KEYWORDS = {SOURCE: "Title", DATE: "Creation Time", SOFTWARE: "Software"}
_CENTIMETRE = 10.0  # mm
_METRE = 1e-3  # m per mm
_NO_DATA = 42113  # GDAL's tag for the value of holes


@checked(
    result=check_kind(Result),
    path=check_path,
    map_name=check_kind(str),
    points=check_flag,
    float32=check_flag,
)
def export_result(
    result: Result,
    path: str | Path,
    *,
    map_name: str = "",
    section: Mapping[str, NDArray[Any]] | None = None,
    points: bool = False,
    float32: bool = False,
) -> str:
    """Write a result for other programs; the file appears complete or not at all.

    Parameters
    ----------
    result : Result
        Maps of one turn; see ``select_turn``.
    path : str or Path
        The suffix selects the format: ``.ply``, ``.stl`` and ``.obj``, a surface of triangles; ``.xyz``,
        points as text; ``.x3p`` (ISO 25178-72), ``.sur`` (Digital Surf) and ``.gsf`` (Gwyddion), heights for
        programs of metrology; ``.png``, ``.tif`` and ``.tiff``, heights as counts of 16 bits with their
        scale, 0 for undefined; ``.csv``, heights as a matrix in mm, or a cross-section; ``.npz``, all maps as
        plain arrays; ``.mcap``, ROS 2 messages, as written by ``save_messages``; ``.zarr``, everything in a
        result file, as written by ``save_zarr``.
    map_name : str, optional
        Name of a map, built-in or declared, which a ``.csv``, a ``.tif`` (float32) or an ``.npz`` contains
        instead, in its unit.
    section : mapping of ndarray, (n,), optional
        Columns of a cross-section, for a ``.csv``; lengths in mm, and ``filled`` is 1 where a height was not
        measured.
    points : bool, optional
        Write a PLY of all points, without triangles.
    float32 : bool, optional
        Write a TIFF of float32 in mm, NaN where undefined.

    Returns
    -------
    str
        Description of what was written.

    Raises
    ------
    InputError
        See ``check_export``; or no three adjacent pixels have heights; or the file cannot be
        written.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.export_result(io.open_result("coin.h5"), "coin.ply")  # doctest: +SKIP
    '1860 triangles between 961 points, 3 x 3 x 0.5 mm'
    """
    path = path_of(path)
    check_export(result, path, map_name)
    if map_name and section is not None:
        raise InputError(f"{path}: a cross-section is of the heights. Leave out the section or the map")
    form = FORMATS[path.suffix.lower()]
    given = {"map_name": map_name, "section": section, "points": points, "float32": float32}
    options = {name: value for name, value in given.items() if value and name in form.options}
    module, _, function = form.encoder.partition(":")
    encode = getattr(import_module(f"mirrorskin.io.{module}"), function)
    if form.writes_itself:
        holds: str = encode(result, path) or "everything"
    else:
        try:
            parts, holds = encode(result, **options)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        write_new(path, parts)
    unknown = result.offset_unknown
    heights = form.needs_heights and map_name in ("", result.name_of("height"))
    relative = heights and unknown is not None and unknown.any()
    return f"{holds}, heights {height_datum(result)}" if relative else holds


def check_export(result: Result, path: str | Path, map_name: str = "") -> None:
    """Raise InputError for a result, or a map, that cannot be exported to a path, before any work is done."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        wrong = f"{suffix} is not a supported format" if suffix else "its name has no suffix"
        raise InputError(f"{path}: {wrong}: name a file that ends with one of {' '.join(FORMATS)}")
    form = FORMATS[suffix]
    if form.package and find_spec(form.package) is None:
        raise InputError(f"{path} needs the package {form.package}: pip install 'mirrorskin[{form.extra}]'")
    if map_name:
        _check_map(result, path, map_name, form)
    elif form.needs_heights:
        check_heights(result, path)


def _check_map(result: Result, path: str | Path, map_name: str, form: ExportFormat) -> None:
    """Raise InputError for a map that the result lacks, or that a format cannot hold."""
    if "map_name" not in form.options:
        raise InputError(f"{path} takes no map: choose {', '.join(suffixes_with('map_name'))}")
    if map_name not in result.maps():
        raise InputError(f"{path}: {unknown_argument('the result', map_name, [*result.maps()], 'map')}")
    if form.needs_heights:
        if result.declaration(map_name).components:
            raise InputError(f"{path}: {map_name} has vectors: export it as .npz")
        check_millimetres(result, path)


def save_table(
    path: str | Path,
    columns: Mapping[str, NDArray[Any]],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> None:
    """Write columns as comma-separated values; the file appears complete or not at all.

    Notes come first, in lines that begin with ``#``; then names with units, as in ``height [mm]``, then the
    rows. Cells of undefined values are empty.

    Parameters
    ----------
    path : str or Path
    columns : mapping of ndarray, (n,)
        Columns by name.
    units : mapping of str
        Units of the columns that have one.
    notes : mapping of str
        Texts by name, one line each.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> columns = {"x": np.arange(3.0), "height": np.zeros(3)}
    >>> save_table("section.csv", columns, {"x": "mm", "height": "mm"}, {})  # doctest: +SKIP
    """
    write_new(Path(path), [_table(columns, units, notes)])


def _table(columns: Mapping[str, NDArray[Any]], units: Mapping[str, str], notes: Mapping[str, str]) -> bytes:
    """Return the text of a table, see `save_table`."""
    text = _commented(notes)
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    table.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    return text.getvalue().encode()


def _commented(notes: Mapping[str, str]) -> StringIO:
    """Return notes as lines that begin with ``#``; a table may follow."""
    text = StringIO(newline="")
    for name, note in notes.items():
        text.write(f"# {name}: {one_line(note)}\n")
    return text


def _cells(values: NDArray[Any]) -> Iterator[str]:
    """Yield numbers with the precision of float32, and an empty text for NaN."""
    for value in values.tolist():
        yield "" if math.isnan(value) else f"{value:.9g}"


def encode_ply(result: Result, points: bool = False) -> Encoded:
    """Encode a surface of triangles, or points alone, as binary PLY."""
    notes = {"unit": "mm"} | notes_of(result)
    if points:
        columns = points_of(result)
        return Encoded(_ply(columns, None, notes), f"{len(columns['x'])} points")
    mesh = _surface(result)
    columns = points_of(result, mesh.pixels)
    if result.normals is not None:
        # Programs shade by the normals, and draw vertices without one black.
        missing = np.isnan(columns[NORMAL[0]])
        for name, values in zip(NORMAL, normals_around(mesh, missing).T, strict=True):
            columns[name] = columns[name].copy()
            columns[name][missing] = values
        notes["normals"] = "of the result where it has them, elsewhere of the triangles around"
    return Encoded(_ply(columns, mesh.faces, notes), _size(mesh))


def encode_stl(result: Result) -> Encoded:
    """Encode a surface as binary STL, with the unit in the header, because STL has no field for it."""
    mesh, notes = _surface(result), notes_of(result)
    title = ", ".join(["unit mm", *(notes[name] for name in (SOFTWARE, DATE, SOURCE) if name in notes)])
    normals = face_vectors(mesh)
    triangles = np.zeros(
        len(normals), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = mesh.vertices[mesh.faces]
    head = as_ascii(title).encode()[:_STL_HEAD].ljust(_STL_HEAD, b" ")
    count = np.uint32(len(triangles)).astype("<u4").tobytes()
    return Encoded([head, count, triangles.tobytes()], _size(mesh))


def encode_obj(result: Result) -> Encoded:
    """Encode a surface as Wavefront OBJ: text, in mm, as stated in a comment."""
    mesh = _surface(result)
    head = "".join(
        f"# {name}: {as_ascii(note)}\n" for name, note in ({"unit": "mm"} | notes_of(result)).items()
    )
    file = BytesIO(head.encode())
    file.seek(0, 2)
    np.savetxt(file, mesh.vertices, "v %.9g %.9g %.9g")
    np.savetxt(file, mesh.faces + 1, "f %d %d %d")
    return Encoded([file.getvalue()], _size(mesh))


def encode_csv(
    result: Result, section: Mapping[str, NDArray[Any]] | None = None, map_name: str = ""
) -> Encoded:
    """Encode the heights or a map as a matrix, NaN where undefined; or the columns of a cross-section."""
    if section is not None:
        units = {name: "mm" for name in section if name != "filled"}
        text = _table(section, units, notes_of(result))
        return Encoded([text], f"{len(section['height'])} points of a cross-section")
    values, x, y = grid_of(result, map_name)
    width, step = pixel_size_of(x, y)
    what = what_is(result, map_name)
    notes = {
        "content": f"{what}, a row of the picture per line, from the top",
        "pixel size": f"{width!r} x {step!r} mm (x, y)",
        "first value": f"x = {float(x[0])!r} mm, y = {float(y[0])!r} mm; y decreases from line to line",
    }
    text_file = _commented(notes | notes_of(result))
    np.savetxt(text_file, values, "%.9g", delimiter=",")
    rows, columns = values.shape
    return Encoded([text_file.getvalue().encode()], f"{rows} x {columns} {what}")


def encode_xyz(result: Result) -> Encoded:
    """Encode points as text, one per line, after comments; the last comment names the columns."""
    columns = points_of(result)
    names = [f"{name}[{_POINT_UNITS[name]}]" if name in _POINT_UNITS else name for name in columns]
    head = [*(f"{name}: {note}" for name, note in notes_of(result).items()), " ".join(names)]
    formats = ["%d" if values.dtype.kind == "u" else "%.9g" for values in columns.values()]
    file = BytesIO()
    rows = np.stack([values.astype(np.float64) for values in columns.values()], axis=1)
    np.savetxt(file, rows, formats, header="\n".join(head), encoding="utf-8")
    return Encoded([file.getvalue()], f"{len(rows)} points")


def encode_png(result: Result) -> Encoded:
    """Encode heights as a grey picture of 16 bits, with its resolution in pixels per metre.

    Texts contain the scale of heights, in words and with the keys that Gwyddion documents for pictures of 16
    bits.
    """
    counts, notes = _counts(result), notes_of(result)
    width, height = counts.pixel_size
    size = width * _METRE, height * _METRE
    return Encoded(pictures.encode_png(counts.values, size, _texts(counts, notes)), str(counts))


def encode_tiff(result: Result, float32: bool = False, map_name: str = "") -> Encoded:
    """Encode heights as a grey picture of 16 bits, or of float32 in mm; a map in float32 in its unit.

    Its resolution is in pixels per centimetre, GDAL's tag marks holes, and the scale of heights is in a
    description that ImageJ reads to display millimetres.
    """
    import tifffile

    if float32 or map_name:
        from mirrorskin.io.formats.topography import encode_float_tiff

        return encode_float_tiff(result, map_name)
    counts, notes = _counts(result), notes_of(result)
    width, height = counts.pixel_size
    file = BytesIO()
    tifffile.imwrite(
        file,
        counts.values,
        photometric="minisblack",
        resolution=(_CENTIMETRE / width, _CENTIMETRE / height),
        resolutionunit="CENTIMETER",
        description=_description(counts, notes).encode(),
        software=as_ascii(notes.get(SOFTWARE, "")),
        metadata=None,
        extratags=[(_NO_DATA, "s", 0, "0", True)],
    )
    return Encoded([file.getvalue()], str(counts))


def encode_npz(result: Result, map_name: str = "") -> Encoded:
    """Encode all maps or one, positions of the pixels, and JSON texts of units, legends, process and fitted.

    It can be loaded without ``allow_pickle``.
    """
    axes = {name: values for name, values in (("x", result.x), ("y", result.y)) if values is not None}
    kept: dict[str, Any] = {map_name: result[map_name]} if map_name else {**result}
    arrays, declared = {**kept, **axes}, {name: result.declaration(name) for name in kept}
    texts = {
        "units": {name: one.unit for name, one in declared.items() if one.unit} | dict.fromkeys(axes, "mm"),
        "legends": {name: one.codes for name, one in declared.items() if one.codes},
        "process": dict(result.process),
        "fitted": result.fitted.values(),
    }
    arrays |= {name: json.dumps(text) for name, text in texts.items()}
    file = BytesIO()
    np.savez(file, **arrays)
    return Encoded([file.getvalue()], map_name or ", ".join(result.maps()))


def _surface(result: Result) -> Mesh:
    mesh = surface_mesh(*grid_of(result), component=result.component)
    if not mesh.faces.size:
        raise InputError("no three adjacent pixels have heights, so there is no surface: export points, .xyz")
    return mesh


def _size(mesh: Mesh) -> str:
    size = " x ".join(f"{length:.4g}" for length in np.ptp(mesh.vertices, axis=0))
    return f"{len(mesh.faces)} triangles between {len(mesh.vertices)} points, {size} mm"


def _ply(
    columns: Mapping[str, NDArray[Any]], faces: NDArray[np.int32] | None, notes: Mapping[str, str]
) -> list[bytes]:
    vertices = np.empty(
        len(columns["x"]), [(name, f"<{values.dtype.str[1:]}") for name, values in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {name}: {as_ascii(note)}" for name, note in notes.items()]
    head += [f"element vertex {len(vertices)}"]
    head += [f"property {_PLY_TYPES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    body = [vertices.tobytes()]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        triangles["count"], triangles["vertices"] = 3, faces
        body.append(triangles.tobytes())
    return ["\n".join([*head, "end_header\n"]).encode("ascii"), *body]


class _Counts(NamedTuple):
    """A map of heights in 16 bits: a height is ``offset + step * counts``."""

    values: NDArray[np.uint16]  # 1 at the lowest height, 65535 at the highest, 0 where undefined
    offset: float  # mm
    step: float  # mm per count
    pixel_size: tuple[float, float]  # mm
    first: tuple[float, float]  # x and y of the top left pixel's centre, mm

    def __str__(self) -> str:
        return f"height in mm = {self.offset!r} + {self.step!r} x count; count 0: no answer"


def _counts(result: Result) -> _Counts:
    """Scale the heights of a result to 16 bits."""
    height, x, y = grid_of(result)
    known = np.isfinite(height)
    heights = np.where(known, height, np.nan).astype(np.float64)
    lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
    step = (highest - lowest) / (_MOST - 1) or _FLAT
    values = np.rint((np.where(known, heights, lowest) - lowest) / step) + 1
    counts = np.where(known, values, 0).astype(np.uint16)
    return _Counts(counts, lowest - step, step, pixel_size_of(x, y), (float(x[0]), float(y[0])))


def _texts(counts: _Counts, notes: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the scale of heights in words, and in Gwyddion's convention: metres, with y down the picture."""
    yield "Description", str(counts)
    yield "height offset", f"{counts.offset!r} mm"
    yield "height step", f"{counts.step!r} mm"
    yield "pixel size", " ".join(f"{size!r}" for size in counts.pixel_size) + " mm"
    for name, note in notes.items():
        yield _PNG_KEYWORDS.get(name, name), note
    rows, columns = counts.values.shape
    (width, height), (x, y) = counts.pixel_size, counts.first
    lengths = {
        "XReal": columns * width,
        "YReal": rows * height,
        "XOffset": x - width / 2,
        "YOffset": -y - height / 2,
        "ZMin": counts.offset,
        "ZMax": counts.offset + counts.step * _MOST,
    }
    for name, length in lengths.items():
        yield f"Gwy::{name}", repr(length * _METRE)
    for name in ("XYUnit", "ZUnit"):
        yield f"Gwy::{name}", "m"  # as in Gwyddion's source code
        yield f"Gwy::{name}s", "m"  # as in its user guide
    yield "Gwy::Title", notes.get(SOURCE, "height")


def _description(counts: _Counts, notes: Mapping[str, str]) -> str:
    (width, height), (x, y) = counts.pixel_size, counts.first
    lines: dict[str, object] = {
        "ImageJ": "1.54",
        "unit": "cm",  # of the resolution
        "xorigin": -x / width,
        "yorigin": y / height,
        "inverty": "true",
        "cf": 0,  # heights are a linear function of counts: c0 + c1 x count
        "c0": counts.offset,
        "c1": counts.step,
        "vunit": "mm",
        "min": 1,
        "max": int(counts.values.max()),
        "scale": counts,
    }
    # A backslash would begin an escape sequence.
    lines |= {name: note.replace("\\", r"\\") for name, note in notes.items()}
    return "".join(f"{name}={note}\n" for name, note in lines.items())
