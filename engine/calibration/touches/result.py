"""The result of a calibration from touches: parts of a calibration, estimates and notes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mirrorskin.engine.calibration.touches.fit import Attempt, Dropped, Fitted, Response, without_prior
from mirrorskin.engine.calibration.touches.light import UNEVEN_TERMS
from mirrorskin.engine.calibration.touches.priors import (
    TITLES,
    UNITS,
    UNKNOWN,
    Priors,
)
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.calibration.touches.wall_result import wall_response
from mirrorskin.engine.calibration.wall_model import STEP_NAMES
from mirrorskin.engine.diagnosis.turn_light import uneven_terms
from mirrorskin.engine.diagnosis.turn_nuisances import (
    picture_axes,
)
from mirrorskin.io import (
    Gel,
    LinearResponse,
    Precession,
)
from mirrorskin.io.base.types import PROPERTIES
from mirrorskin.kernels.array_types import Doubles

_REMEDIES = {
    "gamma": "touch something whose slopes range from flat to steep, such as a ball",
    "zenith_gain": "press and turn on something rough",
    "zenith_offset": "press and turn on something rough",
    "tilt": "press and turn on something rough, or tilt more",
    "phase": "turn on something with slopes in all directions",
    "uneven": "touch at places all over the field",
    "oval": "press and turn on something rough, in more frames",
    "pivot_z": "press and turn on something with relief",
    "pixel_size": "calibrate the scale",
    "compliance": "calibrate elastic",
}
_OF_PRESSES = ("zenith_gain", "tilt", "pivot_z")
_ADD_PRESSES = "add a press of the same touch before each turn"
_REMEDIES |= dict.fromkeys(
    (name for name in WallLight.names if name not in STEP_NAMES),
    "touch at places all over the field, on slopes from flat to steep",
)
_REMEDIES["scatter"] = "calibrate zenith with a ball, as touches leave out the samples that show it"
_LEARNED = 0.5  # standard error of a number of a wall that is determined, times the usual deviation
_NEEDED = {
    "oval": 0.01,
    "pivot_z": 1.0,
    "pixel_size": 0.003,
    "compliance": 0.01,
}  # standard errors of a determined parameter

_DEGENERATE = 0.7  # correlation of the errors of two parameters that can hardly be told apart


class Estimate(NamedTuple):
    """An estimated parameter."""

    name: str
    value: float
    sigma: float  # with priors
    of_touches: float  # standard error without its own prior
    unit: str
    determined: bool


@dataclass(frozen=True, slots=True, eq=False)
class TouchFit:
    """A calibration from touches.

    Attributes
    ----------
    response : LinearResponse or WallResponse
    precession : Precession
    gel : Gel or None
        That of the calibration with the compliance that the presses show, if it is estimated. A gel that a
        modulus was learned with stays.
    estimates : tuple of Estimate
        All parameters, in the units of files.
    frame_gains : mapping of str to ndarray
        Gain of each frame relative to their mean, by the names of the turns.
    notes : tuple of str
        Sentences: what is not determined, and stated numbers that the touches contradict.
    """

    response: Response
    precession: Precession
    estimates: tuple[Estimate, ...]
    frame_gains: Mapping[str, Doubles]
    notes: tuple[str, ...]
    gel: Gel | None = None


def result_of(attempt: Attempt) -> TouchFit:
    """Return the parts of a calibration, and notes."""
    fit, priors, sensor, used = attempt.fit, attempt.priors, attempt.movement.sensor, attempt.used
    values, errors = attempt.values, np.sqrt(np.diag(fit.covariance))
    sigma = dict(zip(priors.names, errors.tolist(), strict=True))
    response = _linear_response(attempt, sigma) if sensor.wall is None else wall_response(attempt)
    estimates, notes = [], []
    for number, name in enumerate(priors.names):
        if not priors.is_free(number) or name in ("lag", "footprint", *STEP_NAMES):
            continue
        _, error = without_prior(fit, priors, number)
        needed = _needed(name, priors)
        determined = bool(error <= needed)
        unit = UNITS.get(name, "")
        size = abs(float(priors.scale[number]))
        estimates.append(
            Estimate(TITLES.get(name, name), priors.number_of(name, values[name]), sigma[name] * size,
                     error * size, unit, determined)
        )  # fmt: skip
    notes += _missing_references(attempt)
    notes += [_contradiction(each, priors, fit) for each in attempt.dropped]
    if fit.contradicts:
        notes.append(
            f"the touches contradict each other by {math.sqrt(fit.contradiction):.2g} times their errors,"
            " which the standard errors include: was a frame lost, did an object slip, is the travel exact,"
            " and is the lens in focus?"
        )
    pressed = any(window.is_pressed for touch in used for window in touch.windows)
    notes += _undetermined(estimates, pressed)
    notes += [f"{touch.name} is not used: {touch.reason}" for touch in attempt.read if touch not in used]
    for name in ("pixel_size", "compliance"):
        if pressed and priors.is_free(priors.at(name)) and "zenith_gain" in priors.names:
            at = priors.at(name), priors.at("zenith_gain")
            common = fit.covariance[at] / (errors[at[0]] * errors[at[1]])
            if abs(common) > _DEGENERATE:
                notes.append(
                    f"{name.replace('_', ' ')} and zenith gain are nearly degenerate: their errors have a"
                    f" correlation of {common:.2f}"
                )
    gains = {touch.name: 1 + np.split(touch.frame_values, 2)[0] for touch in used}
    precession = _precession(attempt, values, sigma)
    return TouchFit(response, precession, tuple(estimates), gains, tuple(notes))


def _missing_references(attempt: Attempt) -> list[str]:
    """Return the sentence about references that samples stand in for, if any are missing."""
    header, ends = attempt.readers[0].turn.header, {"dark": "darkest", "bright": "brightest"}
    missing = [name for name in ends if getattr(header, name) is None]
    if not missing:
        return []
    samples = " and ".join(ends[name] for name in missing)
    return [
        f"no {' and '.join(missing)} references: the {samples} 0.1 % of the samples stand in for them, and"
        " gain and offset contain their errors. Remedy: calibrate references"
    ]


def _linear_response(attempt: Attempt, sigma: Mapping[str, float]) -> LinearResponse:
    """Return the response that is linear in the zenith."""
    sensor, values = attempt.movement.sensor, attempt.values
    x, y = np.meshgrid(*picture_axes((sensor.gain.shape[0], sensor.gain.shape[1])))
    uneven = sum(values[name] * term for name, term in zip(UNEVEN_TERMS, uneven_terms(x, y), strict=True))
    gain = sensor.gain * (1 + values["zenith_gain"]) * (1 + uneven)
    usual = float(np.nanmedian(sensor.gain))
    more = values["zenith_offset"] * sensor.gain / usual
    offset = sensor.dark + (1 + uneven) * (sensor.base + more - sensor.dark)
    return LinearResponse(
        gain=gain.astype(np.float32),
        offset=offset.astype(np.float32),
        gamma=1 + values["gamma"],
        sigma={
            "gain": sigma["zenith_gain"] * abs(usual),
            "offset": sigma["zenith_offset"],
            "gamma": sigma["gamma"],
        },
        **attempt.remembered,
    )


def _needed(name: str, priors: Priors) -> float:
    """Return the standard error of a parameter that counts as determined: that of a usual sensor."""
    kind = name.partition("_")[0]
    if name in WallLight.names and name != "lag":
        return _LEARNED * float(priors.loose[priors.at(name)])
    if name in _NEEDED or kind in _NEEDED:
        return _NEEDED.get(name, _NEEDED.get(kind, 0.0))
    usual = PROPERTIES["uneven_light_sigma" if kind == "uneven" else f"{name}_sigma"].default
    assert usual is not None
    return float(usual) * (
        priors.loose[priors.at(name)] / UNKNOWN["zenith_offset"] if name == "zenith_offset" else 1.0
    )


def _contradiction(dropped: Dropped, priors: Priors, fit: Fitted) -> str:
    """Return the sentence about a stated number that the touches contradict."""
    name = priors.names[dropped.at]
    title, unit, factor = TITLES.get(name, name).replace("_", " "), UNITS.get(name, ""), 1.0
    if unit == "rad":
        unit, factor = "deg", math.degrees(1)
    value = priors.number_of(name, fit.values[dropped.at])
    error = math.sqrt(fit.covariance[dropped.at, dropped.at]) * abs(priors.scale[dropped.at])
    by_touches, by_statement = (
        f"{each * factor:.4g} ± {spread * factor:.2g} {unit}".rstrip()
        for each, spread in ((value, error), (dropped.number, dropped.error))
    )
    return f"{title}: the touches say {by_touches}, but {by_statement} is stated, which was not used"


def _undetermined(estimates: Sequence[Estimate], pressed: bool) -> list[str]:
    """Return sentences about parameters that the touches do not determine, those of one remedy together."""
    groups: dict[str, list[str]] = {}
    for estimate in estimates:
        if not estimate.determined:
            name = "phase" if estimate.name == "phase_offset" else estimate.name
            remedy = _REMEDIES.get(name, _REMEDIES.get(name.partition("_")[0], ""))
            if not pressed and name in _OF_PRESSES:
                remedy = _ADD_PRESSES
            groups.setdefault(remedy, []).append(_with_error(estimate))
    return [f"not determined: {', '.join(names)}. Remedy: {remedy}" for remedy, names in groups.items()]


def _with_error(estimate: Estimate) -> str:
    """Return the name of a parameter with the standard error that touches alone give it."""
    name, error = estimate.name.replace("_", " "), estimate.of_touches
    if estimate.name in ("zenith_gain", "tilt", "pixel_size"):
        return f"{name} (± {100 * error / abs(estimate.value):.2g} %)"
    if estimate.unit == "rad":
        return f"{name} (± {math.degrees(error):.2g} deg)"
    return f"{name} (± {error:.2g} {estimate.unit})".replace(" )", ")")


def _precession(attempt: Attempt, values: Mapping[str, float], sigma: Mapping[str, float]) -> Precession:
    """Return the movement of the body."""
    fit, priors, sensor = attempt.fit, attempt.priors, attempt.movement.sensor
    before = attempt.movement.before
    oval = np.array([values["oval_x"], values["oval_y"]])
    size = float(np.hypot(*oval))
    along = oval / size if size > 0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    at = [priors.at("oval_x"), priors.at("oval_y")]
    covariance = fit.covariance[np.ix_(at, at)]
    axis = math.sqrt(across @ covariance @ across) / (2 * size) if size > 0 else math.inf
    x, y, z = (math.nan,) * 3 if sensor.pivot is None else sensor.pivot
    errors = {
        "tilt": sigma["tilt"] * sensor.tilt,
        "phase_offset": sigma["phase"],
        "ellipticity": math.sqrt(along @ covariance @ along),
        "major_axis": min(axis, math.pi / math.sqrt(12)),
        "pivot_z": sigma["pivot_z"],
    }
    if before is not None:
        kept = ("pivot_x", "pivot_y", "centre_x", "centre_y")
        errors |= {name: before.sigma[name] for name in kept if name in before.sigma}
    return Precession(
        tilt=priors.number_of("tilt", values["tilt"]),
        phase_offset=math.remainder(priors.number_of("phase", values["phase"]), math.tau),
        direction=attempt.movement.direction,
        ellipticity=size,
        major_axis=math.atan2(oval[1], oval[0]) / 2,
        centre=(0.0, 0.0) if before is None else before.centre,
        pivot=(x, y, z + values["pivot_z"]),
        sigma=errors,
    )
