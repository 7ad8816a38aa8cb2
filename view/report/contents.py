"""Contents of a report on a result: pictures, numbers, parameters, provenance."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.summary import summarise
from mirrorskin.engine.metrology import Quantity
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.findings import warnings_in
from mirrorskin.io.base.opencv import encode
from mirrorskin.io.base.types import PIXEL
from mirrorskin.io.model.result import zero_of_relative
from mirrorskin.view.report.surface import surface_data
from mirrorskin.view.report.words import PIXELS, Rows, map_rows, picture_texts, split_process, units_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEADINGS = {
    "surface": "Surface",
    "pictures": "Pictures",
    "numbers": "Numbers",
    "parameters": "Parameters",
    "provenance": "Provenance",
    "calibration": "Calibration",
    "maps": "Maps",
    "units": "Units",
}
_NOT_ALWAYS = ("parameters", "provenance", "calibration")
_NO_HEIGHTS = "This result has no heights, so there is no surface to show."
_NO_SURFACE = "These heights make no surface, which needs two adjacent rows and columns of pixels."


@dataclass(frozen=True, slots=True)
class Group:
    """A group of names and values, with a heading that may be empty."""

    name: str
    rows: Rows


def contents_of(result: Result, name: str, section: Ends | None, turn: int | None) -> dict[str, Any]:
    """Return the variables of the page template."""
    parameters, provenance = split_process(result.process)
    numbers = numbers_of(result, section)  # it needs much memory, which is free again for the pictures
    contents = {
        "title": name if turn is None else f"{name}, turn {turn}",
        "summary": sentence(str(summarise(result))),
        "made": _origin(result.process),
        "warnings": [sentence(text) for text in warnings_in(result.process)],
        **surface_of(result),
        "pictures": pictures_of(result, name, section),
        "numbers": numbers,
        "parameters": _groups(parameters),
        "provenance": _groups(provenance),
        "calibration": _calibration_of(result),
        "maps": map_rows(result),
        "units": units_of(result),
        "citation": _citation(name, result.process),
    }
    shown = {key: text for key, text in _HEADINGS.items() if key not in _NOT_ALWAYS or contents[key]}
    return contents | {"headings": shown}


def surface_of(result: Result) -> dict[str, Any]:
    """Return the variables of the surface."""
    surface = surface_data(result)
    return {"surface": surface, "texts": _surface_texts(result, surface)}


def _surface_texts(result: Result, surface: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the texts of the surface, and notes on what is not shown."""
    if surface is None:
        return {"notes": [_NO_HEIGHTS if result.height is None else _NO_SURFACE]}
    unit, across = surface["unit_of_height"], surface["unit"]
    notes = [PIXELS] if across == PIXEL else []
    notes += ["The surface is not in true proportions."] if across != unit else []
    low, high = (f"{end:.3f}".replace("-", "\N{MINUS SIGN}") for end in surface["shown"])
    about = f"Surface in space, from {low} to {high} {unit} high; the picture of heights below shows the same"
    return {"notes": notes + _relative(result), "surface": about, "lowest": low, "highest": f"{high} {unit}"}


def _relative(result: Result) -> list[str]:
    """Return a note on the pieces with an unknown offset."""
    unknown = result.offset_unknown
    if unknown is None or not unknown.any():
        return []
    if unknown.size == 1:
        return [f"The height is relative: its absolute offset is unknown; {zero_of_relative(result)}."]
    count = "all" if unknown.all() else f"{np.count_nonzero(unknown)} of"
    return [
        f"The heights of {count} {unknown.size} pieces are relative: the offset of each "
        f"is unknown; {zero_of_relative(result)}."
    ]


def _groups(rows: Mapping[str, Rows]) -> list[Group]:
    """Return the groups in order of names; common rows come first, as their name is empty."""
    return [Group(name, rows[name]) for name in sorted(rows)]


def _calibration_of(result: Result) -> list[tuple[str, ...]]:
    """Return the table of the calibration in a result, if there is one."""
    if result.calibration is None:
        return []

    return [row.cells() for row in result.calibration.rows()]


def _origin(process: Mapping[str, object]) -> str:
    """Return the source, program and date of the result, as far as known."""
    words = {"of": process.get("source"), "by": _program(process), "on": _day(process)}
    parts = [f"{word} {value}" for word, value in words.items() if value]
    return f"Made {' '.join(parts)}" if parts else ""


def _citation(name: str, process: Mapping[str, object]) -> str:
    words = {"reconstructed from": process.get("source"), "by": _program(process), "on": _day(process)}
    return " ".join([name, *(f"{word} {value}" for word, value in words.items() if value)])


def _program(process: Mapping[str, object]) -> str:
    return " ".join(str(process[key]) for key in ("program", "version") if key in process)


def _day(process: Mapping[str, object]) -> str:
    return str(process.get("date", "")).partition("T")[0]


