"""The tables of maps and of status codes in docs/formats.md, from their declarations.

``python docs/site/map_tables.py`` (in the environment) writes them into the page; a test compares them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path

import numpy as np

from mirrorskin.io import Map
from mirrorskin.io.maps import (
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

PAGE = Path(__file__).resolve().parents[1] / "formats.md"

_LEADING = {"pixels": "H, W", "frames": "T,", "pieces": "components,", "none": ""}
_STATUS: dict[str, type[IntEnum]] = {
    "press": PressStatus,
    "release": ReleaseStatus,
    "rotation with a tilt of each frame": PoseStatus,
    "slide, twist": SlipStatus,
    "focus stack": FocusStatus,
    "stitched": StitchStatus,
}


def tables() -> dict[str, str]:
    """Return the tables by their first cell."""
    rows = [_row(name, one) for name, one in TABLE.items()]
    legends = [status_of(codes).codes for codes in _STATUS.values()]
    codes = sorted({code for legend in legends for code in legend})
    meanings = ([str(code), *(legend.get(code, "") for legend in legends)] for code in codes)
    return {
        "map": as_table(["map", "shape, type", "unit", "undefined", "content"], rows),
        "code": as_table(["code", *_STATUS], meanings),
    }


def _row(name: str, one: Map) -> list[str]:
    size = _LEADING[one.axes] + (f", {len(one.components)}" if one.components else "")
    shapes = [f"({size})"] if size else []
    shapes += [f"(T, {size})"] if one.per_frame else []
    dtype = np.dtype(one.dtype)
    unit = f"{one.unit}; of a twist {TWIST[name].unit}" if name in TWIST else one.unit
    undefined = "" if dtype.kind != "f" and one.undefined is None else f"{one.undefined_value:g}"
    undefined = undefined.replace("nan", "NaN") if one.axes != "none" else ""
    legend = ", ".join(f"{code} {text}" for code, text in one.codes.items())
    content = "; ".join(part for part in (one.caption, legend) if part)
    return [f"`{name}`", f"{' or '.join(shapes)} {dtype.str[1:]}".strip(), unit, undefined, content]


def as_table(head: list[str], rows: Iterable[list[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n".replace("  ", " ").replace("  ", " ") for cells in lines)


def with_tables(page: str) -> str:
    """Return the page with its current tables."""
    for first, table in tables().items():
        found = re.findall(rf"^\| {first} \|.*\n(?:\|.*\n)+", page, flags=re.MULTILINE)
        assert len(found) == 1, f"{PAGE} has {len(found)} tables whose first cell is {first}"
        page = page.replace(found[0], table)
    return page


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
