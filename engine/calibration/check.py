"""What remains of a calibration: errors on a ball that was not used for it, and changes of the brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.reconstruction import calibrated, method_for, reconstruct
from mirrorskin.engine.base.running import Progress, Run
from mirrorskin.engine.calibration.ball import see_ball
from mirrorskin.engine.calibration.sources import check_ball_radius
from mirrorskin.engine.diagnosis.sensor_health import find_clear_change, reference_of
from mirrorskin.io import Calibration, InputError, Result, Source, WallResponse
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.threads import computes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.rotation.response import sight_slopes

_MIN_PIXELS_OF_CELL = 20  # minimum number of pixels with errors in a cell
_MIN_PIXELS_OF_BALL = 100  # minimum number of pixels of the ball
_MAX_EXCESS = 1.5  # RMS over the expected one above which a note is given
_CONTACT_MARGIN = 2  # pixels: width of the excluded margin of the contact
_CENTRE_ITERATIONS = 3  # iterations of the ball's centre, which depends slightly on its depth


class ErrorSummary(NamedTuple):
    """Errors of groups of pixels; NaN for groups with too few."""

    pixels: NDArray[np.intp]
    rms: Doubles
    bias: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class ErrorMap:
    """Errors of one map."""

    error: Doubles  # (H, W): result minus truth, in ``unit``; NaN where there is no error
    whole: ErrorSummary  # all pixels
    cells: ErrorSummary  # equal parts of the picture, (n, n); row 0 is at the top
    unit: str  # "deg" or "mm"
    expected: float = math.nan  # RMS of the result's standard deviations, in ``unit``; NaN without any

    def numbers(self) -> dict[str, Any]:
        """Return numbers for JSON."""
        return {
            "unit": self.unit,
            "pixels": int(self.whole.pixels),
            "rms": float(self.whole.rms),
            "bias": float(self.whole.bias),
            "expected": self.expected,
            "cells": {name: values.tolist() for name, values in self.cells._asdict().items()},
        }

    def row(self) -> list[str]:
        """Return text for a table: RMS, bias, RMS of the worst cell, expected, pixels."""
        worst = self.cells.rms[np.isfinite(self.cells.rms)]
        digits = 3 if self.unit == "deg" else 4
        numbers = [self.whole.rms, self.whole.bias, worst.max() if worst.size else math.nan, self.expected]
        texts = [f"{number:.{digits}f} {self.unit}" if np.isfinite(number) else "-" for number in numbers]
        return [*texts, str(int(self.whole.pixels))]


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """The errors that remain on a ball.

    For a rotation these are zenith, azimuth, normal (the angle between normals) and height; for a press
    height. ``before`` contains the errors with references and precession only; it is empty if unknown.
    """

    ball: float  # diameter, mm
    place: tuple[float, float]  # position of the ball, mm from the picture's centre
    x: Doubles  # (W,): mm
    y: Doubles  # (H,): mm
    after: dict[str, ErrorMap]
    before: dict[str, ErrorMap] = field(default_factory=dict)

    def numbers(self) -> dict[str, Any]:
        """Return numbers for JSON."""
        each = {
            when: {name: errors.numbers() for name, errors in maps.items()}
            for when, maps in (("before", self.before), ("after", self.after))
        }
        return {"ball": self.ball, "place": self.place, **each}

    def table(self) -> list[list[str]]:
        """Return rows of text: map, when, RMS, bias, RMS of the worst cell, expected, pixels."""
        rows = []
        for name in self.after:
            for when, maps in (("before", self.before), ("after", self.after)):
                if name in maps:
                    rows.append([name, when, *maps[name].row()])
        return rows

    def notes(self) -> list[str]:
        """Return the reasons for missing numbers in the table."""
        both = self.before, self.after
        maps = {name: [when[name] for when in both if name in when] for name in self.after}
        excess = [
            f"{name} {ratio:.1f} times"
            for name, errors in self.after.items()
            if (ratio := errors.whole.rms / errors.expected) > _MAX_EXCESS
        ]
        unknown = [
            name for name, each in maps.items() if all(math.isnan(error_map.expected) for error_map in each)
        ]
        few = [
            name
            for name, each in maps.items()
            if any(np.isnan(error_map.cells.rms).all() for error_map in each)
        ]
        notes = []
        if excess:
            notes.append(
                f"rms exceeds what is expected: {', '.join(excess)}; the calibration has errors that"
                " neighbouring pixels share, which standard deviations of single pixels do not show"
            )
        if unknown:
            notes.append(f"expected: results contain no standard deviation of {' or '.join(unknown)} alone")
        if few:
            notes.append(
                f"worst cell's rms: no cell has {_MIN_PIXELS_OF_CELL} pixels of {' and '.join(few)} that"
                " could be judged: take fewer cells, or press deeper"
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
    """Compare the reconstruction of a ball by a calibrated sensor with the ball.

    The position of the ball is estimated from the maps to be checked: its centre from the normals of a
    rotation (by the median), centre and top from the heights of a press. Therefore a common shift is not
    detected, but deviations from a ball of that size are. Heights of a rotation are relative, so their mean
    error is subtracted. Heights of a press include the error of the travel's zero.

    Parameters
    ----------
    source : Source
        A press or a rotation that can be read twice.
    calibration : Calibration
    ball : float
        Diameter of the ball, mm.
    cells : int
        Number of cells along each side of the picture in which errors are summarised.
    device : str or Device, optional

    Raises
    ------
    mirrorskin.io.InputError
        Too little of the ball is visible, or the calibration lacks the part that is checked.
    """
    if source.motion not in ("axial", "vertical"):
        raise InputError(f"{source.name} is of {source.motion} motion: check with a press or a rotation")
    if not source.rewindable:
        raise InputError(f"{source.name} cannot be read twice: record it first")
    check_ball_radius(ball / 2)
    if cells < 1:
        raise InputError(f"{cells} cells a side: give 1 or more")
    check = _check_rotation if source.motion == "axial" else _check_press
    with naming(source):
        return check(source, calibration, ball, cells, device)


def _check_rotation(
    source: Source, calibration: Calibration, ball: float, cells: int, device: str | Device | None
) -> Check:
    """Check zenith, azimuth and relative height of a rotation."""
    response, references = calibration.zenith, calibration.references
    if response is None or response.pattern != "graded":
        raise InputError("the calibration has no zenith to check with a rotation: calibrate zenith first")
    result = reconstruct(source, calibration=calibration, device=device)
    sight = _sight_of(response, result)
    centre = _centre_by_normals(result, sight, ball / 2, source.header.press)
    truth = _true_ball(sight, centre, ball / 2, result)
    before: dict[str, ErrorMap] = {}
    if references is not None:
        # Nominal response of a central pixel: counts per radian, and counts at zenith 0.
        rim = math.atan2(response.radius, response.rim) / 2
        offset, bright = (np.asarray(level, np.float64) for level in (references.dark, references.bright))
        gain = (bright - offset) / (math.pi / 4 - rim)
        sound = np.isfinite(gain)
        gain, offset = (np.where(sound, values, np.median(values[sound])) for values in (gain, offset))
        plain = replace(calibration, zenith=None, gel=None)
        scale: dict[str, Any] = {"zenith_gain": gain, "zenith_offset": offset - rim * gain}
        source.rewind()
        before = _normal_errors(reconstruct(source, plain, device=device, **scale), truth, cells)
    after = _normal_errors(result, truth, cells)
    return Check(ball, (float(centre[0]), float(centre[1])), *_axes(result), after, before)


def _check_press(
    source: Source, calibration: Calibration, ball: float, cells: int, device: str | Device | None
) -> Check:
    """Check the heights of a press."""
    result = reconstruct(source, calibration=calibration, device=device)
    place = _top_by_heights(result, ball / 2)
    before: dict[str, ErrorMap] = {}
    if calibration.gel is not None:
        source.rewind()
        plain = reconstruct(source, calibration=replace(calibration, gel=None), device=device)
        before = _height_errors(plain, place, ball / 2, cells)
    return Check(ball, place, *_axes(result), _height_errors(result, place, ball / 2, cells), before)


def _axes(result: Result) -> tuple[Doubles, Doubles]:
    if result.x is None or result.y is None:
        raise InputError("there is no pixel size, so the ball's size is unknown: give it, or calibrate scale")
    return result.x, result.y


# --- a rotation ---------------------------------------------------------------------------------------------


def _sight_of(response: WallResponse, result: Result) -> Doubles:
    """Return the lines of sight of all pixels, (4, H, W), as in `see_ball`."""
    place = np.stack(np.meshgrid(*_axes(result)))
    slopes = sight_slopes(place - np.reshape(response.axis, (2, 1, 1)), response.sight)
    return np.concatenate([place, slopes])


def _centre_by_normals(result: Result, sight: Doubles, radius: float, press: float | None) -> Doubles:
    """Return the ball's centre, (3,), mm: one radius from each point, opposite to its normal."""
    valid = (result["contact"] != 0) & np.isfinite(result["normals"]).all(axis=-1)
    _check_enough(np.count_nonzero(valid), "in contact have a normal")
    x, y, slope_x, slope_y = sight[:, valid]
    normal_x, normal_y, normal_z = result["normals"][valid].astype(np.float64).T
    centre = np.zeros(3)
    for _ in range(_CENTRE_ITERATIONS):
        depth = press
        if depth is None:
            outline = np.percentile(np.hypot(x - centre[0], y - centre[1]), 99)
            depth = radius - math.sqrt(max(0.0, radius**2 - min(outline, radius) ** 2))
        z = depth - radius + radius * normal_z
        centre_x, centre_y = x + z * slope_x - radius * normal_x, y + z * slope_y - radius * normal_y
        centre = np.array([np.median(centre_x), np.median(centre_y), depth - radius])
    return centre


