"""Faults of slopes, and how `engine.integrate` answers to them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mirrorskin import engine

Map = NDArray[np.float64]

SHAPE, PIXEL, NOISE = (96, 128), 0.05, 0.02  # pixels; mm; standard deviation of slopes


@dataclass(frozen=True)
class SlopeFault:
    """What is wrong with slopes.

    Attributes
    ----------
    reach : float
        Standard deviation of the Gaussian that noise was filtered with, pixels.
    gain : float
        Factor of all slopes.
    flattened : float
        Share of a slope of 1 that is lost; it grows with the square of the slope.
    outliers : float
        Share of the pixels whose slopes are any number.
    turn : float
        Angle by which all azimuths are wrong, degrees.
    step : float
        Height of a disc above the rest, whose slopes show no step, mm.
    options : dict
        What is stated to `engine.integrate`.
    """

    name: str
    reach: float = 0.0
    gain: float = 1.0
    flattened: float = 0.0
    outliers: float = 0.0
    turn: float = 0.0
    step: float = 0.0
    options: dict[str, Any] = field(default_factory=dict)


SLOPE_FAULTS = (
    SlopeFault("none"),
    SlopeFault("correlated, 4 pixels", reach=2),
    SlopeFault("correlated, stated", reach=2, options={"slope_correlation": 4.0}),
    SlopeFault("gain 1 %", gain=1.01),
    SlopeFault("gain 1 %, stated", gain=1.01, options={"slope_gain_sigma": 0.01}),
    SlopeFault("flattened 2 %", flattened=0.02),
    SlopeFault("outliers 1 %", outliers=0.01),
    SlopeFault("azimuth 1 degree", turn=1.0),
    SlopeFault("step of 0.3 mm", step=0.3),
)


def integrated(fault: SlopeFault, seed: int, *, weights: bool, robust: bool) -> tuple[Map, Map]:
    """Return errors of heights about the mean of each component, and their standard deviations, mm."""
    generator = np.random.default_rng([seed, 40])
    y, x = ((places - (size - 1) / 2) * PIXEL for places, size in zip(np.indices(SHAPE), SHAPE, strict=True))
    u, v = 2 * np.pi * x / 1.6, 2 * np.pi * y / 1.9
    height = 0.2 * np.sin(u) * np.cos(v)
    slopes = np.stack(
        [0.2 * 2 * np.pi / 1.6 * np.cos(u) * np.cos(v), 0.2 * 2 * np.pi / 1.9 * np.sin(u) * np.sin(v)]
    )  # rows go down, y goes up
    height = height + fault.step * (np.hypot(x - 0.4, y) < 1.3)
    slopes *= fault.gain - fault.flattened * np.sum(slopes**2, axis=0)
    turn = np.radians(fault.turn)
    slopes = np.stack(
        [
            slopes[0] * np.cos(turn) - slopes[1] * np.sin(turn),
            slopes[0] * np.sin(turn) + slopes[1] * np.cos(turn),
        ]
    )
    noise = generator.standard_normal(slopes.shape)
    noise = gaussian_filter(noise, (0, fault.reach, fault.reach)) if fault.reach else noise
    slopes += NOISE * noise / noise.std()
    hit = generator.random(SHAPE) < fault.outliers
    slopes[:, hit] = generator.uniform(-2, 2, (2, int(hit.sum())))
    options = dict(fault.options, robust=robust)
    if weights:
        options["slope_weights"] = 1 / NOISE**2
    surface = engine.integrate(slopes[0], slopes[1], PIXEL, **options)
    error = surface.height - height
    for number in range(int(surface.component.max()) + 1):
        part = surface.component == number
        error[part] -= error[part].mean()
    return error, np.asarray(surface.height_sigma, np.float64)