_UNITS = {"mm2": "mm²", "mm3": "mm³", "ml/m2": "ml/m²", "deg": "°"}
_UNITS |= {"px2": "px²", "px3": "px³", "px3/px2": "px³/px²"}
_DIGIT, _POINT = "\N{FIGURE SPACE}", "\N{PUNCTUATION SPACE}"


@dataclass(frozen=True, slots=True)
class Row:
    """A quantity as text; unknown parts are empty."""

    name: str
    value: str
    sigma: str
    unit: str
    heading: str = ""  # of the group that the row begins
    meaning: str = ""


@dataclass(frozen=True, slots=True)
class Numbers:
    """The rows of a table, with notes."""

    rows: list[Row]
    notes: list[str]


def numbers_of(result: Result, section: Ends | None) -> Numbers:
    """Measure a result, or return a note on why that is impossible."""
    from mirrorskin.engine import measure
    from mirrorskin.engine.metrology import PARAMETERS, group_of

    try:
        measures = measure(result, section=section)
    except InputError as error:
        return Numbers([], [sentence(str(error))])
    written = [_written(quantity) for quantity in measures.quantities.values()]
    values, sigmas = (align([pair[part] for pair in written]) for part in (0, 1))
    units = [_UNITS.get(quantity.unit, quantity.unit) for quantity in measures.quantities.values()]
    names = list(measures.quantities)
    groups = [sentence(group_of(name)).removesuffix(".") for name in names]
    headings = [
        "" if group == before else group for group, before in zip(groups, ["", *groups[:-1]], strict=True)
    ]
    meanings = [PARAMETERS[name].meaning if name in PARAMETERS else "" for name in names]
    rows = [Row(*row) for row in zip(names, values, sigmas, units, headings, meanings, strict=True)]
    return Numbers(rows, [sentence(note) for note in measures.notes])


def _written(quantity: Quantity) -> tuple[str, str]:
    """Return a value and its uncertainty as text; an unknown uncertainty is empty."""
    number = str(quantity).removesuffix(quantity.unit).strip()
    value, _, sigma = number.replace("-", "\N{MINUS SIGN}").partition(" ± ")
    return value, sigma


def align(numbers: list[str]) -> list[str]:
    """Pad numbers with figure spaces so that their decimal points align."""
    behind = [number.partition(".")[2] for number in numbers]
    longest = max(map(len, behind), default=0)
    return [
        number and number + ("" if "." in number or not longest else _POINT) + _DIGIT * (longest - len(after))
        for number, after in zip(numbers, behind, strict=True)
    ]


def sentence(words: str) -> str:
    """Return words with an initial capital and a full stop."""
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."


Ends = tuple[tuple[float, float], tuple[float, float]]
"""Ends of a cross-section: x and y of both, mm."""

FINENESS = 200
"""Resolution of figures, pixels per inch."""
MOST_BYTES = 400_000
"""Limit of the size of a picture: seven of them and a surface, encoded as text, stay below 5 MB."""

_QUALITIES = 90, 60  # of WebP, for noisy pictures, which PNG cannot compress
_BORDER = 20  # pixels above and below
_WHITE = 250  # values from this one on are background

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with its texts.

    Attributes
    ----------
    caption, alt : str
    source : str
        The picture as a data URL.
    width, height : int
        Pixels.
    """

    caption: str
    alt: str
    source: str
    width: int
    height: int


def pictures_of(result: Result, name: str, section: Ends | None) -> list[Picture]:
    """Draw all figures of a result."""
    from mirrorskin.view.result.figures import each_figure, pixels_of

    pictures = []
    for which, figure in each_figure(result, name=name, section=section):
        pixels = pixels_of(_untitled(figure), round(FINENESS * figure.get_figwidth()))
        pictures.append(_picture(*picture_texts(result, which), pixels))
    return pictures


def _untitled(figure: Figure) -> Figure:
    """Hide a figure's title, since the page has its own."""
    for text in figure.texts:
        text.set_visible(False)
        text.set_in_layout(False)
    return figure


def _picture(caption: str, alt: str, drawn: Pixels) -> Picture:
    pixels = _trimmed(np.asarray(cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), np.uint8))
    kind, data = packed(pixels)
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    return Picture(caption, alt, source, pixels.shape[1], pixels.shape[0])


def _trimmed(pixels: Pixels) -> Pixels:
    """Trim the background above and below to a border."""
    (drawn,) = np.nonzero(np.any(pixels < _WHITE, axis=(1, 2)))
    if not drawn.size:
        return pixels
    return pixels[max(drawn[0] - _BORDER, 0) : drawn[-1] + 1 + _BORDER]


def packed(pixels: Pixels) -> tuple[str, bytes]:
    """Encode a picture in at most ``MOST_BYTES``: losslessly if possible, else lossily, else smaller."""
    png = encode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 4])
    if len(png) <= MOST_BYTES:
        return "png", png
    for quality in _QUALITIES:
        webp = encode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if len(webp) <= MOST_BYTES:
            return "webp", webp
    return packed(
        np.asarray(cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    )
