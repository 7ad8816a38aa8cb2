"""How late a camera's frames come: from a move there and back, which must look the same both ways."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.hw.errors import HardwareError
from mirrorskin.io.types import Floats

_REMEDY = "measure it otherwise and write it into the rig file as 'delay' of the camera"
_BLOCKS = 16  # along either side of the picture
_COMPONENTS = 6  # of the picture's change that count
_RANGE = (-0.05, 0.6)  # seconds
_TRIALS = 66
_KNOTS = (5, 40)
_FRAMES_A_KNOT = 5
_STIFF = 1e-6
_EXPLAINED = 0.5  # share of the picture's change that goes by the place
_UNSURE = 0.01  # seconds


@dataclass(frozen=True, slots=True)
class Delay:
    """How long after the middle of its exposure a frame arrives."""

    seconds: float
    error: float  # standard deviation that is expected of it, seconds


def block_means(frames: NDArray[Any], blocks: int = _BLOCKS) -> Floats:
    """Return the mean counts of a grid of blocks in each frame, (n, blocks x blocks), float64."""
    rows, columns = (np.linspace(0, size, min(blocks, size) + 1).astype(np.intp) for size in frames.shape[1:])
    sums = np.add.reduceat(frames, columns[:-1], axis=2, dtype=np.float64)
    sums = np.add.reduceat(sums, rows[:-1], axis=1)
    return np.asarray((sums / np.outer(np.diff(rows), np.diff(columns))).reshape(len(frames), -1))


def estimate_delay(
    arrival: ArrayLike, pictures: ArrayLike, place: Callable[[Floats], Floats], name: str = "the camera"
) -> Delay:
    """Find the delay at which the picture is one function of the place, on the way there and back.

    The function is a broken line through some twenty places, fitted together with a steady drift to the
    principal components of the picture's change; the delay leaves the least sum of squares. Its standard
    error follows from the residual of each frame as an error in time.

    Parameters
    ----------
    arrival : array_like, (n,)
        When the frames arrived, seconds.
    pictures : array_like, (n, k)
        What each frame shows: its ``block_means``.
    place : callable
        Tells where the body was at some times, (n,): the same number at the same place, there and back.
    name : str
        What to call the camera in messages.

    Raises
    ------
    HardwareError
        The picture changes too little.
    """
    from scipy.optimize import minimize_scalar

    time = np.asarray(arrival, np.float64)
    change = _components(np.asarray(pictures, np.float64))
    total = float(np.sum(change**2))

    def cost(delay: float) -> float:
        return float(np.sum(_fit(place(time - delay), time, change).residual ** 2))

    trials = np.linspace(*_RANGE, _TRIALS)
    costs = [cost(float(delay)) for delay in trials]
    best = int(np.argmin(costs))
    if not total > 0 or best in (0, _TRIALS - 1) or costs[best] > (1 - _EXPLAINED) * total:
        raise HardwareError(
            f"{name}: its delay cannot be found, as the picture hardly changes with the place: press"
            f" deeper, or {_REMEDY}"
        )
    around = tuple(trials[[best - 1, best + 1]])
    found = minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 1e-5})
    error = _error(float(found.x), time, change, place)
    if not error < _UNSURE:
        raise HardwareError(
            f"{name}: its delay is {found.x:.3f} s, give or take {error:.3f} s, which is too little to go by:"
            f" press deeper, or {_REMEDY}"
        )
    return Delay(float(found.x), error)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A broken line through the picture's components: its residual and its slope at each frame, (n, c)."""

    residual: Floats
    slope: Floats
    freedom: int


def _components(pictures: Floats) -> Floats:
    """Return the largest principal components of the pictures' change, (n, c)."""
    change = pictures - pictures.mean(axis=0)
    left, size, _ = np.linalg.svd(change, full_matrices=False)
    return np.asarray((left * size)[:, :_COMPONENTS])


def _fit(place: Floats, time: Floats, change: Floats) -> _Fit:
    """Fit a broken line over the places, and a drift with the time, to each component."""
    count = int(np.clip(len(place) // _FRAMES_A_KNOT, *_KNOTS))
    low, high = float(place.min()), float(place.max())
    width = (high - low) / (count - 1) or 1.0
    along = np.clip((place - low) / width, 0, count - 1)
    knot = np.minimum(along.astype(np.intp), count - 2)
    hats = _BrokenLines(knot, along - knot, count)

    since = (time - time.mean())[:, None]
    of_change, of_since = hats.fit(change), hats.fit(since)
    bent = since - hats.at(of_since)  # of the drift, what no line over the places can be
    drift = np.sum(bent * change, axis=0) / max(float(np.sum(bent * since)), 1e-300)
    line = of_change - of_since * drift
    slope = (line[knot + 1] - line[knot]) / width
    return _Fit(change - hats.at(line) - since * drift, slope, count + 1)


class _BrokenLines:
    """Least squares of broken lines: by bands, as threads of a matrix library take longer than the work.

    Of each frame, (n,), it is given the knot before it, and its share of the way to the next.
    """

    def __init__(self, knot: NDArray[np.intp], share: Floats, count: int) -> None:
        self._knot, self._near, self._next, self._count = knot, 1 - share, share, count
        diagonal = np.bincount(knot, self._near**2, count) + np.bincount(knot + 1, self._next**2, count)
        above = np.bincount(knot + 1, self._near * self._next, count)
        # A knot that no frame is near is held by a little stiffness.
        self._bands = np.stack([above - _STIFF, diagonal + (2 + _STIFF) * _STIFF])

    def fit(self, values: Floats) -> Floats:
        """Return the lines' values at the knots, (count, c), for values at the frames, (n, c)."""
        from scipy.linalg import solveh_banded

        sums = [
            np.bincount(self._knot, self._near * one, self._count)
            + np.bincount(self._knot + 1, self._next * one, self._count)
            for one in values.T
        ]
        return np.asarray(solveh_banded(self._bands, np.stack(sums, axis=1)))

    def at(self, line: Floats) -> Floats:
        """Return the lines' values at the frames, (n, c)."""
        found: Floats = self._near[:, None] * line[self._knot] + self._next[:, None] * line[self._knot + 1]
        return found


def _error(delay: float, time: Floats, change: Floats, place: Callable[[Floats], Floats]) -> float:
    """Return the standard error of a delay: a frame counts by how its picture depends on time."""
    step = 1e-3
    fit = _fit(place(time - delay), time, change)
    speed = (place(time - delay + step) - place(time - delay - step)) / (2 * step)
    pace = fit.slope * speed[:, None]
    weight = np.sum(pace**2, axis=1)
    late = np.sum(pace * fit.residual, axis=1)  # the frame's error in time, times its weight
    free = max(1, len(time) - fit.freedom) / len(time)
    return math.sqrt(float(np.sum(late**2)) / free) / max(float(weight.sum()), 1e-300)
