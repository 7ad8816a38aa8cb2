"""Onsets at several thresholds: a wall with steps of light tells between which inclinations a sheet lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.press.onset import Onset, OnsetSearch
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError
from mirrorskin.io.maps import PressStatus
from mirrorskin.kernels.device import Device


@dataclass(frozen=True, slots=True)
class Levels:
    """What several thresholds tell.

    Attributes
    ----------
    onset : Onset
        Of the lowest threshold.
    passed : ndarray, (H, W), int8
        How many thresholds a pixel passes, from the lowest on; -1 where the input is invalid.
    """

    onset: Onset
    passed: NDArray[np.int8]

    def bounds(self, inclinations: Sequence[float]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the least and the greatest inclination of the sheet at each pixel, (H, W), radians.

        ``inclinations`` are those at which the thresholds are passed, radians. The least is 0 where none is
        passed, the greatest NaN where all are.
        """
        lower, upper = (
            np.array(ends, np.float32)
            for ends in ([0, *inclinations, np.nan], [*inclinations, np.nan, np.nan])
        )
        # An invalid pixel's -1 is the last entry.
        return lower[self.passed], upper[self.passed]


def check_levels(
    thresholds: Sequence[float], inclinations: Sequence[float] | None
) -> tuple[list[float], list[float]]:
    """Return thresholds and the inclinations at which they are passed, or raise InputError."""
    shares, angles = list(map(float, thresholds)), list(map(float, inclinations or ()))
    if not shares or any(high <= low for low, high in pairwise(shares)):
        raise InputError(
            f"thresholds {_listed(shares)}: give them from the lowest to the highest, such as 0.25, 0.75"
        )
    if len(angles) != len(shares):
        raise InputError(
            f"{len(shares)} thresholds and {len(angles)} inclinations: give the sheet's inclination at which"
            " each threshold is passed (--inclination), from the lowest on"
        )
    rising = all(low < high for low, high in zip([0.0, *angles], [*angles, math.pi / 2], strict=True))
    if not rising:
        degrees = _listed(map(math.degrees, angles))
        raise InputError(f"inclinations {degrees} deg: they must rise with the thresholds, between 0 and 90")
    return shares, angles


def _listed(numbers: Any) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


class LevelSearch(ThreadSafe):
    """Find onsets at several thresholds; see `mirrorskin.engine.streaming.Estimator`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    thresholds : sequence of float
        Shares of the way from dark to bright, from the lowest on.
    **options
        Those of `OnsetSearch`, but ``threshold``.

    Raises
    ------
    mirrorskin.io.InputError
        Parameters that cannot be used.

    Examples
    --------
    >>> frames = np.zeros((4, 1, 3), np.uint8)
    >>> frames[2:, 0] = [0, 120, 250]
    >>> search = LevelSearch((1, 3), "uint8", [0.25, 0.75], noise=1.0)
    >>> search.push(frames, travel=[0.0, 0.1, 0.2, 0.3])
    >>> search.result().passed.tolist()
    [[0, 1, 2]]
    """

    position = "travel"

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        thresholds: Sequence[float],
        *,
        device: str | Device | None = None,
        **options: Any,
    ) -> None:
        first = OnsetSearch(shape, dtype, threshold=thresholds[0], device=device, **options)
        self.device: Device = first.device
        others = (
            OnsetSearch(shape, dtype, threshold=share, device=first.device, **options)
            for share in thresholds[1:]
        )
        self._searches = [first, *others]

    @cached_property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied."""
        return self._searches[0].room

    def reset(self) -> None:
        """Forget the frames so far."""
        for search in self._searches:
            search.reset()

    @property
    def travel(self) -> NDArray[np.float64]:
        """The travel of the frames so far, (T,), mm."""
        return self._searches[0].travel

    def push(self, frames: NDArray[Any], *, travel: ArrayLike | None, lent: bool = False) -> None:
        """Take in the next frames; see `OnsetSearch.push`."""
        for search in self._searches:
            search.push(frames, travel=travel, lent=lent)

    def result(self) -> Levels:
        """Return the maps of the frames so far; more may follow."""
        found = [search.result() for search in self._searches]
        light = [np.isin(one.status, (PressStatus.ONSET, PressStatus.LIGHT_AT_START)) for one in found]
        passed = np.sum(np.logical_and.accumulate(light), axis=0).astype(np.int8)
        return Levels(found[0], np.where(found[0].status == 0, np.int8(-1), passed))
