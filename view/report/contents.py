"""What a page says of a result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mirrorskin.engine.summary import summarise
from mirrorskin.io import Result
from mirrorskin.view.report.numbers import numbers_of, sentence
from mirrorskin.view.report.pictures import Ends, pictures_of
from mirrorskin.view.report.surface import surface_data
from mirrorskin.view.report.words import MAPS, PIXELS, UNITS, Rows, told_process

_HEADINGS = {
    "surface": "Surface",
    "pictures": "Pictures",
    "numbers": "Numbers",
    "parameters": "Parameters",
    "provenance": "Where it comes from",
    "calibration": "Calibration",
    "maps": "Maps",
    "units": "Units",
}
_NOT_ALWAYS = ("parameters", "provenance", "calibration")
_NO_HEIGHTS = "This result has no heights, so there is no surface to show."
_NO_SURFACE = "These heights make no surface: that takes two rows and two columns of pixels that touch."


@dataclass(frozen=True, slots=True)
class Group:
    """Names and values that belong together, under a name that may be empty."""

    name: str
    rows: Rows


def contents_of(result: Result, name: str, section: Ends | None, turn: int | None) -> dict[str, Any]:
    """Return what the template of the page is told, by the names that it has there.

    Parameters
    ----------
    result : Result
        Of (H, W) maps.
    name : str
        What to call it.
    section : ((float, float), (float, float)) or None
        Ends of the cross-section, mm.
    turn : int or None
        Which turn these maps are of.

    Raises
    ------
    mirrorskin.io.InputError
        There is a section, and no pixel size to place it by.
    """
    surface = surface_data(result)
    parameters, provenance = told_process(result.process)
    contents = {
        "title": name if turn is None else f"{name}, turn {turn}",
        "summary": sentence(str(summarise(result))),
        "made": _made(result.process),
        "surface": surface,
        "said": _said_of(result, surface),
        "pictures": pictures_of(result, name, section),
        "numbers": numbers_of(result, section),
        "parameters": _groups(parameters),
        "provenance": _groups(provenance),
        "calibration": _calibration_of(result),
        "maps": [(which, *MAPS[which]) for which in MAPS if which in result.maps()],
        "units": UNITS,
        "citation": _citation(name, result.process),
    }
    shown = {part: said for part, said in _HEADINGS.items() if part not in _NOT_ALWAYS or contents[part]}
    return contents | {"headings": shown}


def _said_of(result: Result, surface: Mapping[str, Any] | None) -> dict[str, Any]:
    """Say what is to be seen of the surface, and what is not."""
    if surface is None:
        return {"notes": [_NO_HEIGHTS if result.height is None else _NO_SURFACE]}
    notes = [f"{PIXELS} The surface is not in true proportions."] if surface["unit"] == "px" else []
    low, high = (f"{end:.3f}".replace("-", "\N{MINUS SIGN}") for end in surface["shown"])
    about = f"Surface in space, from {low} to {high} mm high; the picture of heights below shows the same"
    return {"notes": notes + _relative(result), "surface": about, "lowest": low, "highest": f"{high} mm"}


def _relative(result: Result) -> list[str]:
    """Say of how many pieces nobody knows how high they lie."""
    unknown = result.offset_unknown
    if unknown is None or not unknown.any():
        return []
    if unknown.size == 1:
        return ["The height is relative: nobody knows how high it lies, and its mean is put at 0."]
    count = "all" if unknown.all() else f"{np.count_nonzero(unknown)} of"
    return [
        f"The heights of {count} {unknown.size} pieces are relative: nobody knows how high each of them "
        "lies, and its mean is put at 0."
    ]


def _groups(rows: Mapping[str, Rows]) -> list[Group]:
    """Put rows under their names; what is of all comes first, as its name is empty."""
    return [Group(name, rows[name]) for name in sorted(rows)]


def _calibration_of(result: Result) -> list[tuple[str, ...]]:
    """Return the table of the calibration that a result carries, if there is one."""
    if result.calibration is None:
        return []
    from mirrorskin.view.calibration_table import calibration_table

    return [row.cells() for row in calibration_table(result.calibration)]


def _made(process: Mapping[str, object]) -> str:
    """Say when the result was made, by what and of what, as far as it is told."""
    words = {"of": process.get("source"), "by": _program(process), "on": _day(process)}
    told = [f"{word} {value}" for word, value in words.items() if value]
    return f"Made {' '.join(told)}" if told else ""


def _citation(name: str, process: Mapping[str, object]) -> str:
    words = {"reconstructed from": process.get("source"), "by": _program(process), "on": _day(process)}
    return " ".join([name, *(f"{word} {value}" for word, value in words.items() if value)])


def _program(process: Mapping[str, object]) -> str:
    return " ".join(str(process[key]) for key in ("program", "version") if key in process)


def _day(process: Mapping[str, object]) -> str:
    return str(process.get("date", "")).partition("T")[0]
