"""The response of a lit wall, from touches, and what it tells touches that are added to it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np

from mirrorskin.engine.calibration import wall_model as model
from mirrorskin.engine.calibration.touches.fit import Attempt
from mirrorskin.engine.calibration.touches.memory import Earlier
from mirrorskin.engine.calibration.touches.wall_light import WallLight
from mirrorskin.engine.calibration.wall_fit import WallFit
from mirrorskin.engine.calibration.wall_response import FEW, response_of, steps_of
from mirrorskin.io import WallResponse
from mirrorskin.kernels.array_types import Doubles

_OF_WALL = tuple(name for name in WallLight.names if name != "lag")
_NAMES = (*model.SENSOR, *model.STEP_NAMES)
_SHARES = np.linspace(0, 1, 1001)


def wall_response(attempt: Attempt) -> WallResponse:
    """Return the response for the pixels of the turns."""
    sensor, values, names = attempt.movement.sensor, attempt.values, attempt.priors.names
    assert sensor.pivot is not None
    x, y, z = sensor.pivot
    others = {
        "pivot_x": x,
        "pivot_y": y,
        "pivot_z": z + values["pivot_z"],
        "phase_offset": attempt.priors.number_of("phase", values["phase"]),
    }
    renamed = {"phase_offset": "phase"}
    at = {number: names.index(renamed.get(name, name)) for number, name in enumerate(_NAMES)
          if renamed.get(name, name) in names}  # fmt: skip
    covariance = np.zeros((len(_NAMES),) * 2)
    mine, its = list(at), list(at.values())
    covariance[np.ix_(mine, mine)] = attempt.fit.covariance[np.ix_(its, its)]
    parameters = np.array([others[name] if name in others else values[name] for name in _NAMES])
    fit = WallFit(parameters, covariance, np.empty(0), True)
    response = response_of(fit, _shares_of(attempt, fit), "graded", attempt.readers[0].turn)
    return replace(response, **attempt.remembered)


def _shares_of(attempt: Attempt, fit: WallFit) -> tuple[float, float]:
    """Return the shares of the wall's height between which nearly all samples are, by their light."""
    light = np.concatenate([
        (window.counts[:, window.usable] - window.response.dark[window.usable])
        / window.response.span[window.usable]
        for touch in attempt.used
        for window in touch.windows
        if isinstance(window.response, WallLight)
    ], axis=None)  # fmt: skip
    _, steps, _ = model.split(fit.parameters)
    curve = model.curve_values(model.curve_from_steps(fit.rising) @ steps, _SHARES)
    low, high = np.interp(np.quantile(light, [FEW, 1 - FEW]), np.maximum.accumulate(curve), _SHARES)
    return float(low), float(high)


def earlier_of(wall: WallResponse) -> Earlier:
    """Return what a response has told of a wall; that of balls counts as that of touches."""
    if wall.names is not None:
        told = wall.values, wall.information, wall.pull, wall.touches, wall.time
        return Earlier(wall.names, *cast(tuple[Doubles, Doubles, Doubles, int, float], told))
    at = [wall.parameters.index(name) for name in _OF_WALL]
    known = np.linalg.inv(wall.covariance[np.ix_(at, at)])
    numbers = {
        "radius": wall.radius,
        "rim": wall.rim,
        "scatter": scatter_of(wall),
        **{f"axis_{axis}": value for axis, value in zip("xy", wall.axis, strict=True)},
        **{f"sight_{power}": value for power, value in zip("02", wall.sight, strict=True)},
        **{f"lamp_{axis}": value for axis, value in zip("xy", wall.lamps, strict=True)},
        **{f"shade_{number}": value for number, value in enumerate(wall.shade)},
        **dict(zip(model.STEP_NAMES, steps_of(wall), strict=True)),
    }
    values = np.array([numbers[name] for name in _OF_WALL], np.float64)
    return Earlier(_OF_WALL, values, (known + known.T) / 2, np.zeros(len(_OF_WALL)), 0, math.nan)


def scatter_of(wall: WallResponse) -> float:
    """Return the scatter that was fitted, radians."""
    return wall.scatter / model.SCATTER_MARGIN
