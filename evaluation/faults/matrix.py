"""Errors and standard deviations of each estimator with each fault of a camera.

``python evaluation/faults/matrix.py`` (in the environment) prints the cells; ``--freeze`` stores them in
``evaluation/faults/matrix.json`` and writes the tables of docs/faults.md. It refuses if a standard
deviation became wrong that was right.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mirrorskin import engine
from mirrorskin.evaluation.base.tables import Table, replace_part
from mirrorskin.evaluation.faults.camera import (
    DARK,
    FAULTS,
    POINTS,
    READ_NOISE,
    SPAN,
    Fault,
    Floats,
    centres,
    points,
    record,
    references,
)
from mirrorskin.evaluation.faults.slopes import SLOPE_FAULTS, integrated
from mirrorskin.io import MirrorskinWarning, Result
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.model.frames import lossy

SHAPE, PIXEL = (48, 64), 0.05  # pixels; mm
LIMITS = 2.0, 0.02  # of an honest cell: chi^2, and the share of errors beyond three standard deviations
_STORED = Path(__file__).with_suffix(".json")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


@dataclass(frozen=True)
class Cell:
    """How an estimator fared with a fault.

    Attributes
    ----------
    error : float
        RMS error over that without a fault.
    chi2 : float
        Mean of the square errors over the variances; 1 is right.
    beyond : float
        Share of the errors beyond three standard deviations.
    kept : float
        Share of the pixels that have an answer.
    warned : bool
        Whether the result has a warning.
    """

    error: float
    chi2: float
    beyond: float
    kept: float
    warned: bool

    def __str__(self) -> str:
        notes = ("  warned" if self.warned else "") + ("" if self.honest else "  <--")
        return (
            f"error {self.error:6.2f}  chi2 {self.chi2:8.2f}  beyond {100 * self.beyond:6.2f} %"
            f"  kept {100 * self.kept:5.1f} %{notes}"
        )

    @property
    def honest(self) -> bool:
        """Whether the standard deviation is true, or something is said about it."""
        return self.warned or self.kept == 0 or (self.chi2 <= LIMITS[0] and self.beyond <= LIMITS[1])

    @property
    def clearly_honest(self) -> bool:
        """Whether a cell is so far from the limits that rounding on another device does not change it."""
        return self.honest and (
            self.warned or (self.chi2 <= 0.8 * LIMITS[0] and self.beyond <= LIMITS[1] / 2)
        )


@dataclass(frozen=True)
class Answer:
    """Errors of an estimator and their standard deviations; NaN where there is no answer."""

    error: Floats
    sigma: Floats
    warned: bool


# --- Scenes --------------------------------------------------------------------------------------------


def _waves(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return heights of a wavy surface, and how they change along x and y."""
    u, v = 2 * np.pi * x / 1.6, 2 * np.pi * y / 1.9
    height = 0.2 * np.sin(u) * np.cos(v) - 0.6
    return (
        height,
        0.2 * 2 * np.pi / 1.6 * np.cos(u) * np.cos(v),
        -0.2 * 2 * np.pi / 1.9 * np.sin(u) * np.sin(v),
    )


