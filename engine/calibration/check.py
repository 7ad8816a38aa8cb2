"""What errors a calibration leaves, on a ball that was not used for it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import see_ball
from mirrorskin.engine.provenance import naming
from mirrorskin.engine.reconstruction import calibrated, reconstruct
from mirrorskin.engine.rotation.rotation import Rotation
from mirrorskin.io import Calibration, InputError, Result, Source, WallResponse
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]

_FEWEST = 20  # pixels of a cell with errors
_LEAST = 100  # pixels of a ball that is judged
_MARGIN = 2  # pixels inside of where contact ends
_ROUNDS = 3  # of the search for the ball's centre, which its depth changes a little


class Summary(NamedTuple):
    """Errors of some pixels; NaN where there are too few."""

    pixels: NDArray[np.intp]
    rms: Doubles
    bias: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """What is wrong with one map."""

    error: Doubles  # (H, W): found minus true, in ``unit``; NaN where nothing is judged
    whole: Summary  # of all pixels
    cells: Summary  # of equal parts of the picture, (n, n); row 0 is its upper edge
    unit: str  # "deg" or "mm"
    expected: float = math.nan  # RMS of the result's standard deviations, in ``unit``; NaN without any

    def numbers(self) -> dict[str, Any]:
        """Return what there is to print, and to keep."""
        return {
            "unit": self.unit,
            "pixels": int(self.whole.pixels),
            "rms": float(self.whole.rms),
            "bias": float(self.whole.bias),
            "expected": self.expected,
            "cells": {name: values.tolist() for name, values in self.cells._asdict().items()},
        }


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """The errors left on a ball.

    Of a rotation there are zenith, azimuth, normal (the whole angle) and height, of a press height. Before is
    with the references and the precession alone, and empty where that is unknown.
    """

    ball: float  # diameter, mm
    place: tuple[float, float]  # where it was found, mm from the picture's centre
    x: Doubles  # (W,): mm
    y: Doubles  # (H,): mm
    after: dict[str, Errors]
    before: dict[str, Errors] = field(default_factory=dict)

    def numbers(self) -> dict[str, Any]:
        """Return what there is to print as JSON."""
        each = {
            when: {name: errors.numbers() for name, errors in parts.items()}
            for when, parts in (("before", self.before), ("after", self.after))
        }
        return {"ball": self.ball, "place": self.place, **each}

    def table(self) -> list[list[str]]:
        """Return rows of words: what, when, RMS, bias, RMS of the worst cell, expected, pixels."""
        rows = []
        for name in self.after:
            for when, parts in (("before", self.before), ("after", self.after)):
                if name in parts:
                    rows.append([name, when, *_words(parts[name])])
        return rows

    def notes(self) -> list[str]:
        """Return why the table has no number, where it has none."""
        parts = {
            name: [when[name] for when in (self.before, self.after) if name in when] for name in self.after
        }
        unknown = [name for name, each in parts.items() if all(math.isnan(one.expected) for one in each)]
        few = [name for name, each in parts.items() if any(np.isnan(one.cells.rms).all() for one in each)]
        notes = []
        if unknown:
            notes.append(f"expected: a result tells no errors of {' and '.join(unknown)} alone")
        if few:
            notes.append(
                f"worst cell's rms: no cell has {_FEWEST} pixels of {' and '.join(few)} that could be judged:"
                " take fewer cells, or press deeper"
            )
        return notes


def check_ball(
    source: Source,
    calibration: Calibration,
    ball: float,
    *,
    cells: int = 8,
    device: str | Device | None = None,
) -> Check:
    """Compare what a calibrated sensor makes of a ball with the ball.

    Where the ball lies is found from the very maps that are judged: its centre from the normals of a rotation
    (their median), centre and top from the heights of a press. So a common shift is not seen, but how the
    maps differ from a ball of that size. Heights of a rotation are relative: their mean difference is taken
    off. Those of a press have the bias of the top, which is that of the travel's zero as well.

    The ``source`` is rewindable, ``ball`` a diameter, mm; the field is cut into ``cells`` parts a side.
    InputError where too little of the ball is seen, or the calibration lacks what is to be checked.
    """
    if source.motion not in ("axial", "vertical"):
        raise InputError(f"{source.name} is of {source.motion} motion: check with a press or a rotation")
    if not source.rewindable:
        raise InputError(f"{source.name} cannot be read twice: record it first")
    if not (math.isfinite(ball) and ball > 0):
        raise InputError(f"a ball of {ball} mm cannot be: give its diameter")
    if cells < 1:
        raise InputError(f"{cells} cells a side cannot be: give 1 or more")
    check = _check_rotation if source.motion == "axial" else _check_press
    with naming(source):
        return check(source, calibration, ball, cells, device)


def _check_rotation(
    source: Source, calibration: Calibration, ball: float, cells: int, device: str | Device | None
) -> Check:
    """Judge zenith, azimuth and relative height of a rotation."""
    response, references = calibration.zenith, calibration.references
    if response is None or response.pattern != "graded":
        raise InputError("the calibration has no zenith to check with a rotation: calibrate zenith first")
    found = reconstruct(source, calibration=calibration, device=device)
    sight = _sight_of(response, found)
    centre = _centre_by_normals(found, sight, ball / 2, source.header.press)
    truth = _true_ball(sight, centre, ball / 2, found)
    before: dict[str, Errors] = {}
    if references is not None:
        # As the wall was designed, all pixels central: counts per radian, and at zenith 0.
        rim = math.atan2(response.radius, response.rim) / 2
        offset, bright = (np.asarray(part, np.float64) for part in (references.dark, references.bright))
        gain = (bright - offset) / (math.pi / 4 - rim)
        sound = np.isfinite(gain)
        gain, offset = (np.where(sound, part, np.median(part[sound])) for part in (gain, offset))
        plain = replace(calibration, zenith=None, gel=None)
        source.rewind()
        linear = Rotation(zenith_gain=gain, zenith_offset=offset - rim * gain, device=device)
        first = linear.run(calibrated(source, plain))
        before = _normal_errors(first, truth, cells)
    after = _normal_errors(found, truth, cells)
    return Check(ball, (float(centre[0]), float(centre[1])), *_axes(found), after, before)


def _check_press(
    source: Source, calibration: Calibration, ball: float, cells: int, device: str | Device | None
) -> Check:
    """Judge the heights of a press."""
    found = reconstruct(source, calibration=calibration, device=device)
    place = _top_by_heights(found, ball / 2)
    before: dict[str, Errors] = {}
    if calibration.gel is not None:
        source.rewind()
        first = reconstruct(source, calibration=replace(calibration, gel=None), device=device)
        before = _height_errors(first, place, ball / 2, cells)
    return Check(ball, place, *_axes(found), _height_errors(found, place, ball / 2, cells), before)


def _axes(found: Result) -> tuple[Doubles, Doubles]:
    if found.x is None or found.y is None:
        raise InputError("without a pixel size a ball has no size: give it, or calibrate scale")
    return found.x, found.y


# --- a rotation ---------------------------------------------------------------------------------------------


class _Truth(NamedTuple):
    """What each pixel should have found: maps of (H, W); NaN where the ball is not seen."""

    zenith: Doubles
    azimuth: Doubles
    height: Doubles


def _sight_of(response: WallResponse, found: Result) -> Doubles:
    """Return the lines of sight of all pixels, (4, H, W): x, y, and how they move with z."""
    place = np.stack(np.meshgrid(*_axes(found)))
    slopes = response.sight_slopes(place - np.reshape(response.axis, (2, 1, 1)))
    return np.concatenate([place, slopes])


def _centre_by_normals(found: Result, sight: Doubles, radius: float, press: float | None) -> Doubles:
    """Return the ball's centre, (3,), mm: from each point it is a radius against the normal."""
    assert found.normals is not None
    assert found.contact is not None
    known = (found.contact != 0) & np.isfinite(found.normals).all(axis=-1)
    _check_enough(np.count_nonzero(known), "in contact have a normal")
    x, y, slope_x, slope_y = sight[:, known]
    lean_x, lean_y, upright = found.normals[known].astype(np.float64).T
    centre = np.zeros(3)
    for _ in range(_ROUNDS):
        depth = press
        if depth is None:
            outline = np.percentile(np.hypot(x - centre[0], y - centre[1]), 99)
            depth = radius - math.sqrt(max(0.0, radius**2 - min(outline, radius) ** 2))
        z = depth - radius + radius * upright
        across, up = (x + z * slope_x - radius * lean_x, y + z * slope_y - radius * lean_y)
        centre = np.array([np.median(across), np.median(up), depth - radius])
    return centre


