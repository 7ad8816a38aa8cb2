"""Onsets at several thresholds: a wall with steps of light bounds the inclination of the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from mirrorskin.engine.base.options import option
from mirrorskin.engine.press.onset import ThresholdOperation
from mirrorskin.io import InputError, Result
from mirrorskin.io.model.maps import TABLE, PressStatus


class Levels(ThresholdOperation):
    """Height from the lowest of several thresholds, and bounds of the sheet's inclination from all of them.

    The wall has steps of brightness, so a pixel passes one threshold after the other while the sheet tilts. A
    pixel that has passed a threshold is inclined by at least the angle of this threshold.

    Examples
    --------
    >>> frames = np.zeros((4, 1, 3), np.uint8)
    >>> frames[2:, 0] = [0, 120, 250]
    >>> from mirrorskin import engine
    >>> levels = Levels(thresholds=[0.25, 0.75], inclinations=[0.2, 0.5], noise=1.0)
    >>> engine.run(frames, levels, travel=[0.0, 0.1, 0.2, 0.3]).slope_min
    array([[0. , 0.2, 0.5]], dtype=float32)
    """

    thresholds: Sequence[float] = option(
        default=None,
        unit="share",
        within=(0, 1),
        help="shares of the range from dark to bright, from the lowest to the highest, for a wall with"
        " levels; heights are computed from the lowest",
        shown_default="one threshold",
    )
    inclinations: Sequence[float] = option(
        default=None,
        unit="rad",
        within=(0, None),
        help="inclination of the sheet at which each threshold is passed",
        shown_default="none",
    )
    slope_min = TABLE["slope_min"]
    slope_max = TABLE["slope_max"]

    def check_options(self) -> None:
        """Raise InputError unless thresholds and inclinations rise, and are equally many."""
        shares, angles = list(self.thresholds or ()), list(self.inclinations or ())
        if not shares or any(high <= low for low, high in pairwise(shares)):
            raise InputError(
                f"thresholds {_listed(shares)}: give them from the lowest to the highest, such as 0.25, 0.75"
            )
        if len(angles) != len(shares):
            raise InputError(
                f"inclinations do not match: {len(shares)} thresholds and {len(angles)} inclinations. Give"
                " the sheet's inclination at which each threshold is passed, starting with the lowest"
            )
        if not all(low < high for low, high in pairwise([0.0, *angles, math.pi / 2])):
            degrees = _listed(map(math.degrees, angles))
            raise InputError(
                f"inclinations {degrees} deg: they must rise with the thresholds, between 0 and 90"
            )

    @property
    def shares(self) -> Sequence[float]:
        """The thresholds."""
        return self.thresholds

    @property
    def lowest_threshold(self) -> float:
        """Share of the range from dark to bright at which heights are computed."""
        return self.thresholds[0]

    def result(self) -> Result:
        """Return heights by the lowest threshold, and the bounds of the inclination."""
        levels = [search.event_maps() for search in self._searches]
        light = [np.isin(maps.status, (PressStatus.ONSET, PressStatus.LIGHT_AT_START)) for maps in levels]
        passed = np.sum(np.logical_and.accumulate(light), axis=0).astype(np.intp)
        passed[levels[0].status == PressStatus.INVALID_INPUT] = -1  # the last entry of the bounds, NaN
        lowest = np.array([0, *self.inclinations, np.nan], np.float32)
        greatest = np.array([*self.inclinations, np.nan, np.nan], np.float32)
        return self.as_result(levels[0], slope_min=lowest[passed], slope_max=greatest[passed])


def _listed(numbers: Any) -> str:
    return ", ".join(f"{number:g}" for number in numbers)