def _crater(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return heights of a plate with a round bowl whose rim is sharp, and how they change."""
    radius = np.hypot(x, y)
    inside = radius < 0.9
    height = np.where(inside, -0.5 - 0.4 * (1 - (radius / 0.9) ** 2), -0.5)
    slope = np.where(inside, 0.8 / 0.81, 0.0)
    return height, slope * x, slope * y


Surface = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]


def _touched(surface: Surface) -> Callable[[Floats], Floats]:
    """Return the light of a press: the share of the surroundings of a point that the sheet touches."""
    height, along_x, along_y = surface(*points(SHAPE, PIXEL))
    width = (np.abs(along_x) + np.abs(along_y)) * PIXEL / 4 + 1e-9
    return lambda travel: np.clip((travel + height) / width + 0.5, 0, 1)


def _normals(surface: Surface, x: Floats, y: Floats) -> Floats:
    _, along_x, along_y = surface(x, y)
    normal = np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


STEEPEST, TILT = np.radians(55), np.radians(2.5)


def _leaning(surface: Surface) -> Callable[[Floats], Floats]:
    """Return the light of a rotation: proportional to the angle between the normal and the body's axis."""
    normal = _normals(surface, *points(SHAPE, PIXEL))

    def light(phase: Floats) -> Floats:
        lean = math.sin(TILT) * (normal[..., 0] * np.cos(phase) + normal[..., 1] * np.sin(phase))
        return np.asarray(np.arccos(np.clip(normal[..., 2] * math.cos(TILT) - lean, -1, 1)) / STEEPEST)

    return light


def _fringes(x: Floats, y: Floats) -> Floats:
    return 2 * np.pi * x / 0.8 + 1.2 * np.sin(2 * np.pi * y / 2.1)


ZENITH = np.radians(35)


def _lit(phase: Floats) -> Floats:
    """Return the light of a matt surface under a lamp at an azimuth."""
    normal = _normals(_waves, *points(SHAPE, PIXEL))
    lamp = math.sin(ZENITH) * (normal[..., 0] * np.cos(phase) + normal[..., 1] * np.sin(phase))
    return 0.8 * np.maximum(lamp + math.cos(ZENITH) * normal[..., 2], 0)


@functools.cache
def _texture() -> Floats:
    """Return directions, phases and amplitudes of the waves of a speckled surface, (3 + 1, n)."""
    generator = np.random.default_rng(3)
    angle, length = generator.uniform(0, 2 * np.pi, 60), generator.uniform(4, 10, 60) * PIXEL
    phase = generator.uniform(0, 2 * np.pi, 60)
    return np.stack([2 * np.pi * np.cos(angle) / length, 2 * np.pi * np.sin(angle) / length, phase])


SHIFT = 0.4 * PIXEL  # mm along x, from the reference to the frame


def _speckle(number: Floats) -> Floats:
    """Return the light of a speckled surface that moves along x, by a shift a frame."""
    x, y = points(SHAPE, PIXEL)
    moved = x - number * SHIFT
    waves = sum(np.cos(along * moved + up * y + phase) for along, up, phase in _texture().T)
    return 0.5 + 0.35 * np.tanh(np.asarray(waves) / 8)


_BLURS = np.arange(0, 8.1, 0.5)  # standard deviations of a defocused point, points


@functools.cache
def _defocused() -> Floats:
    """Return the speckled surface out of focus, (blurs, points, points)."""
    sharp = _speckle(np.zeros((1, 1, 1)))[0]
    return np.stack([gaussian_filter(sharp, blur, mode="nearest") if blur else sharp for blur in _BLURS])


def _focused(travel: Floats) -> Floats:
    """Return the light of the wavy surface, speckled, through a lens in focus at the travel."""
    height = _waves(*points(SHAPE, PIXEL))[0]
    blur = np.clip(np.sqrt(1 + (15 * (travel + height)) ** 2), 0, _BLURS[-2])[0]
    number = blur / _BLURS[1]
    low = np.floor(number).astype(int)
    levels, fraction = _defocused(), number - low
    at = np.arange(blur.shape[0])[:, np.newaxis], np.arange(blur.shape[1])
    return np.asarray((1 - fraction) * levels[low, *at] + fraction * levels[low + 1, *at])[np.newaxis]


# --- Estimators ----------------------------------------------------------------------------------------


def _opened(frames: Any, positions: dict[str, Any], header: dict[str, Any], fault: Fault) -> ArrayRecording:
    """Return frames as a source, which says that they were compressed, as that of a file does."""
    source = ArrayRecording(frames, positions, header)
    if fault.codec:
        source.findings = (lossy(fault.codec),)
    return source


@functools.cache
def _press(surface: Surface, step: float, fault: Fault, seed: int) -> ArrayRecording:
    travel = np.arange(0.2, 1.1, step)
    frames = record(_touched(surface), travel, fault, seed)
    dark, bright = references(SHAPE, fault, seed + 1)
    header = {"pixel_size": (PIXEL, PIXEL), "dark": dark.astype("f4"), "bright": bright.astype("f4")}
    if not fault.stated:
        return _opened(frames, {"travel": travel}, header, fault)
    if fault.jitter:
        header["travel_sigma"] = fault.jitter * step
    if fault.shutter:  # the travel and the time of a frame are those of its middle row
        header["line_time"] = fault.shutter * POINTS / (POINTS * SHAPE[0] - 1)
        travel = travel + fault.shutter * step / 2
    source = _opened(frames, {"travel": travel}, header, fault)
    source.time = np.arange(len(travel), dtype=float)
    return source


@functools.cache
def _turn(surface: Surface, fault: Fault, seed: int, count: int = 16) -> ArrayRecording:
    phase = np.arange(count) * 2 * np.pi / count
    frames = record(_leaning(surface), phase, fault, seed)
    return _opened(frames, {"phase": phase}, {"pixel_size": (PIXEL, PIXEL), "tilt": TILT}, fault)


def _scale(fault: Fault) -> dict[str, Any]:
    """Return the options of a rotation that state how brightness depends on the zenith."""
    return {
        "zenith_gain": fault.scale * fault.exposure * SPAN / STEEPEST,
        "zenith_offset": fault.scale * DARK,
    }


def _reconstruct_press(source: ArrayRecording) -> Result:
    return engine.reconstruct(source, fill=False)


def _onset(
    surface: Surface, step: float, compute: Callable[[ArrayRecording], Result] = _reconstruct_press
) -> Callable[[Fault, int], Answer]:
    truth = surface(*centres(SHAPE, PIXEL))[0]

    def answer(fault: Fault, seed: int) -> Answer:
        result, warned = _watched(lambda: compute(_press(surface, step, fault, seed)))
        return Answer(result.height - truth, result.height_sigma, warned)

    return answer


def _change_point(source: ArrayRecording) -> Result:
    return engine.reconstruct(source, fill=False, method="change-point")


def _angle(normals: NDArray[Any], true: Floats) -> Floats:
    across = np.linalg.norm(np.cross(normals.astype(np.float64), true), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(normals * true, axis=-1)))


