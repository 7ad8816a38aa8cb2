"""Texts of a report: captions of pictures, meanings of maps, and a result's parameters and provenance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mirrorskin.io.model.result import in_pixels

if TYPE_CHECKING:
    from mirrorskin.io import Result

_GRAPHS: Mapping[str, tuple[str, str]] = {
    "section": (
        "Section along the line from A to B; the band is as wide as the number of standard deviations in its"
        " legend.",
        "Cross-section: height along the line from A to B",
    ),
    "histogram": ("Number of pixels with each height.", "Histogram of the heights"),
}
_ADDITIONS: Mapping[str, str] = {  # notes on the colours of a figure
    "height": "Blue has no answer.",
    "filled": "Blue has no answer, and orange was filled, not measured.",
    "direction": "Red, green and blue are the components along x, y and z; edges are black.",
    "vectors": "Arrows show the direction.",
}


def picture_texts(result: Result, name: str) -> tuple[str, str]:
    """Return the caption and the alternative text of a picture."""
    if name in _GRAPHS:
        return _GRAPHS[name]
    declared, title = result.declaration(name), result.declaration(name).title_of(name)
    kind = "vectors" if declared.components else ""
    kind = "direction" if declared.sampling == "direction" else kind
    if name == result.name_of("height"):
        kind = "filled" if result.filled is not None and result.filled.any() else "height"
    repeats = declared.caption.casefold() in ("", title.casefold())
    sentences = [f"{title}." if repeats else f"{title}: {declared.caption}."]
    sentences += [_ADDITIONS[kind]] if kind else []
    unit = f" in {declared.figure_unit}" if declared.figure_unit else ""
    return " ".join(sentences), f"Map: {title[:1].lower()}{title[1:]}{unit}"


def map_rows(result: Result) -> list[tuple[str, str, str]]:
    """Return name, unit and meaning of each map, with the legend of its codes."""
    rows = []
    for name in result.maps():
        declared = result.declaration(name)
        legend = ", ".join(f"{code} {text}" for code, text in declared.codes.items())
        meaning = ": ".join(part for part in (declared.caption, legend) if part)
        rows.append((name, declared.unit, meaning or "no description"))
    return rows


_LENGTHS = "Lengths are in millimetres."
_LENGTHS_IN_PIXELS = "Lengths are in pixels, as the pixel size is unknown."
_UNITS_OF_ALL = (
    "{lengths} x runs to the right and y up the picture, both from its centre to the "
    "centres of the pixels; z runs towards the camera. Angles are radians in the file, and degrees in "
    "pictures.",
    "A pixel without an answer is NaN in the file and empty in pictures. Every uncertainty is a standard "
    "uncertainty (k = 1).",
)


def units_of(result: Result) -> tuple[str, ...]:
    """Return the conventions for all numbers of a result."""
    lengths = _LENGTHS_IN_PIXELS if in_pixels(result) else _LENGTHS
    return tuple(text.format(lengths=lengths) for text in _UNITS_OF_ALL)


PIXELS = "The pixel size of this result is unknown, so positions are in pixels from the centre."

_FIRST = (
    "program",
    "version",
    "date",
    "source",
    "dataset",
    "source_fingerprint",
    "source_modified",
    "source_region",
    "source_frames",
    "device",
    "driver",
    "calibration",
    "calibration_parts",
)
"""Process values that are provenance; the others are parameters."""

_UNITS = {
    **dict.fromkeys(("tilt", "angle"), "rad"),
    **dict.fromkeys(("centre_x", "centre_y"), "mm"),
    "slope_direction": "rad",
    **dict.fromkeys(("travel", "travel_amplitude"), "mm"),
    **dict.fromkeys(("area_growth", "area_growth_sigma"), "mm^2/mm"),
    **dict.fromkeys(("frequency", "frequency_sigma"), "Hz"),
    "zenith_error": "rad",
    "zenith_gain": "counts/rad",
    **dict.fromkeys(("zenith_offset", "noise", "dark", "bright", "low", "high"), "counts"),
}
_MOTIONS = {"vertical": "Press", "axial": "Rotation"}
_FUSED = "fusion"

Rows = list[tuple[str, str]]


def split_process(process: Mapping[str, object]) -> tuple[dict[str, Rows], dict[str, Rows]]:
    """Split the process of a result into parameters and provenance, as text."""
    parameters: dict[str, Rows] = {}
    provenance: dict[str, Rows] = {}
    for name, value in process.items():
        motion, field = _motion_of(name) if process.get("method") == _FUSED else ("", name)
        place = provenance if field in _FIRST else parameters
        place.setdefault(motion, []).append((field.replace("_", " "), _text(field, value)))
    for rows in provenance.values():
        rows.sort(key=lambda row: _FIRST.index(row[0].replace(" ", "_")))
    return parameters, provenance


def _motion_of(name: str) -> tuple[str, str]:
    motion, _, field = name.partition("_")
    return (_MOTIONS[motion], field) if motion in _MOTIONS else ("", name)


def _text(name: str, value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g} {_UNITS.get(name, '')}".strip()
    return str(value)