def _true_ball(sight: Doubles, centre: Doubles, radius: float, result: Result) -> list[Doubles]:
    """Return true zenith, azimuth and height where the ball is in contact in every frame; NaN elsewhere."""
    from scipy.ndimage import binary_erosion

    shape = sight.shape[1:]
    projected = see_ball(sight.reshape(4, -1), centre, radius, np.zeros((1, 2)), np.zeros(3))
    x, y, z = (part.reshape(shape) for part in np.moveaxis(projected.normal[0], -1, 0))
    inside = binary_erosion(
        projected.contact[0].reshape(shape) & (result["contact"] != 0), iterations=_CONTACT_MARGIN
    )
    maps = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x), projected.z[0].reshape(shape)
    return [np.where(inside, values, np.nan) for values in maps]


def _normal_errors(result: Result, truth: list[Doubles], cells: int) -> dict[str, ErrorMap]:
    zenith, azimuth, height = truth
    difference = result["azimuth"] - azimuth
    lean, turn = result["zenith"] - zenith, np.arctan2(np.sin(difference), np.cos(difference))
    sine = np.sqrt(np.sin(result["zenith"]) * np.sin(zenith))
    angle = 2 * np.arcsin(np.sqrt(np.sin(lean / 2) ** 2 + (sine * np.sin(turn / 2)) ** 2))  # haversines
    lean_sigma, turn_sigma, sigma = _sigmas(result)
    errors = {
        "zenith": _errors(np.degrees(lean), "deg", cells, lean_sigma),
        "azimuth": _errors(np.degrees(turn), "deg", cells, turn_sigma),
        "normal": _errors(np.degrees(angle), "deg", cells, sigma),
    }
    _check_enough(errors["zenith"].whole.pixels)
    if result.height is not None and result.component is not None:
        error = result.height - height
        for number in np.unique(result.component[np.isfinite(error)]):
            component = result.component == number
            error[component] -= np.nanmean(error[component])
        errors["height"] = _errors(error, "mm", cells, result.height_sigma)
    return errors