@functools.cache
def _reconstruct_turn(fault: Fault, seed: int) -> tuple[Result, bool]:
    return _watched(lambda: engine.reconstruct(_turn(_waves, fault, seed), **_scale(fault)))


Turn = Callable[[Fault, int], tuple[Result, bool]]
"""Return the result of a rotation, and whether it has a warning."""


def _rotation(fault: Fault, seed: int, compute: Turn = _reconstruct_turn) -> Answer:
    truth = _normals(_waves, *centres(SHAPE, PIXEL))
    result, warned = compute(fault, seed)
    return Answer(_angle(result.normals, truth), result.normals_sigma, warned)


def _integrated(fault: Fault, seed: int, compute: Turn = _reconstruct_turn) -> Answer:
    truth = _waves(*centres(SHAPE, PIXEL))[0]
    result, warned = compute(fault, seed)
    largest = np.bincount(result.component[result.component >= 0]).argmax()
    error = np.where(result.component == largest, result.height - truth, np.nan)
    return Answer(error - np.nanmean(error), result.height_sigma, warned)


def _fuse_recordings(fault: Fault, seed: int) -> Result:
    press, turn = _press(_waves, 0.05, fault, seed), _turn(_waves, fault, seed + 2)
    return engine.fuse(press, turn, rotation=_scale(fault), register=False)


def _fused(fault: Fault, seed: int, compute: Callable[[Fault, int], Result] = _fuse_recordings) -> Answer:
    truth = _waves(*centres(SHAPE, PIXEL))[0]
    result, warned = _watched(lambda: compute(fault, seed))
    return Answer(result.height - truth, result.height_sigma, warned)


def _fit_recording(source: ArrayRecording) -> Result:
    return engine.run(source, engine.optical.Fringes)


