"""How noise changes texture parameters, from realisations of the noise that are added to the texture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.parameters import FUNCTIONAL, PARAMETERS, VOLUME
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.kernels.array_types import Doubles

Evaluate = Callable[[Doubles], dict[str, float]]

NOISE, NOISE_BIAS, EDGES = "noise, random", "noise, systematic", "filter edges"
"""Contributions to an uncertainty."""

HOPELESS = 0.6
"""Share of noise in Sq^2 above which skewness, kurtosis and material ratios cannot be separated from it."""

ANY_DIRECTION = 180 / math.sqrt(12)
"""Standard deviation of a uniformly distributed direction, degrees."""

LEVEL = 0.1
"""Relative uncertainty of standard deviations, whose squares are right within a fifth."""

_CLEAR = 2.0  # standard uncertainties by which Sq^2 exceeds that of the noise if there is a texture
_CLEAN_EXTREME = 1.3  # factor on the change of squares of extremes
_EXTRAPOLATED = 0.4  # relative uncertainty of the change of extremes
_SHAPE_LEVEL = 0.3  # that of skewness and kurtosis, which contain higher powers of the noise
# Factors on uncertainties of values without noise, for a chi-square of about 1 (test_uncertainty.py).
_WIDER, _WIDER_CURVE = 1.15, 1.3  # that of extremes, and of the material ratio curve
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
    clean : dict of str to (float, float)
        Estimate of each parameter without noise, and its standard uncertainty; NaN if unknown.
    significant : bool
        Whether Sq^2 exceeds that of the noise by more than two standard uncertainties.
    """

    level: float
    noise_ratio: float
    random: dict[str, float] = field(default_factory=dict)
    bias: dict[str, float] = field(default_factory=dict)
    clean: dict[str, tuple[float, float]] = field(default_factory=dict)
    significant: bool = True


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
        changes.clean[name] = _without_noise(name, values[name], np.array(numbers), changes)
    spread = float(np.std(np.array(drawn[root]) ** 2, ddof=1))
    square, uncertainty = whole**2 - level**2, math.hypot(spread, 2 * LEVEL * level**2)
    changes.clean[root] = _root(square, uncertainty)
    changes.significant = square > _CLEAR * uncertainty
    return changes


def with_clean(
    parameters: Mapping[str, Quantity], budget: Mapping[str, Mapping[str, float]], noise: NoiseChanges
) -> dict[str, Quantity]:
    """Return parameters with the Sq of the noise, and with those without noise, which have the same budget.

    The contributions of the noise to the latter are replaced.
    """
    quantities: dict[str, Quantity] = {}
    for name, quantity in parameters.items():
        quantities[name] = quantity
        if name == "Sq":
            quantities["Sq of noise"] = Quantity(noise.level, LEVEL * noise.level, "µm")
        value, spread = noise.clean[name]
        if math.isfinite(value) and math.isfinite(spread):
            others = (part for cause, part in budget[name].items() if cause not in (NOISE, NOISE_BIAS))
            quantities[f"{name} without noise"] = Quantity(value, math.hypot(spread, *others), quantity.unit)
    return quantities


def _root(square: float, error: float) -> tuple[float, float]:
    """Return the root of a square, at least 0, and its uncertainty from that of the square."""
    value = math.sqrt(max(square, 0.0))
    return value, math.sqrt(value**2 + error) - value


def _without_noise(name: str, value: float, drawn: Doubles, changes: NoiseChanges) -> tuple[float, float]:
    """Return a parameter less what noise changes it by, and its standard uncertainty.

    Material ratios and directions have none. The uncertainty contains the random error, which the surface's
    smaller share makes larger; that of the level of the noise; and a share of the change for its
    extrapolation.
    """
    kind = PARAMETERS[name].noise
    drawn = drawn[np.isfinite(drawn)]
    if drawn.size < 2 or not math.isfinite(value) or kind == "ratio" or name == "Std":
        return math.nan, math.nan
    if kind in ("amplitude", "extreme"):
        squares, extreme = drawn**2, kind == "extreme"
        excess = max(float(np.mean(squares)) - value**2, 0.0) * (_CLEAN_EXTREME if extreme else 1.0)
        share = _EXTRAPOLATED if extreme else 2 * LEVEL
        on_curve = extreme or PARAMETERS[name].group in (FUNCTIONAL, VOLUME)
        error = math.hypot(float(np.std(squares, ddof=1)), share * excess)
        return _root(value**2 - excess, (_WIDER_CURVE if on_curve else _WIDER) * error)
    bias, random = changes.bias[name], changes.random[name]
    rest = max(1 - changes.noise_ratio, 1 - HOPELESS)
    share = 2 * LEVEL if kind == "plain" else _SHAPE_LEVEL
    return value - bias, _WIDER * math.hypot(random / rest, share * bias)


def _spread(name: str, drawn: Doubles) -> float:
    """Return the standard deviation of a parameter; of the direction, around the circle."""
    if name != "Std":
        # Some realisations may have no value, such as that of a spacing.
        known = drawn[np.isfinite(drawn)]
        return float(np.std(known, ddof=1)) if 2 * known.size > drawn.size else math.nan
    mean = abs(np.mean(np.exp(2j * np.radians(drawn))))
    return min(math.degrees(math.sqrt(max(-2 * math.log(mean), 0.0)) / 2), ANY_DIRECTION)


def _bias(name: str, value: float, drawn: Doubles, noise_ratio: float) -> float:
    """Return the mean change by the noise that the texture has."""
    if name == "Std":
        return 0.0
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return math.nan
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
            squares[name] = squares.get(name, 0.0) + (difference(name, value, below[name]) / 2) ** 2
    return {name: math.sqrt(square) for name, square in squares.items()}


def difference(name: str, value: float, other: float) -> float:
    """Return the difference of two values of a parameter; of the direction, around the circle."""
    return (value - other + 90) % 180 - 90 if name == "Std" else value - other