def _sigmas(result: Result) -> list[NDArray[np.float32] | None]:
    """Return standard deviations, degrees, of zenith, azimuth and normals; None if unknown.

    Brightness of N frames shows the zenith by its mean, and the azimuth by a cosine whose amplitude is the
    tilt d. Of the variance of a normal, d^2 / (2 sin^2 zenith) is therefore along the meridian.
    """
    sigma, tilt = result.normals_sigma, result.fitted.tilt
    if sigma is None:
        return [None, None, None]
    degrees = np.degrees(sigma)
    if tilt is None:
        return [None, None, degrees]
    sine, flat = np.sin(result["zenith"]), math.sin(tilt)
    along = flat**2 / 2 / np.maximum(sine, flat) ** 2
    return [degrees * np.sqrt(along), degrees * np.sqrt(1 - along) / np.maximum(sine, flat), degrees]


def _check_enough(pixels: Any, what: str = "could be judged") -> None:
    if pixels < _MIN_PIXELS_OF_BALL:
        raise InputError(
            f"too little of a ball is seen: {pixels} pixels {what}; press deeper, or on a larger ball"
        )


# --- a press ------------------------------------------------------------------------------------------------


def _measured(result: Result) -> NDArray[np.bool_]:
    """Return where heights were measured, not filled."""
    measured: NDArray[np.bool_] = np.isfinite(result["height"])
    return measured if result.filled is None else measured & (result.filled == 0)