def _of_fringes(
    fault: Fault, seed: int, compute: Callable[[ArrayRecording], Result] = _fit_recording
) -> Answer:
    phase = _fringes(*points(SHAPE, PIXEL))
    shift = np.arange(8) * np.pi / 4
    frames = record(lambda at: 0.5 + 0.4 * np.cos(phase - at), shift, fault, seed)
    result, warned = _watched(lambda: compute(_opened(frames, {"phase": shift}, {}, fault)))
    error = result.phase - _fringes(*centres(SHAPE, PIXEL))
    return Answer(np.arctan2(np.sin(error), np.cos(error)), result.phase_sigma, warned)


def _light_recording(source: ArrayRecording, **options: Any) -> Result:
    return engine.run(source, engine.optical.PhotometricStereo(**options))


def _photometric(fault: Fault, seed: int, compute: Callable[..., Result] = _light_recording) -> Answer:
    truth, azimuth = _normals(_waves, *centres(SHAPE, PIXEL)), np.arange(12) * np.pi / 6
    frames = record(_lit, azimuth, fault, seed)
    source = _opened(frames, {"phase": azimuth}, {"dark": np.float32(DARK * fault.scale)}, fault)
    result, warned = _watched(lambda: compute(source, zenith=ZENITH, shadow=6 * fault.scale))
    return Answer(_angle(result.normals, truth), result.normals_sigma, warned)


def _moved(fault: Fault, seed: int) -> Answer:
    reference, frame = record(_speckle, np.arange(2.0), fault, seed)
    result, warned = _watched(
        lambda: engine.slip.find_displacement(reference, frame[np.newaxis], PIXEL, window_size=12)
    )
    return Answer(result.displacement[0, ..., 0] - SHIFT, result.displacement_sigma[0, ..., 0], warned)


def _focus_recording(source: ArrayRecording, noise: float) -> Result:
    return engine.run(source, engine.optical.Focus(noise=noise))


def _by_focus(
    fault: Fault, seed: int, compute: Callable[[ArrayRecording, float], Result] = _focus_recording
) -> Answer:
    travel = np.arange(0.2, 1.0, 0.05)
    frames = record(_focused, travel, fault, seed)
    source = _opened(frames, {"travel": travel}, {}, fault)
    noise = math.hypot(READ_NOISE, 0.8) * fault.scale
    result, warned = _watched(lambda: compute(source, noise))
    return Answer(result.height - _waves(*centres(SHAPE, PIXEL))[0], result.height_sigma, warned)