def _true_ball(sight: Doubles, centre: Doubles, radius: float, found: Result) -> _Truth:
    """Return what is true of the ball, where it is in contact in every frame, but for a margin."""
    from scipy.ndimage import binary_erosion

    shape = sight.shape[1:]
    seen = see_ball(sight.reshape(4, -1), centre, radius, np.zeros((1, 2)), np.zeros(3))
    x, y, z = (part.reshape(shape) for part in np.moveaxis(seen.normal[0], -1, 0))
    assert found.contact is not None
    inside = binary_erosion(seen.contact[0].reshape(shape) & (found.contact != 0), iterations=_MARGIN)
    zenith, azimuth, height = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x), seen.z[0].reshape(shape)
    return _Truth(*(np.where(inside, part, np.nan) for part in (zenith, azimuth, height)))


def _normal_errors(found: Result, truth: _Truth, cells: int) -> dict[str, Errors]:
    """Compare normals and heights; what the result does not know is not judged."""
    assert found.zenith is not None
    assert found.azimuth is not None
    around = found.azimuth - truth.azimuth
    lean, turn = found.zenith - truth.zenith, np.arctan2(np.sin(around), np.cos(around))
    sine = np.sqrt(np.sin(found.zenith) * np.sin(truth.zenith))
    apart = 2 * np.arcsin(np.sqrt(np.sin(lean / 2) ** 2 + (sine * np.sin(turn / 2)) ** 2))  # haversines
    sigma = None if found.normals_sigma is None else np.degrees(found.normals_sigma)
    errors = {
        "zenith": _errors(np.degrees(lean), "deg", cells),
        "azimuth": _errors(np.degrees(turn), "deg", cells),
        "normal": _errors(np.degrees(apart), "deg", cells, sigma),
    }
    _check_enough(errors["zenith"].whole.pixels)
    if found.height is not None and found.component is not None:
        error = found.height - truth.height
        for piece in np.unique(found.component[np.isfinite(error)]):
            here = found.component == piece
            error[here] -= np.nanmean(error[here])
        errors["height"] = _errors(error, "mm", cells, found.height_sigma)
    return errors