def _top_by_heights(result: Result, radius: float) -> tuple[float, float]:
    """Return the position of the top of the ball that fits measured heights best, mm."""
    measured = _measured(result)
    _check_enough(np.count_nonzero(measured), "turn light")
    x, y = (values[measured] for values in np.meshgrid(*_axes(result)))
    height = result["height"][measured].astype(np.float64)

    def residuals(top: Doubles) -> Doubles:
        square = np.minimum((x - top[0]) ** 2 + (y - top[1]) ** 2, 0.999 * radius**2)
        return np.asarray(top[2] + np.sqrt(radius**2 - square) - radius - height)

    start = [np.median(x), np.median(y), height.max()]
    fitted = least_squares.fit(residuals, start, loss=least_squares.soft_l1(0.02))
    return float(fitted.parameters[0]), float(fitted.parameters[1])


def _height_errors(
    result: Result, place: tuple[float, float], radius: float, cells: int
) -> dict[str, ErrorMap]:
    """Compare heights with a ball whose top is touched at travel 0."""
    x, y = np.meshgrid(*_axes(result))
    square = radius**2 - (x - place[0]) ** 2 - (y - place[1]) ** 2
    true = np.sqrt(np.where(_measured(result) & (square > 0), square, np.nan)) - radius
    errors = _errors(result["height"] - true, "mm", cells, result.height_sigma)
    _check_enough(errors.whole.pixels)
    return {"height": errors}


# --- summaries ----------------------------------------------------------------------------------------------


def _errors(error: Doubles, unit: str, cells: int, sigma: NDArray[np.float32] | None = None) -> ErrorMap:
    """Summarise a map of errors."""
    error = np.asarray(error, np.float64)
    valid = np.isfinite(error)
    rows, columns = np.nonzero(valid)
    cell = (cells * rows // error.shape[0]) * cells + cells * columns // error.shape[1]
    expected = math.nan
    if sigma is not None and valid.any():
        expected = float(np.sqrt(np.nanmean(sigma[valid].astype(np.float64) ** 2)))
    whole = _summary(error[valid], np.zeros(len(rows), np.intp), (), 1)
    return ErrorMap(
        error, whole, _summary(error[valid], cell, (cells, cells), _MIN_PIXELS_OF_CELL), unit, expected
    )


def _summary(values: Doubles, group: NDArray[np.intp], shape: tuple[int, ...], fewest: int) -> ErrorSummary:
    """Summarise values by the number of their group, row by row."""
    count = np.bincount(group, minlength=math.prod(shape))
    divisor = np.where(count >= fewest, count, np.nan)
    bias = np.bincount(group, values, minlength=count.size) / divisor
    rms = np.sqrt(np.bincount(group, values**2, minlength=count.size) / divisor)
    return ErrorSummary(count.reshape(shape), rms.reshape(shape), bias.reshape(shape))


@computes
def compare_brightness(
    source: Source,
    calibration: Calibration | str | Path | None = None,
    progress: Progress | None = None,
) -> Finding | None:
    """Compare the brightness of a press or a rotation with the calibration of its sensor.

    Every reconstruction does this, too. See the documentation, "Health of a sensor".

    Parameters
    ----------
    source : Source
        A recording, which is read once, and rewound before and after.
    calibration : Calibration or path, optional
        By default that with the recording; without one, the numbers that the recording states.
    progress : callable, optional
        Called with the number of frames so far.

    Returns
    -------
    Finding or None
        By how much the brightness has changed, if it is clear. None, too, if the recording has nothing to be
        compared with, or cannot be reconstructed.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin.twin import Axial, Twin
    >>> movement = Axial(np.pi / 4 * np.arange(8), tilt=0.05, press=1.0)
    >>> turn = Twin(object="step", shape=(80, 80), pixel_size=0.13, movement=movement, pattern="linear")
    >>> compare_brightness(turn) is None
    True
    """
    if source.motion not in ("vertical", "axial") or not source.rewindable:
        return None
    source.rewind()
    try:
        opened = calibrated(source, calibration)
        plan = replace(method_for(source.motion)().plan(opened), steps=[])
        result = Run(plan, opened).complete(progress)
    except InputError:
        return None
    finally:
        source.rewind()
    return find_clear_change(result.fitted, reference_of(opened))
