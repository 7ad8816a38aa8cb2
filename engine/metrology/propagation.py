"""How noise changes texture parameters, from realisations of the noise that are added to the texture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.parameters import PARAMETERS
from mirrorskin.kernels.array_types import Doubles

Evaluate = Callable[[Doubles], dict[str, float]]

NOISE, NOISE_BIAS = "noise, random", "noise, systematic"
"""Contributions to an uncertainty."""

HOPELESS = 0.6
"""Share of noise in Sq^2 above which skewness, kurtosis and material ratios cannot be separated from it."""

ANY_DIRECTION = 180 / math.sqrt(12)
"""Standard deviation of a uniformly distributed direction, degrees."""

# Factor on the extrapolated change of extremes and material ratios, which is steep where noise is small;
# chosen for a chi-square of about 1 (tests/engine/metrology/test_uncertainty.py).
_EXTREME = 1.8
_RATIO = 2.0  # power of the surface's share of Sq^2 in a further factor for material ratios
_SHAPES = {"sk": (0.0, 1.5), "ku": (3.0, 2.0)}  # value of a normal distribution, and power of Sq^2


@dataclass(slots=True)
class NoiseChanges:
    """How noise changes the parameters of a texture.

    Attributes
    ----------
    level : float
        Sq of the noise alone, µm.
    share : float
        Share of the noise in the mean square of the texture.
    random, bias : dict of str to float
        Standard deviation and mean change of each parameter, in its unit; NaN if unknown.
    square_spread : float
        Standard deviation of Sq^2, µm^2.
    """

    level: float
    noise_ratio: float
    random: dict[str, float] = field(default_factory=dict)
    bias: dict[str, float] = field(default_factory=dict)
    square_spread: float = 0.0


def add_noise(
    values: Mapping[str, float],
    root: str,
    evaluate: Evaluate,
    texture: Doubles,
    kept: NDArray[np.bool_],
    errors: Iterable[Doubles],
) -> NoiseChanges:
    """Return how errors, each of one realisation, change the parameters of a texture.

    The measured texture already has noise once; what a second one adds is extrapolated to what the first one
    added (simulation extrapolation, Cook and Stefanski 1994). ``root`` is the name of Sq or Rq.
    """
    drawn: dict[str, list[float]] = {name: [] for name in values}
    powers = []
    for error in errors:
        powers.append(float(np.mean(error[kept] ** 2)))
        for name, value in evaluate(texture + error).items():
            drawn[name].append(value)
    level, whole = 1e3 * math.sqrt(np.mean(powers)), values[root]
    changes = NoiseChanges(level, min((level / whole) ** 2, 1.0) if whole > 0 else 1.0)
    for name, numbers in drawn.items():
        changes.random[name] = _spread(name, np.array(numbers))
        changes.bias[name] = _bias(name, values[name], np.array(numbers), changes.noise_ratio)
    changes.square_spread = float(np.std(np.array(drawn[root]) ** 2, ddof=1))
    return changes


def _spread(name: str, drawn: Doubles) -> float:
    """Return the standard deviation of a parameter; of the direction, around the circle."""
    if name != "Std":
        return float(np.std(drawn, ddof=1))
    mean = abs(np.mean(np.exp(2j * np.radians(drawn))))
    return min(math.degrees(math.sqrt(max(-2 * math.log(mean), 0.0)) / 2), ANY_DIRECTION)


def _bias(name: str, value: float, drawn: Doubles, noise_ratio: float) -> float:
    """Return the mean change by the noise that the texture has."""
    if name == "Std":
        return 0.0
    kind, mean = PARAMETERS[name].noise, float(np.mean(drawn))
    if kind in ("amplitude", "extreme"):
        bias = value - math.sqrt(max(2 * value**2 - float(np.mean(drawn**2)), 0.0))
        if kind == "extreme":
            bias = min(_EXTREME * bias, value)
        if PARAMETERS[name].unit:  # heights: noise that is not normally distributed counts as in Sq
            bias = max(bias, value * (1 - math.sqrt(1 - noise_ratio)))
        return bias
    if kind == "plain":
        return float(mean - value)
    if noise_ratio > HOPELESS:
        return math.nan
    if kind == "ratio":
        return float(_EXTREME * (mean - value) * (1 - noise_ratio) ** -_RATIO)
    normal, power = _SHAPES[name[1:]]  # noise leaves the third and the fourth cumulant as they are
    return float(value - (normal + (value - normal) * (1 - noise_ratio) ** -power))


def change(evaluate: Evaluate, texture: Doubles, errors: Sequence[Doubles]) -> dict[str, float]:
    """Return by how much errors of either sign change each parameter of a texture."""
    squares: dict[str, float] = {}
    for error in errors:
        above, below = evaluate(texture + error), evaluate(texture - error)
        for name, value in above.items():
            difference = value - below[name]
            if name == "Std":
                difference = (difference + 90) % 180 - 90
            squares[name] = squares.get(name, 0.0) + (difference / 2) ** 2
    return {name: math.sqrt(square) for name, square in squares.items()}
