"""Priors of the numbers of a sensor, and the movement that touches are read with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mirrorskin.engine.calibration.touches.light import FOOTPRINT
from mirrorskin.engine.calibration.touches.reading import (
    Touch,
    TouchReader,
)
from mirrorskin.engine.calibration.touches.sensor import SensorModel, Wall
from mirrorskin.engine.calibration.touches.wall_light import WallLight, even_steps, roughness
from mirrorskin.engine.calibration.touches.window import TURNS
from mirrorskin.engine.calibration.wall import BODY_ERROR, LIKELY
from mirrorskin.engine.calibration.wall_model import STEP_NAMES
from mirrorskin.engine.diagnosis.turn_light import (
    GLOBALS,
)
from mirrorskin.io import (
    Gel,
    Header,
    InputError,
    Precession,
)
from mirrorskin.kernels.array_types import Doubles

NEGLIGIBLE = 1e-6  # standard deviation of a parameter that is not estimated
UNKNOWN = {
    "gamma": 0.2,
    "zenith_gain": 0.1,
    "zenith_offset": 10.0,
    "tilt": 0.15,
    "phase": 0.3,
    "uneven": 0.05,
    "oval": 0.03,
    "footprint": 2.0,
    "pivot_z": 10.0,
    "compliance": 0.1,
}  # standard deviations of parameters about which nothing is stated; counts of 8 bits, radians, mm, 1/mm
_STEP = 1.0  # share of full light: standard deviation of a step of the printed curve
_LOOSER = 10.0  # of the standard deviation of a number that is estimated only if it is stated
_KNOWN_PIVOT = 1.0  # mm: standard deviation of a recorded pivot
_WITHOUT = 1e4  # factor of the standard deviation of a parameter of which nothing is known
_SEARCHED = 8  # phases that are tried if frames do not follow the movement
_OTHER_PHASE = 0.2  # radians: difference of phases from which one was searched for
TITLES = {"phase": "phase_offset"}
UNITS = {
    "zenith_gain": "counts/rad",
    "zenith_offset": "counts",
    "tilt": "rad",
    "phase": "rad",
    "pivot_z": "mm",
    "pixel_size": "mm",
    "compliance": "1/mm",
    **dict.fromkeys(("radius", "rim", "axis_x", "axis_y"), "mm"),
    "scatter": "rad",
    "sight_0": "1/mm",
    "sight_2": "1/mm^3",
}
_NOT_STATED = ("lag", "footprint", "oval_x", "oval_y", *STEP_NAMES)


class Stated(NamedTuple):
    """A number that is stated of the sensor, such as in a data sheet, and its standard deviation."""

    value: float
    sigma: float


class Movement(NamedTuple):
    """The sensor and its movement as they are assumed in a fit: phases of files times sense plus ahead."""

    sensor: SensorModel
    before: Precession | None  # applied to the phases already
    sense: int
    ahead: float

    @classmethod
    def of(cls, sensor: SensorModel, precession: Precession | None) -> Movement:
        """Return the movement that a recording and a calibration state."""
        return cls(sensor, precession, 1, 0.0)

    @property
    def direction(self) -> int:
        """Sense of rotation."""
        return self.sense * (1 if self.before is None else self.before.direction)

    @property
    def phase_offset(self) -> float:
        """Azimuth of the lean at phase zero, radians."""
        offset = 0.0 if self.before is None else self.before.phase_offset
        return self.sense * offset + self.ahead

    def read(self, reader: TouchReader) -> Touch:
        """Read a touch with this movement."""
        return reader.read(self.sensor, self.sense, self.ahead)

    def changed(self, values: Mapping[str, float]) -> Movement:
        """Return the movement with estimated tilt, phase and pivot, and lines of sight."""
        sensor = self.sensor
        pivot = sensor.pivot
        if pivot is not None:
            pivot = (pivot[0], pivot[1], pivot[2] + values["pivot_z"])
        wall = sensor.wall
        if wall is not None:
            axis, sight = (values["axis_x"], values["axis_y"]), (values["sight_0"], values["sight_2"])
            wall = wall._replace(axis=axis, sight=sight)
        sensor = sensor._replace(tilt=sensor.tilt * (1 + values["tilt"]), pivot=pivot, wall=wall)
        return self._replace(sensor=sensor, ahead=math.remainder(self.ahead + values["phase"], math.tau))


def search(reader: TouchReader, movement: Movement) -> Movement:
    """Return the movement whose sense and phase zero give slopes that fit a surface best.

    Without a press a surface that is upside down fits as well, with half a turn of the phase: phases of files
    are then right within a quarter of a turn.
    """
    circle = math.tau if reader.has_press else math.pi
    best = math.inf, movement
    for sense in (1, -1):
        for ahead in np.linspace(-math.pi, math.pi, _SEARCHED, endpoint=False):
            tried = movement._replace(sense=sense, ahead=float(ahead))
            touch = tried.read(reader)
            turn = int(np.argmin(touch.misfits[0]))
            if touch.pixels:
                found = tried._replace(ahead=math.remainder(float(ahead + TURNS[turn]), circle))
                best = min(
                    best, (float(touch.misfits[0, turn]) / touch.pixels**2, found), key=lambda each: each[0]
                )
    return best[1]


@dataclass(frozen=True, slots=True)
class Priors:
    """Priors of the numbers of a sensor, and how they follow from the parameters of a fit."""

    names: tuple[str, ...]  # of the parameters
    number: Doubles
    error: Doubles
    loose: Doubles  # error of a number about which nothing is stated
    stated: tuple[bool, ...]
    kept: tuple[bool, ...]  # whether what is stated stays with what touches tell, when others are added
    reference: Doubles  # number at a parameter of 0
    scale: Doubles  # change of the number by the parameter

    @classmethod
    def of(
        cls,
        header: Header,
        movement: Movement,
        of_touches: bool,
        given: Mapping[str, Stated | tuple[float, float]],
        has_press: bool,
        gel: Gel | None,
    ) -> Priors:
        """Return the priors from a recording with its calibration, and from numbers that are given."""
        sensor = movement.sensor
        names = sensor.names
        size = min(header.pixel_size or (1.0,))
        numbers = {"footprint": (FOOTPRINT, FOOTPRINT), "pixel_size": (size, -size)}
        likely: dict[str, tuple[float, float]] = {}
        if sensor.wall is not None:
            likely = _of_wall(sensor.wall)
        else:
            gain, base = float(np.nanmedian(sensor.gain)), float(np.nanmedian(sensor.base))
            numbers |= {"gamma": (1.0, 1.0), "zenith_gain": (gain, gain), "zenith_offset": (base, 1.0)}
        reference, scale, number = np.zeros(len(names)), np.ones(len(names)), np.zeros(len(names))
        error = np.full(len(names), NEGLIGIBLE)
        for at, name in enumerate(names):
            reference[at], scale[at] = numbers.get(name, (0.0, 1.0))
            error[at] = UNKNOWN.get(name, UNKNOWN.get(name.partition("_")[0], NEGLIGIBLE))
            number[at], error[at] = likely.get(name, (reference[at], error[at]))
        scale[names.index("tilt")] = sensor.tilt
        error[names.index("lag")] = header.prior("lag_sigma")
        if "gamma" in names:
            number[names.index("gamma")] = header.prior("gamma")
            error[names.index("zenith_offset")] *= max(1.0, abs(gain) / 1000)  # a count of 8 bits
        if gel is None:
            error[names.index("compliance")] = NEGLIGIBLE
        else:
            number[names.index("compliance")] = gel.compliance
        if header.pivot is not None:
            error[names.index("pivot_z")] = _KNOWN_PIVOT
        if sensor.pivot is None:
            error[names.index("pivot_z")] = NEGLIGIBLE
        error *= np.abs(scale)
        free = (False,) * len(names)
        priors = cls(names, number, error.copy(), error, free, free, reference, scale).relative_to(movement)
        for name in ("tilt", "phase", "pivot_z"):
            priors.number[priors.at(name)] = priors.reference[priors.at(name)]
        stated: dict[str, Stated] = {}
        if not of_touches:  # what touches have found is no prior of more touches, but their memory
            stated |= _stated_by(header, movement.before, gel, priors)
        more = _given(given, sensor, has_press, gel)
        kept = tuple(name in stated and name not in more for name in names)
        return replace(priors.stating(stated | more), kept=kept)

    def at(self, name: str) -> int:
        """Return the number of a parameter."""
        return self.names.index(name)

    @property
    def mean(self) -> Doubles:
        """Means of the parameters."""
        return np.asarray((self.number - self.reference) / self.scale)

    @property
    def sigma(self) -> Doubles:
        """Standard deviations of the parameters."""
        return np.asarray(np.maximum(np.abs(self.error / self.scale), NEGLIGIBLE / 10))

    def precision(self, without: int | None = None) -> Doubles:
        """Return the inverse of the parameters' covariance, if nothing is known of one of them or not.

        A printed curve differs smoothly from a straight line.
        """
        sigma = self.sigma
        if without is not None:
            sigma[without] *= _WITHOUT
        precision = np.diag(sigma**-2.0)
        if STEP_NAMES[0] in self.names:
            first = self.at(STEP_NAMES[0])
            steps = slice(first, first + len(STEP_NAMES))
            precision[steps, steps] += roughness()
        return precision

    def number_of(self, name: str, value: float) -> float:
        """Return the number of the sensor for the value of a parameter."""
        at = self.at(name)
        return float(self.reference[at] + self.scale[at] * value)

    def is_free(self, at: int) -> bool:
        """Return whether a parameter is estimated."""
        return bool(self.loose[at] > 2 * NEGLIGIBLE * abs(self.scale[at]))

    def relative_to(self, movement: Movement) -> Priors:
        """Return the same priors for parameters that are relative to a movement."""
        reference, scale, number = self.reference.copy(), self.scale.copy(), self.number.copy()
        reference[self.at("tilt")] = scale[self.at("tilt")] = movement.sensor.tilt
        at = self.at("phase")
        reference[at] = movement.phase_offset
        if abs(math.remainder(reference[at] - number[at], math.tau)) > _OTHER_PHASE and not self.stated[at]:
            number[at] = reference[at]  # it was searched for
        number[at] = reference[at] + math.remainder(number[at] - reference[at], math.tau)
        if movement.sensor.pivot is not None:
            reference[self.at("pivot_z")] = movement.sensor.pivot[2]
        return replace(self, reference=reference, scale=scale, number=number)

    def stating(self, numbers: Mapping[str, Stated]) -> Priors:
        """Return the priors with numbers of the sensor that are stated."""
        number, error, loose = self.number.copy(), self.error.copy(), self.loose.copy()
        is_stated = list(self.stated)
        for name, (value, sigma) in numbers.items():
            if not (math.isfinite(value) and 0 < sigma < math.inf):
                raise InputError(f"{name} {value} ± {sigma}: give a number and a standard deviation above 0")
            at = self.at(name)
            if not self.is_free(at):
                loose[at] = _LOOSER * sigma
            number[at], error[at], is_stated[at] = value, sigma, True
        return replace(self, number=number, error=error, loose=loose, stated=tuple(is_stated))

    def start(self, before: Mapping[str, float] | None, precession: Precession | None) -> Doubles:
        """Return parameters to start with, from those of earlier touches or those of a precession."""
        known = ("gamma", "compliance", *WallLight.names)
        start = np.where([name in known for name in self.names], self.mean, 0.0)
        if before is not None:
            start = np.array([before.get(name, value) for name, value in zip(self.names, start, strict=True)])
        elif precession is not None:
            turned = 2 * precession.major_axis
            for name, part in (("oval_x", math.cos(turned)), ("oval_y", math.sin(turned))):
                start[self.at(name)] = precession.ellipticity * part
        return start

    def without(self, at: int) -> Priors:
        """Return the priors without what is stated of a parameter."""
        error, is_stated = self.error.copy(), list(self.stated)
        error[at], is_stated[at] = self.loose[at], False
        return replace(self, error=error, stated=tuple(is_stated))


def _given(
    numbers: Mapping[str, Stated | tuple[float, float]],
    sensor: SensorModel,
    has_press: bool,
    gel: Gel | None,
) -> dict[str, Stated]:
    """Return given numbers by the names of parameters; InputError for one that touches do not depend on."""
    stated = {}
    offered = {
        TITLES.get(name, name): name
        for name in sensor.names
        if name not in _NOT_STATED and not name.startswith("uneven")
    }
    for name, value in numbers.items():
        if name not in offered:
            raise InputError(f"{name} cannot be stated: give one of {', '.join(offered)}")
        if name == "pivot_z" and sensor.pivot is None:
            raise InputError(
                "pivot_z cannot be stated: without the depth of the press, turns do not depend on it. Record"
                " the depth, as in --press 1.2mm, or leave it out"
            )
        if name == "pixel_size" and not has_press:
            raise InputError(
                "pixel_size cannot be stated: turns alone do not depend on it. Add a press before each turn,"
                " or leave it out"
            )
        if name == "compliance" and gel is None:
            raise InputError(
                "compliance cannot be stated: without a calibrated gel, the press is not corrected for it."
                " Calibrate elastic first, or leave it out"
            )
        stated[offered[name]] = Stated(*value)
    return stated


def _stated_by(
    header: Header, precession: Precession | None, gel: Gel | None, priors: Priors
) -> dict[str, Stated]:
    """Return the numbers that a recording and a calibration state with standard deviations."""
    stated = {}
    for name in set(GLOBALS) & set(priors.names):
        sigma = getattr(header, f"{name}_sigma")
        if sigma and name != "lag":
            size = abs(priors.scale[priors.at(name)])
            stated[name] = Stated(float(priors.number[priors.at(name)]), sigma * size)
    if precession is not None:
        numbers = {
            "tilt": precession.tilt,
            "phase": precession.phase_offset,
            "pivot_z": precession.pivot[2],
        }
        for name, value in numbers.items():
            sigma = precession.sigma.get(TITLES.get(name, name), 0.0)
            if sigma > 0 and math.isfinite(sigma) and math.isfinite(value):
                stated[name] = Stated(value, sigma)
    if gel is not None and gel.sigma.get("compliance", 0.0) > 0:
        stated["compliance"] = Stated(gel.compliance, gel.sigma["compliance"])
    return stated


def _of_wall(wall: Wall) -> dict[str, tuple[float, float]]:
    """Return likely numbers of a wall, and their standard deviations."""
    likely = LIKELY | {"scatter": (wall.scatter, NEGLIGIBLE)}
    for name, size in zip(("radius", "rim"), wall.body, strict=True):
        likely[name] = size, BODY_ERROR * size
    return likely | {name: (step, _STEP) for name, step in zip(STEP_NAMES, even_steps(), strict=True)}