def _check_enough(pixels: Any, what: str = "could be judged") -> None:
    if pixels < _LEAST:
        raise InputError(
            f"too little of a ball is seen: {pixels} pixels {what}; press deeper, or on a larger ball"
        )


# --- a press ------------------------------------------------------------------------------------------------


def _measured(found: Result) -> NDArray[np.bool_]:
    """Return where a height was measured, not filled in."""
    assert found.height is not None
    measured: NDArray[np.bool_] = np.isfinite(found.height)
    return measured if found.filled is None else measured & (found.filled == 0)


def _top_by_heights(found: Result, radius: float) -> tuple[float, float]:
    """Return where the top of a ball of that radius lies that fits measured heights best, mm."""
    from scipy.optimize import least_squares

    here = _measured(found)
    _check_enough(np.count_nonzero(here), "turn light")
    assert found.height is not None
    x, y = (part[here] for part in np.meshgrid(*_axes(found)))
    height = found.height[here].astype(np.float64)

    def missed(ball: Doubles) -> Doubles:
        away = np.minimum((x - ball[0]) ** 2 + (y - ball[1]) ** 2, 0.999 * radius**2)
        return np.asarray(ball[2] + np.sqrt(radius**2 - away) - radius - height)

    start = [np.median(x), np.median(y), height.max()]
    fitted = least_squares(missed, start, loss="soft_l1", f_scale=0.02, x_scale=[1.0, 1.0, 0.1])
    return float(fitted.x[0]), float(fitted.x[1])


def _height_errors(found: Result, place: tuple[float, float], radius: float, cells: int) -> dict[str, Errors]:
    """Compare heights with a ball whose top is touched at travel 0."""
    assert found.height is not None
    x, y = np.meshgrid(*_axes(found))
    rise = radius**2 - (x - place[0]) ** 2 - (y - place[1]) ** 2
    true = np.sqrt(np.where(_measured(found) & (rise > 0), rise, np.nan)) - radius
    height = _errors(found.height - true, "mm", cells, found.height_sigma)
    _check_enough(height.whole.pixels)
    return {"height": height}


# --- sums ---------------------------------------------------------------------------------------------------


def _errors(error: Doubles, unit: str, cells: int, sigma: NDArray[np.float32] | None = None) -> Errors:
    """Sum up a map of errors."""
    error = np.asarray(error, np.float64)
    known = np.isfinite(error)
    rows, columns = np.nonzero(known)
    cell = (cells * rows // error.shape[0]) * cells + cells * columns // error.shape[1]
    expected = math.nan
    if sigma is not None and known.any():
        expected = float(np.sqrt(np.nanmean(sigma[known].astype(np.float64) ** 2)))
    whole = _summary(error[known], np.zeros(len(rows), np.intp), (), 1)
    return Errors(error, whole, _summary(error[known], cell, (cells, cells), _FEWEST), unit, expected)


def _summary(values: Doubles, group: NDArray[np.intp], shape: tuple[int, ...], fewest: int) -> Summary:
    """Sum up values by the number of their group, row by row."""
    count = np.bincount(group, minlength=math.prod(shape))
    each = np.where(count >= fewest, count, np.nan)
    bias = np.bincount(group, values, minlength=count.size) / each
    rms = np.sqrt(np.bincount(group, values**2, minlength=count.size) / each)
    return Summary(count.reshape(shape), rms.reshape(shape), bias.reshape(shape))


def _words(errors: Errors) -> list[str]:
    worst = errors.cells.rms[np.isfinite(errors.cells.rms)]
    digits = 3 if errors.unit == "deg" else 4
    numbers = [errors.whole.rms, errors.whole.bias, worst.max() if worst.size else math.nan, errors.expected]
    words = [f"{number:.{digits}f} {errors.unit}" if np.isfinite(number) else "-" for number in numbers]
    return [*words, str(int(errors.whole.pixels))]