def _watched(compute: Callable[[], Result]) -> tuple[Result, bool]:
    """Return a result, and whether it has a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MirrorskinWarning)
        result = compute()
    warned = any(issubclass(warning.category, MirrorskinWarning) for warning in caught)
    return result, warned or "warnings" in result.process


def _of_slopes(*, weights: bool = False, robust: bool = False) -> Callable[[Any, int], Answer]:
    return lambda fault, seed: Answer(*integrated(fault, seed, weights=weights, robust=robust), warned=False)


ESTIMATORS: Mapping[str, Callable[[Any, int], Answer]] = {
    "threshold, steps of 20 µm": _onset(_waves, 0.02),
    "threshold, steps of 100 µm": _onset(_waves, 0.1),
    "threshold, rim of a crater": _onset(_crater, 0.02),
    "change-point, steps of 20 µm": _onset(_waves, 0.02, _change_point),
    "change-point, steps of 50 µm": _onset(_waves, 0.05, _change_point),
    "normals of a rotation": _rotation,
    "heights of a rotation": _integrated,
    "press and rotation, fused": _fused,
    "fringes": _of_fringes,
    "photometric stereo": _photometric,
    "displacement": _moved,
    "focus": _by_focus,
    "integrate": _of_slopes(),
    "integrate with weights": _of_slopes(weights=True),
    "integrate robustly": _of_slopes(robust=True),
}


# --- The same by functions on arrays -------------------------------------------------------------------


def _frames(source: ArrayRecording) -> NDArray[Any]:
    source.rewind()
    block = source.read_in_place(source.shape[0])
    assert block is not None
    return block.frames


def _phase(source: ArrayRecording) -> NDArray[np.float64]:
    assert source.phase is not None
    return source.phase


def _levels(source: ArrayRecording) -> dict[str, Any]:
    return {"travel": source.travel, "dark": source.header.dark, "bright": source.header.bright}


def _find_onset(source: ArrayRecording) -> Result:
    return engine.find_onset(_frames(source), **_levels(source))


def _find_change_point(source: ArrayRecording) -> Result:
    return engine.find_change_point(_frames(source), **_levels(source))


def _estimate_normals(fault: Fault, seed: int) -> Result:
    source = _turn(_waves, fault, seed)
    return engine.estimate_normals(_frames(source), _phase(source), tilt=TILT, **_scale(fault))


def _integrate_normals(fault: Fault, seed: int) -> Result:
    return engine.integrate(_estimate_normals(fault, seed), pixel_size=PIXEL)


def _fuse_maps(fault: Fault, seed: int) -> Result:
    heights = _find_onset(_press(_waves, 0.05, fault, seed))
    return engine.fuse(heights, _estimate_normals(fault, seed + 2), PIXEL)


def _fit_array(source: ArrayRecording) -> Result:
    return engine.optical.fit_fringes(_frames(source), _phase(source))


def _light_array(source: ArrayRecording, **options: Any) -> Result:
    dark = source.header.dark
    return engine.optical.photometric_stereo(_frames(source), _phase(source), dark=dark, **options)


def _focus_array(source: ArrayRecording, noise: float) -> Result:
    return engine.optical.find_focus(_frames(source), _levels(source)["travel"], noise=noise)


def _turn_by(compute: Callable[[Fault, int], Result]) -> Turn:
    return lambda fault, seed: _watched(lambda: compute(fault, seed))


FUNCTIONS: Mapping[str, Callable[[Any, int], Answer]] = {
    "threshold, steps of 20 µm": _onset(_waves, 0.02, _find_onset),
    "threshold, steps of 100 µm": _onset(_waves, 0.1, _find_onset),
    "threshold, rim of a crater": _onset(_crater, 0.02, _find_onset),
    "change-point, steps of 20 µm": _onset(_waves, 0.02, _find_change_point),
    "change-point, steps of 50 µm": _onset(_waves, 0.05, _find_change_point),
    "normals of a rotation": functools.partial(_rotation, compute=_turn_by(_estimate_normals)),
    "heights of a rotation": functools.partial(_integrated, compute=_turn_by(_integrate_normals)),
    "press and rotation, fused": functools.partial(_fused, compute=_fuse_maps),
    "fringes": functools.partial(_of_fringes, compute=_fit_array),
    "photometric stereo": functools.partial(_photometric, compute=_light_array),
    "focus": functools.partial(_by_focus, compute=_focus_array),
}
"""The estimators that have a function on arrays, which is not what they call above."""


PRESS = [name for name in ESTIMATORS if name.startswith(("threshold", "change-point"))]
SLOPES = [name for name in ESTIMATORS if name.startswith("integrate")]
OTHERS = [name for name in ESTIMATORS if name not in PRESS + SLOPES]


# --- Cells ---------------------------------------------------------------------------------------------


def applies(estimator: str, fault: Fault) -> bool:
    """Return whether a fault can occur; projectors and lamps do not move while a frame is exposed."""
    if fault.stated:
        return estimator in PRESS
    if estimator == "displacement":  # it answers for each frame alone
        return not (fault.jitter or fault.dropped or fault.duplicated or fault.shutter)
    return not (fault.shutter and estimator in ("fringes", "photometric stereo"))


def faults_of(estimator: str) -> tuple[Any, ...]:
    """Return the faults of the frames, or of the slopes, that an estimator gets."""
    if estimator in SLOPES:
        return SLOPE_FAULTS
    return tuple(fault for fault in FAULTS if applies(estimator, fault))


def faults_of_arrays(estimator: str) -> tuple[Fault, ...]:
    """Return the faults of frames in an array, with which nobody states anything, not even a compression."""
    return tuple(fault for fault in faults_of(estimator) if not (fault.stated or fault.codec))


def row(estimator: str, part_of_name: str = "", seed: int = 1) -> dict[str, Cell]:
    """Return the cells of an estimator by the name of the fault."""
    return _row(ESTIMATORS[estimator], faults_of(estimator), part_of_name, seed)


def row_of_arrays(estimator: str, part_of_name: str = "", seed: int = 1) -> dict[str, Cell]:
    """Return the cells of a function on arrays by the name of the fault."""
    return _row(FUNCTIONS[estimator], faults_of_arrays(estimator), part_of_name, seed)


def _row(
    answer: Callable[[Any, int], Answer], faults: tuple[Any, ...], part_of_name: str, seed: int
) -> dict[str, Cell]:
    usual = _rms(_inside(answer(faults[0], seed).error))
    return {fault.name: _cell(answer(fault, seed), usual) for fault in faults if part_of_name in fault.name}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def _inside(values: Floats) -> Floats:
    """Return what is not near the border, which has no light from outside of the picture."""
    return np.asarray(values, np.float64)[3:-3, 3:-3]


def _cell(answer: Answer, usual: float) -> Cell:
    error, sigma = _inside(answer.error), _inside(answer.sigma)
    usable = np.isfinite(error) & np.isfinite(sigma)
    if not usable.any():
        return Cell(math.nan, math.nan, 0.0, 0.0, answer.warned)
    ratio = np.abs(error[usable]) / sigma[usable]
    return Cell(
        error=_rms(error[usable]) / usual,
        chi2=float(np.mean(ratio**2)),
        beyond=float(np.mean(ratio > 3)),
        kept=float(np.mean(usable)),
        warned=answer.warned,
    )


# --- What is stored ------------------------------------------------------------------------------------


def open_cells() -> dict[str, list[str]]:
    """Return the faults of each estimator because of which its standard deviation is wrong without a word."""
    return {name: faults for name, faults in _stored()["open"].items() if name in ESTIMATORS}


def _stored() -> dict[str, Any]:
    return (
        dict(json.loads(_STORED.read_text(encoding="utf-8")))
        if _STORED.exists()
        else {"open": {}, "cells": {}, "functions": {}}
    )


def freeze(table: Mapping[str, Mapping[str, Cell]], arrays: Mapping[str, Mapping[str, Cell]]) -> None:
    """Store cells, and write the page; SystemExit if a standard deviation became wrong.

    ``arrays`` are the cells of functions on arrays.

    ``first`` keeps the chi^2 with which a cell was first stored.
    """
    stored = _stored()
    before, opened_before, worse = stored["cells"], stored["open"], []
    for name, cells in table.items():
        opened = [fault for fault, cell in cells.items() if not cell.honest]
        worse += [
            f"{name}: {fault}"
            for fault in opened
            if name in opened_before and fault not in opened_before[name] and fault in before[name]
        ]
        opened_before[name] = opened
        before[name] = {
            fault: _rounded(cell)
            | {"first": before.get(name, {}).get(fault, {}).get("first", _number(cell.chi2))}
            for fault, cell in cells.items()
        }
    if worse:
        raise SystemExit("not stored, as these became wrong:\n" + "\n".join(worse))
    functions = stored["functions"] | {
        name: {fault: _rounded(cell) | {"open": not cell.honest} for fault, cell in cells.items()}
        for name, cells in arrays.items()
    }
    content = {"open": opened_before, "cells": before, "functions": functions}
    _STORED.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_tables(text), encoding="utf-8")


def _rounded(cell: Cell) -> dict[str, float | bool | None]:
    return {
        name: value if value is True or value is False else _number(value)
        for name, value in asdict(cell).items()
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(f"{value:.3g}")


def with_tables(page: str) -> str:
    """Return the text of the page with the stored cells in its tables."""
    cells, opened = _stored()["cells"], open_cells()
    parts: tuple[tuple[list[str], tuple[Any, ...]], ...] = (
        (PRESS, FAULTS),
        (OTHERS, FAULTS),
        (SLOPES, SLOPE_FAULTS),
    )
    for number, (names, faults) in enumerate(parts):
        rows = [
            [fault.name, *(_shown(cells, opened, name, fault.name) for name in names)] for fault in faults
        ]
        page = replace_part(page, f"cells {number}", _table(["fault", *names], rows))
    return replace_part(page, "cells of functions", _about_functions())


def _table(head: list[str], rows: list[list[str]]) -> str:
    return Table("", tuple(head), [tuple(row) for row in rows]).as_markdown()


def as_summary() -> str:
    """Return the number of cells, and of those whose standard deviation is too small without a warning."""
    cells, opened = _stored()["cells"], open_cells()
    count, wrong = (sum(map(len, part.values())) for part in (cells, opened))
    return (
        f"Of {count} combinations of a fault and an estimator, {wrong} have a standard deviation that is\n"
        "too small, without a warning.\n"
    )


def _about_functions() -> str:
    """Return the numbers of wrong cells of functions on arrays, and a table of those right in recordings."""
    cells, opened = _stored()["functions"], open_cells()
    wrong = {(name, fault) for name in cells for fault, cell in cells[name].items() if cell["open"]}
    also = {(name, fault) for name in cells for fault in opened[name] if fault in cells[name]}
    text = (
        f"Of {sum(map(len, cells.values()))} cells, {len(wrong)} are bold for functions on arrays,"
        f" {len(also)} for recordings.\n"
    )
    only = wrong - also
    if not only:
        return text
    names = [name for name in cells if any(name == other for other, _ in only)]
    faults = [fault.name for fault in FAULTS if any(fault.name == other for _, other in only)]
    rows = [
        [fault, *(_digits(cells[name][fault]["chi2"]) if (name, fault) in only else "" for name in names)]
        for fault in faults
    ]
    bold = "The table contains the cells that are bold for the function on arrays only.\n"
    return text + bold + "\n" + _table(["$\\chi^2$", *names], rows)


def _shown(cells: Mapping[str, Any], opened: Mapping[str, list[str]], estimator: str, fault: str) -> str:
    """Return error and chi^2 of a cell, bold if the standard deviation is wrong."""
    cell = cells[estimator].get(fault)
    if cell is None:
        return ""
    if cell["chi2"] is None:
        return "no answer"
    text = f"{_digits(cell['error'])}; {_digits(cell['chi2'])}"
    if cell["first"] is not None and not 0.5 < cell["chi2"] / cell["first"] < 2:
        text += f" (was {_digits(cell['first'])})"
    if fault in opened[estimator]:
        return f"**{text}**"
    return f"{text}, warned" if cell["warned"] else text


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}" if value < 1 or value >= 10 else f"{value:.1f}"


def main() -> None:
    """Print the cells of some estimators, or store them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("estimator", nargs="*", help="parts of the names of estimators")
    parser.add_argument("--fault", default="", help="part of the name of a fault")
    parser.add_argument("--freeze", action="store_true", help="store all cells of these, and write the page")
    asked = parser.parse_args()
    names = [
        name for name in ESTIMATORS if not asked.estimator or any(part in name for part in asked.estimator)
    ]
    table, arrays = {}, {}
    fault = "" if asked.freeze else asked.fault
    for name in names:
        table[name] = row(name, fault)
        _print(name, table[name])
        if name in FUNCTIONS:
            arrays[name] = row_of_arrays(name, fault)
            _print(f"{name}, function on arrays", arrays[name])
    if asked.freeze:
        freeze(table, arrays)


def _print(name: str, cells: Mapping[str, Cell]) -> None:
    print(name)
    for fault, cell in cells.items():
        print(f"  {fault:18} {cell}")


if __name__ == "__main__":
    main()
