"""What a section tells: lengths, slope, and the height of a step as ISO 5436-1 has it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.measure.quantity import Quantity
from mirrorskin.engine.measure.section import Section
from mirrorskin.engine.measure.smooth import covariance
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST = 4  # samples on either side of a step
_LEFT_OUT = 1 / 3  # of either side, next to the step: it may be rounded or a ramp


@dataclass(frozen=True, slots=True)
class Step:
    """Two levels along a section.

    Attributes
    ----------
    height : Quantity
        Distance of the two parallel lines, mm; positive where the section goes up.
    place : Quantity
        Distance of the step from the section's start, mm; it lies within one sample.
    slope : Quantity
        Of both lines, degrees; positive upwards.
    """

    height: Quantity
    place: Quantity
    slope: Quantity


def step_height(section: Section) -> Step:
    """Measure the step along a section.

    The step is where two parallel lines fit the measured samples before and after it best. Then the third of
    either side that lies nearest to it is left out, and the lines are fitted once more: the step's
    height is their distance, at right angles to them.

    Parameters
    ----------
    section : Section
        In millimetres.

    Returns
    -------
    Step
        Its uncertainty is that of `covariance`, with curves of either side as smooth shapes.

    Raises
    ------
    InputError
        Pixels of unknown size, too few measured samples, or a curve that fits better.
    """
    if section.unit != "mm":
        raise InputError("the result has no pixel size: reconstruct it again with --pixel-size")
    known = np.isfinite(section.height) & ~section.filled
    distance, height = section.distance[known], section.height[known]
    if distance.size < 2 * _LEAST:
        raise InputError(
            f"a step needs at least {2 * _LEAST} measured samples along the section: cut elsewhere"
        )
    split = _split(distance, height)
    place = (distance[split - 1] + distance[split]) / 2
    half = (distance[split] - distance[split - 1]) / 2
    kept = _away(distance, split)
    found, spread, left = _lines(distance[kept] - place, height[kept])
    if _curve(distance[kept] - place, height[kept]) < left:
        raise InputError("there is no step along the section: a smooth curve fits it better than two levels")
    slope, rise = float(found[1]), float(found[2])
    across = math.sqrt(1 + slope**2)
    return Step(
        Quantity(rise / across, math.sqrt(spread[2, 2]) / across, "mm"),
        Quantity(float(place), float(half) / math.sqrt(3), "mm"),
        Quantity(math.degrees(math.atan(slope)), math.degrees(math.sqrt(spread[1, 1]) / across**2), "deg"),
    )


def _split(distance: Doubles, height: Doubles) -> int:
    """Return the number of the first sample after the step: where two parallel lines leave the least."""
    x = distance - np.mean(distance)
    x /= np.linalg.norm(x)
    left = height - np.mean(height)
    left = left - x * (x @ left)
    # Of a step before each sample, what a line does not take in: its length, and its share in what is left.
    count = height.size
    after = count - np.arange(count)
    share = np.cumsum(x[::-1])[::-1]
    length = after * (count - after) / count - share**2
    tells = np.cumsum(left[::-1])[::-1] ** 2 / np.where(length > 0, length, np.inf)
    return _LEAST + int(np.argmax(tells[_LEAST : count - _LEAST + 1]))


def _away(distance: Doubles, split: int) -> Mask:
    """Return the samples that are not in the third of their side that lies next to the step."""
    start, end = distance[0], distance[-1]
    before = distance[split - 1] - _LEFT_OUT * (distance[split - 1] - start)
    after = distance[split] + _LEFT_OUT * (end - distance[split])
    return np.asarray((distance <= before) | (distance >= after))


def _lines(x: Doubles, z: Doubles) -> tuple[Doubles, Doubles, float]:
    """Fit parallel lines to samples before and after 0.

    Returns
    -------
    (ndarray, ndarray, float)
        Offset, slope and step; their covariance; and the sum of squares that is left.
    """
    up = (x > 0).astype(np.float64)
    rows = np.stack([np.ones_like(x), x, up])
    found, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    own = x / np.abs(x).max()
    shapes = np.stack([up * own, own**2, up * own**2, own**3, up * own**3])
    told = np.concatenate([rows, shapes, [z - found @ rows]])
    gram = told @ told.T
    return np.asarray(found), covariance(gram, len(rows), z.size), float(gram[-1, -1])


def _curve(x: Doubles, z: Doubles) -> float:
    """Return the sum of squares that a cubic leaves."""
    own = x / np.abs(x).max()
    rows = np.stack([np.ones_like(x), own, own**2, own**3])
    found, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    return float(np.sum((z - found @ rows) ** 2))


def along(section: Section) -> dict[str, Quantity]:
    """Return the length of a section, and what holds between the first and the last height measured on it.

    Errors of the two heights are taken to be independent.

    Raises
    ------
    InputError
        Fewer than two measured samples, or pixels of unknown size.
    """
    if section.unit != "mm":
        raise InputError("the result has no pixel size: reconstruct it again with --pixel-size")
    known = np.flatnonzero(np.isfinite(section.height) & ~section.filled)
    if known.size < 2:
        raise InputError(
            "the section has fewer than two measured heights that can be compared: cut elsewhere"
        )
    first, last = known[0], known[-1]
    run = float(section.distance[last] - section.distance[first])
    rise = float(section.height[last] - section.height[first])
    rise_sigma = math.hypot(section.sigma[first], section.sigma[last])
    length = math.hypot(run, rise)
    return {
        "section length": Quantity(float(section.distance[-1]), 0.0, "mm"),
        "height difference": Quantity(rise, rise_sigma, "mm"),
        "distance in space": Quantity(length, abs(rise) / length * rise_sigma, "mm"),
        "slope": Quantity(
            math.degrees(math.atan2(rise, run)), math.degrees(rise_sigma * run / length**2), "deg"
        ),
    }
