"""The colours in which the numbers of a map are drawn, as determined by its declaration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.io.model.maps import Map
from mirrorskin.view.drawing.canvas import exceeded
from mirrorskin.view.drawing.colours import CYCLIC, DIVERGING, ERROR, SEQUENTIAL, apart, span
from mirrorskin.view.result.sheet import Sheet

UNDEFINED_NOTE = "blue: no answer"

_SHOWN = 1, 99  # percentiles at the ends of the colour scale
_DECADES = 30.0  # ratio of these above which the scale is logarithmic
_SIGNED_SHOWN = 99.0  # percentile of the magnitude at the ends of a diverging scale


@dataclass(frozen=True, slots=True)
class Scale:
    """Numbers of a map in the unit of figures, and their colours.

    Attributes
    ----------
    values : ndarray, (H, W), float64
        NaN where undefined.
    colours : str
        Name of a colour map of Matplotlib.
    low, high : float
        Values at its ends.
    label : str
        Name and unit of the values.
    note : str
        What a subtitle says of them; may be empty.
    logarithmic : bool
    beyond : {"neither", "min", "max", "both"}
        Ends that some values exceed.
    """

    values: Floats
    colours: str
    low: float
    high: float
    label: str
    note: str = ""
    logarithmic: bool = False
    beyond: str = "neither"


def scale_of(sheet: Sheet, name: str) -> Scale:
    """Return the numbers of a map with their colours: heights, angles, lengths of vectors, other numbers."""
    declared = sheet.result.declaration(name)
    values = displayed_values(sheet, name)
    if name == sheet.result.name_of("height"):
        return _of_heights(sheet, values, name)
    if declared.components:
        return _of_lengths(values, declared)
    if declared.sampling == "angle":
        return _of_angles(values, name, declared)
    if declared.colours == "signed":
        return _of_signed(values, name, declared)
    return _of_numbers(values, name, declared)


def displayed_values(sheet: Sheet, name: str) -> Floats:
    """Return the values of a map in the unit of figures, NaN where undefined; of frames, the last ones."""
    return in_figures(sheet.result.declaration(name), sheet.result[name])


def in_figures(declared: Map, values: NDArray[Any]) -> Floats:
    """Return values of a map as `displayed_values` does."""
    last = values[-1] if declared.per_frame and values.ndim > 2 + bool(declared.components) else values
    answered = declared.has_answer(last).reshape(*last.shape[:2], *[1] * (last.ndim - 2))
    return np.where(answered, declared.figure_scale * last.astype(np.float64), np.nan)


def labelled(text: str, declared: Map) -> str:
    """Return a text with the unit of figures."""
    return f"{text} ({declared.figure_unit})" if declared.figure_unit else text


def in_figure_unit(value: float, declared: Map) -> str:
    """Return a number as text, in the unit of figures."""
    return f"{declared.figure_scale * value:.4g} {declared.figure_unit}".rstrip()


def title_of_height(sheet: Sheet) -> str:
    """Return the title of the heights in lower case: relative ones if the absolute offset is unknown."""
    name, unknown = sheet.result.name_of("height") or "height", sheet.result.offset_unknown
    title = sheet.of_height.title_of(name)
    title = f"{title[:1].lower()}{title[1:]}"
    return f"relative {title}" if unknown is not None and unknown.size and unknown.all() else title


def missing_note(values: NDArray[Any]) -> str:
    """Return what marks undefined pixels, if there are any."""
    return "" if np.isfinite(values).all() else UNDEFINED_NOTE


def _of_heights(sheet: Sheet, values: Floats, name: str) -> Scale:
    factor = sheet.of_height.figure_scale
    low, high = (factor * end for end in apart(*span(sheet.result[name])))
    label = labelled(title_of_height(sheet), sheet.of_height)
    return Scale(
        values, SEQUENTIAL, low, high, label, missing_note(values), beyond=exceeded(values, low, high)
    )


def _of_lengths(vectors: Floats, declared: Map) -> Scale:
    length = np.sqrt(np.sum(vectors**2, axis=-1))
    finite = length[np.isfinite(length)]
    low, high = apart(float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return Scale(length, SEQUENTIAL, low, high, labelled("length", declared), missing_note(length))


def _of_angles(values: Floats, name: str, declared: Map) -> Scale:
    angle = np.degrees(np.angle(np.exp(1j * values / declared.figure_scale)))
    label = f"{name.replace('_', ' ')} (deg)"
    return Scale(angle, CYCLIC, -180.0, 180.0, label, "0: to the right; 90: up")


def _of_signed(values: Floats, name: str, declared: Map) -> Scale:
    sizes = np.abs(values[np.isfinite(values)])
    side = float(np.percentile(sizes, _SIGNED_SHOWN)) if sizes.any() else 1.0
    label = labelled(name.replace("_", " "), declared)
    ends = exceeded(values, -side, side)
    return Scale(values, DIVERGING, -side, side, label, missing_note(values), beyond=ends)


def _of_numbers(values: Floats, name: str, declared: Map) -> Scale:
    """Return a scale that is logarithmic for positive numbers that span decades."""
    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(finite, _SHOWN)) if finite.size else (0.0, 1.0)
    error = declared.colours == "error"
    notes = [f"median {np.median(finite):.3g} {declared.figure_unit}".rstrip()] if finite.size else []
    return Scale(
        values,
        ERROR if error else SEQUENTIAL,
        *apart(low, high),
        labelled("standard deviation" if error else name.replace("_", " "), declared),
        "; ".join(filter(None, [*notes, missing_note(values)])),
        logarithmic=declared.colours != "sequential" and low > 0 and high > _DECADES * low,
        beyond=exceeded(finite, low, high),
    )
