"""Calibrations from touches by a camera with a fault; they share nothing with the twin."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mirrorskin.engine.calibration.touches import TouchFit, from_touches
from mirrorskin.evaluation.faults.camera import (
    DARK,
    FAULTS,
    POINTS,
    SPAN,
    Fault,
    Floats,
    Light,
    points,
    record,
    references,
)
from mirrorskin.evaluation.faults.estimators import PIXEL, TILT, Surface, leaning, touched, zenith_scale
from mirrorskin.evaluation.faults.judge import Answer
from mirrorskin.io import InputError, MirrorskinWarning
from mirrorskin.io.files.arrays import ArrayRecording

SHAPE = 48, 64  # pixels
_TRAVEL = 0.1, 1.2  # mm
_STEP = 0.04  # mm: of a press
_FRAMES = 12  # of a turn
_WAVELENGTH, _STEEPNESS = (0.8, 2.0), 0.25  # mm, from and to; RMS of the slopes in each direction
_FITS, _TOUCHES = 3, 2  # fits of a cell, and touches of each
_SLIP = PIXEL  # mm along x, in the middle of the turn
_SPECKS, _SPECK, _OPAQUE = 12, 3 * POINTS, 0.5  # specks of dust; points of a side; share of the light
_NEEDED = {
    "zenith_gain": 0.01,
    "zenith_offset": 0.5,
    "gamma": 0.02,
    "tilt": 0.01,
    "phase_offset": math.radians(0.3),
}
"""Standard error of a parameter that counts as determined; of gain and half-angle, as a share."""


NO_FAULT = Fault("none")


@dataclass(frozen=True)
class CalibrationFault:
    """What goes wrong in the touches of a calibration.

    Attributes
    ----------
    name : str
    camera : Fault
    thing : {"rough", "plate", "edge"}
        What is touched.
    slips : bool
        Whether the object slips by a pixel in the middle of each turn.
    dust : bool
        Whether dust on the lens takes half of the light of some points.
    stated : float, optional
        The half-angle that is stated with a standard deviation of 2 %, over the true one.
    has_presses : bool
        Whether each turn has a press.
    """

    name: str
    camera: Fault = NO_FAULT
    thing: str = "rough"
    slips: bool = False
    dust: bool = False
    stated: float | None = None
    has_presses: bool = True


CALIBRATION_FAULTS = (
    *(
        CalibrationFault(fault.name, fault)
        for fault in FAULTS
        if not (fault.stated or fault.shutter or fault.codec == "mpeg")
    ),
    CalibrationFault("half-angle stated 20 % too small", stated=0.8),
    CalibrationFault("turns alone", has_presses=False),
    CalibrationFault("turns alone, half-angle stated 20 % too small", stated=0.8, has_presses=False),
    CalibrationFault("slip of a pixel in the turn", slips=True),
    CalibrationFault("a plate only", thing="plate"),
    CalibrationFault("an edge only", thing="edge"),
    CalibrationFault("dust", dust=True),
)


@functools.cache
def _surface(thing: str, seed: int, shift: float = 0.0) -> Surface:
    """Return a surface, shifted along x by a distance, mm."""
    generator = np.random.default_rng([seed, 5])
    number = 2 * np.pi / generator.uniform(*_WAVELENGTH, 14)
    azimuth, phase = generator.uniform(0, 2 * np.pi, (2, 14))
    size = _STEEPNESS * math.sqrt(2 / 14) / number
    waves = list(zip(number * np.cos(azimuth), number * np.sin(azimuth), phase, size, strict=True))

    def heights(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        x, y = np.broadcast_arrays(x - shift, y)
        height, along_x, along_y = 0.3 * x - 0.6, np.full(x.shape, 0.3), np.zeros(x.shape)
        if thing == "edge":
            along_x = np.where(x > 0, -0.3, 0.3)
            height = -0.3 * np.abs(x) - 0.4
        if thing == "rough":
            for kx, ky, at, amplitude in waves:
                wave, slope = (amplitude * turned(kx * x + ky * y + at) for turned in (np.sin, np.cos))
                height, along_x, along_y = height + wave, along_x + kx * slope, along_y + ky * slope
        return height, along_x, along_y

    return Surface.from_function(f"{thing} {seed} {shift}", heights, SHAPE, _TRAVEL)


def _dusty(light: Light) -> Light:
    """Return light through specks of dust, which are at the same places in all frames."""
    generator = np.random.default_rng(8)
    x, y = points(SHAPE, PIXEL)
    share = np.ones((y.size, x.size))
    for row, column in generator.integers(0, (y.size - _SPECK, x.size - _SPECK), (_SPECKS, 2)):
        share[row : row + _SPECK, column : column + _SPECK] = _OPAQUE
    return lambda position: light(position) * share


def _touch(fault: CalibrationFault, seed: int) -> tuple[ArrayRecording, ArrayRecording]:
    """Return the press and the turn of a touch."""
    camera, surface = fault.camera.drawn(seed), _surface(fault.thing, seed)
    travel, phase = np.arange(*_TRAVEL, _STEP), 2 * np.pi * np.arange(_FRAMES) / _FRAMES
    press, before = touched(surface), leaning(surface, camera.tilt * TILT)
    after = leaning(_surface(fault.thing, seed, _SLIP if fault.slips else 0.0), camera.tilt * TILT)

    def turn(at: Floats) -> Floats:
        return after(at) if at.ravel()[0] >= math.pi else before(at)

    lights: tuple[Light, Light] = (press, turn)
    if fault.dust:
        lights = _dusty(press), _dusty(turn)
    frames = [
        record(light, at, camera, 10 * seed + k)
        for k, (light, at) in enumerate(zip(lights, (travel, phase), strict=True))
    ]
    dark, bright = references(SHAPE, camera, 10 * seed + 2)
    header = {"pixel_size": (PIXEL, PIXEL), "dark": dark.astype("f4"), "bright": bright.astype("f4")}
    return (
        ArrayRecording(frames[0], {"travel": travel}, header, name=f"press {seed}"),
        ArrayRecording(frames[1], {"phase": phase}, {**header, "tilt": TILT}, name=f"turn {seed}"),
    )


def _mean_light(fault: CalibrationFault, seed: int) -> float:
    """Return the mean light of a turn."""
    return float(leaning(_surface(fault.thing, seed))(np.zeros(1)).mean())


def _truth(camera: Fault, light: float) -> Mapping[str, float]:
    """Return the true parameters; stray light is a share of the mean light."""
    scale, share = zenith_scale(camera), (1 - camera.vignetting / 3) * (1 - camera.stray)
    stray = camera.stray * light * camera.exposure * SPAN
    return {
        "zenith_gain": scale["zenith_gain"] * share,  # of vignetting, the mean of the picture
        "zenith_offset": camera.scale * (DARK + camera.drift / 2 + stray),
        "gamma": camera.gamma,
        "tilt": camera.tilt * TILT,
        "phase_offset": 0.0,
    }


def of_calibration(fault: CalibrationFault, seed: int) -> Answer:
    """Return the errors of the parameters of a few calibrations, in what counts as determined."""
    start = zenith_scale(replace(fault.camera, exposure=1.0))
    stated = {} if fault.stated is None else {"tilt": (fault.stated * TILT, 0.02 * TILT)}

    def seeds(number: int) -> range:
        first = 100 * seed + _TOUCHES * number
        return range(first, first + _TOUCHES)

    def fit(number: int) -> TouchFit:
        touches = [_touch(fault, each) for each in seeds(number)]
        pairs = [(press if fault.has_presses else None, turn) for press, turn in touches]
        return from_touches(pairs, stated=stated, **start)

    def compared(number: int, found: TouchFit) -> tuple[Floats, Floats]:
        light = np.mean([_mean_light(fault, each) for each in seeds(number)])
        return _compared(found, _truth(fault.camera, float(light)), fault.camera.scale)

    return answer_of_fits(_FITS, fit, compared)


def answer_of_fits(
    count: int,
    fit: Callable[[int], TouchFit],
    compared: Callable[[int, TouchFit], tuple[Floats, Floats]],
) -> Answer:
    """Return errors and standard errors of all calibrations that are not refused, and what all of them say.

    ``fit`` makes one by its number, and ``compared`` compares it with the truth.
    """
    parts, told = list[tuple[Floats, Floats]](), list[str]()
    for number in range(count):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", MirrorskinWarning)
            try:
                found = fit(number)
            except InputError as refused:
                told.append(str(refused))
                continue
            finally:
                told += [str(warning.message) for warning in caught]
        parts.append(compared(number, found))
        told += [note for note in found.notes if not note.startswith("not determined")]
    if not parts:
        return Answer(np.array([math.nan]), np.array([math.nan]), "; ".join(told))
    errors, sigmas = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Answer(errors, sigmas, "; ".join(told))


def _compared(fit: TouchFit, truth: Mapping[str, float], count: float) -> tuple[Floats, Floats]:
    """Return errors and standard errors of parameters, in what counts as determined."""
    named = {estimate.name: estimate for estimate in fit.estimates}
    units = {
        name: needed * (truth[name] if name in ("zenith_gain", "tilt") else 1.0)
        for name, needed in _NEEDED.items()
    }
    units["zenith_offset"] *= count
    parts = [(named[name].value - truth[name], named[name].sigma) for name in units]
    error, sigma = np.array(parts).T / np.array(list(units.values()))
    return error, sigma
