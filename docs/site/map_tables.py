"""The tables of maps, ``fitted``, status codes, parameters, exports, stages and cameras in the pages.

``python docs/site/map_tables.py`` (in the environment) writes them into the pages, from the
declarations; a test compares them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from enum import IntEnum
from pathlib import Path

import msgspec
import numpy as np

from mirrorskin.hw.base.drivers import CAMERAS, STAGES, Driver, built_in
from mirrorskin.hw.base.rig_file import StageSettings
from mirrorskin.io import Fitted, Map
from mirrorskin.io.base.types import PROPERTIES
from mirrorskin.io.formats.registry import FOLDER, Format, exports, formats
from mirrorskin.io.model.calibration import PARTS
from mirrorskin.io.model.maps import (
    TABLE,
    TWIST,
    FocusStatus,
    PoseStatus,
    PressStatus,
    ReleaseStatus,
    SlipStatus,
    StitchStatus,
    status_of,
)
from mirrorskin.io.model.parameters import Parameter, parameters

DOCS = Path(__file__).resolve().parents[1]
_STORED = {"text": "text", "names": "text", "integer": "i8", "integers": "i8", "flag": "bool"}
_CAMERA = (
    ["`camera/name`", "text", "", "name in the rig file; empty if unknown"],
    ["`camera/shape`", "(2,)", "", "H, W"],
    ["`camera/dtype`", "text", "", "`uint8`, `uint16` or `float32`"],
)
_PROCESS = [
    "`process/PART.NAME`",
    "any",
    "",
    "provenance of a part: `tilt.program`, `zenith.sources` and so on; `zenith`, `tilt`, `elastic` and"
    " `force` include the pixel size used: `pixel_size_x`, `pixel_size_y`, mm",
]

_LEADING = {"pixels": "H, W", "frames": "T,", "pieces": "components,", "none": ""}
_STATUS: dict[str, type[IntEnum]] = {
    "press": PressStatus,
    "release": ReleaseStatus,
    "rotation with a tilt of each frame": PoseStatus,
    "slide, twist": SlipStatus,
    "focus stack": FocusStatus,
    "stitched": StitchStatus,
}


def tables() -> dict[str, dict[str, str]]:
    """Return the tables by page and first cell."""
    rows = [_row(name, declaration) for name, declaration in TABLE.items()]
    legends = [status_of(codes).codes for codes in _STATUS.values()]
    codes = sorted({code for legend in legends for code in legend})
    meanings = ([str(code), *(legend.get(code, "") for legend in legends)] for code in codes)
    stored = [
        _stored(f"{kind.command}/{name}", parameter)
        for kind in PARTS.values()
        for name, parameter in parameters(kind).items()
    ]
    facts = (
        _stored(name, replace(parameter, optional=False)) for name, parameter in parameters(Fitted).items()
    )
    return {
        "formats.md": {
            "map": as_table(["map", "shape, type", "unit", "undefined", "content"], rows),
            "fitted": as_table(["fitted", "shape, type", "unit", "content"], facts),
            "code": as_table(["code", *_STATUS], meanings),
            "frames of other programs": as_table(
                ["frames of other programs", "suffixes", "options", "extra"],
                (_reader(form) for form in formats(installed=False) if form.source),
            ),
            "suffix": as_table(
                ["suffix", "content", "unit, and where it is stated", "holes", "filled heights", "opens in"],
                _rows_of_exports(),
            ),
            "surfaces of other programs": as_table(
                [
                    "surfaces of other programs",
                    "what is read",
                    "unit",
                    "holes",
                    "position",
                    "what is refused",
                    "extra",
                ],
                (_surface(form) for form in formats(installed=False) if form.decoder),
            ),
        },
        "stages.md": {
            "`firmware`": as_table(["`firmware`", "controller", "scans"], map(_stage, built_in(STAGES)))
        },
        "camera.md": {
            "`source` starts with": as_table(
                ["`source` starts with", "cameras", "extra"],
                map(_camera, sorted(built_in(CAMERAS), key=lambda driver: not driver.name)),
            )
        },
        "calibration.md": {
            "dataset": as_table(["dataset", "shape, type", "unit", "content"], [*_CAMERA, *stored, _PROCESS])
        },
    }


def _reader(form: Format) -> list[str]:
    suffixes = ", ".join(f"`{suffix}`" for suffix in form.suffixes if suffix != FOLDER)
    options = ", ".join(f"`--{name}`" for name in form.takes if name in ("dataset", "channel"))
    return [form.source, suffixes, options, f"`mirrorskin[{form.extra}]`" if form.extra else ""]


def _surface(form: Format) -> list[str]:
    return [*form.decoded, f"`mirrorskin[{form.extra}]`" if form.extra else ""]


def _rows_of_exports() -> list[list[str]]:
    """Return what exported files contain, in the order of the declarations."""
    return [list(row) for form in dict.fromkeys(exports(installed=False).values()) for row in form.exported]


def _stage(driver: Driver) -> list[str]:
    (default,) = (
        field.default for field in msgspec.structs.fields(StageSettings) if field.name == "firmware"
    )
    name = f'`"{driver.name}"`, the default' if driver.name == default else f'`"{driver.name}"`'
    return [name, driver.help, "steps" if driver.motion == "steps" else "steps, sweeps and rotations"]


def _camera(driver: Driver) -> list[str]:
    extra = f"`mirrorskin[{driver.extra}]`" if driver.extra else ""
    return [f"`{driver.name}:`" if driver.name else "anything else", driver.help, extra]


def _stored(name: str, parameter: Parameter) -> list[str]:
    """Return the row of a parameter of a calibration."""
    dtype = _STORED.get(parameter.kind, parameter.dtype.str[1:])
    place = f"`{name}/NAME`" if parameter.kind == "mapping" else f"`{name}`"
    return [
        f"{place} *" if parameter.optional else place,
        f"{parameter.size} {dtype}".strip(),
        parameter.unit,
        parameter.text,
    ]


def _row(name: str, declaration: Map) -> list[str]:
    size = _LEADING[declaration.axes] + (f", {len(declaration.components)}" if declaration.components else "")
    shapes = [f"({size})"] if size else []
    shapes += [f"(T, {size})"] if declaration.per_frame else []
    dtype = np.dtype(declaration.dtype)
    unit = f"{declaration.unit}; of a twist {TWIST[name].unit}" if name in TWIST else declaration.unit
    undefined = (
        "" if dtype.kind != "f" and declaration.undefined is None else f"{declaration.undefined_value:g}"
    )
    undefined = undefined.replace("nan", "NaN") if declaration.axes != "none" else ""
    legend = ", ".join(f"{code} {text}" for code, text in declaration.codes.items())
    content = "; ".join(part for part in (declaration.caption, legend) if part)
    return [f"`{name}`", f"{' or '.join(shapes)} {dtype.str[1:]}".strip(), unit, undefined, content]


def as_table(head: list[str], rows: Iterable[list[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n".replace("  ", " ").replace("  ", " ") for cells in lines)


def rows() -> dict[str, list[str]]:
    """Return the rows of declared properties of recordings, by page."""
    layout, keys = [], []
    for table, group in (("camera", "detector"), ("stage", "stage")):
        declared = {name: prop for name, prop in PROPERTIES.items() if prop.of == table}
        for name, prop in declared.items():
            layout.append(f"| `.../{group}/{name}` * | number | {prop.unit} | {prop.text} |\n")
            limits = f"{prop.unit}, {prop.within[0]:g} to {prop.within[1]:g}".removeprefix(", ")
            default = "unknown" if prop.default is None else f"{prop.default:g}"
            keys.append(f"| `{name}` | {limits} | {prop.text}; {prop.use} | {default} |\n")
    return {"formats.md": layout, "rig.md": keys}


def with_rows(page: str, current: list[str]) -> str:
    """Return a page with the current rows in place of those with the same first cell, or below the last."""
    for row, before in zip(current, ["", *current], strict=False):
        first = row.partition(" | ")[0]
        old = re.search(rf"^{re.escape(first)} \|.*\n", page, flags=re.MULTILINE)
        page = page.replace(old[0], row) if old else page.replace(before, before + row)
        assert row in page
    return page


def pages() -> dict[str, str]:
    """Return the pages with their current tables, by name."""
    contents = {}
    for name, current in tables().items():
        page = (DOCS / name).read_text(encoding="utf-8")
        for first, table in current.items():
            tables_found = re.findall(rf"^\| {first} \|.*\n(?:\|.*\n)+", page, flags=re.MULTILINE)
            assert len(tables_found) == 1, (
                f"{name} has {len(tables_found)} tables whose first cell is {first}"
            )
            page = page.replace(tables_found[0], table)
        contents[name] = page
    for name, current_rows in rows().items():
        page = contents.get(name) or (DOCS / name).read_text(encoding="utf-8")
        contents[name] = with_rows(page, current_rows)
    return contents


if __name__ == "__main__":
    for name, page in pages().items():
        (DOCS / name).write_text(page, encoding="utf-8")
