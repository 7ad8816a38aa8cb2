"""Where the body was in each frame: the checks that every reader and estimator shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.types import Floats, InputError


@runtime_checkable
class Positions(Protocol):
    """Where the body was, for whoever knows how many frames there are."""

    def positions(self, count: int, /) -> Floats:
        """Return the positions of so many frames, mm or radians; InputError if they are of another number."""


def along(given: ArrayLike | Positions | None, count: int) -> ArrayLike | None:
    """Return the positions of so many frames, however they are given."""
    return given.positions(count) if isinstance(given, Positions) else given


@dataclass(frozen=True, slots=True)
class Steps:
    """Evenly spaced positions: frame k is at ``start + k * step``, in millimetres or radians.

    Examples
    --------
    >>> Steps(0.1, start=1.0).positions(3)
    array([1. , 1.1, 1.2])
    """

    step: float
    start: float = 0.0

    def positions(self, count: int) -> Floats:
        """Return the positions of ``count`` frames."""
        with np.errstate(invalid="ignore", over="ignore"):  # who takes them refuses what is not finite
            return np.asarray(self.start + self.step * np.arange(count), np.float64)


def check_travel(
    travel: ArrayLike | None, count: int, name: str, after: Sequence[float] = (), falls: bool = False
) -> NDArray[np.float64]:
    """Return the travel of a press, mm, or of a release if it ``falls``, as float64 (T,).

    InputError, which calls it ``name``: it is missing, of another length, not finite, or runs back; ``after``
    is the travel of the frame before, if any.

    Examples
    --------
    >>> check_travel([0, 1, 2], 3, "travel")
    array([0., 1., 2.])
    """
    values = _known(travel, count, name)
    whole = np.concatenate([after, values])
    back = whole[1:] > whole[:-1] if falls else whole[1:] < whole[:-1]
    if np.any(back):
        frame = int(np.argmax(back)) + 1 - len(after)
        rule = "a release only goes up" if falls else "a press only goes down"
        raise InputError(f"{name} runs back at frame {frame}: {rule}; cut or reverse it")
    return values


def check_stroke(
    travel: ArrayLike | None, count: int, name: str, within: tuple[int, int] | None = None
) -> NDArray[np.float64]:
    """Return the travel of a press, of a release, or of one after the other, mm, as float64.

    It rises to its greatest value, where it may rest, and falls from there on; either way may be missing.
    Only that of the frames from the first to the end of ``within`` is checked and returned, if it is given.

    Examples
    --------
    >>> check_stroke([0, 1, 1, 0], 4, "travel")
    array([0., 1., 1., 0.])
    """
    values = _known(travel, count, name, within)
    deepest = np.flatnonzero(values == np.max(values, initial=-np.inf))
    frame = np.arange(1, len(values))
    up, down = values[1:] < values[:-1], values[1:] > values[:-1]
    back = (up & (frame <= deepest[-1:])) | (down & (frame > deepest[:1]))
    if np.any(back):
        at = (within or (0,))[0] + int(np.argmax(back)) + 1
        raise InputError(
            f"{name} runs back at frame {at}: a press goes down and its release up, once; cut it"
        )
    return values


def check_phase(
    phase: ArrayLike | None, count: int, name: str, within: tuple[int, int] | None = None
) -> NDArray[np.float64]:
    """Return the phases of an axial rotation, radians, as float64; ``within`` as for ``check_stroke``.

    Examples
    --------
    >>> check_phase([0, 1.5, 3], 3, "phase")
    array([0. , 1.5, 3. ])
    """
    if phase is None:
        raise InputError(f"{name} is missing: an axial rotation needs the phase of each frame, in radians")
    return _finite(phase, count, name, within)


def _known(
    travel: ArrayLike | None, count: int, name: str, within: tuple[int, int] | None = None
) -> NDArray[np.float64]:
    if travel is None:
        raise InputError(f"{name} is missing: a vertical press needs the travel of each frame, in mm")
    return _finite(travel, count, name, within)


def _finite(values: ArrayLike, count: int, name: str, within: tuple[int, int] | None) -> NDArray[np.float64]:
    array: NDArray[Any] = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name} is of type {array.dtype}: numbers are needed")
    if array.shape != (count,):
        raise InputError(f"{name} has shape {array.shape} for {count} frames: one number a frame is needed")
    start, stop = within or (0, count)
    known = np.isfinite(array[start:stop])
    if not np.all(known):
        frame = start + int(np.argmin(known))
        raise InputError(f"{name} is {array[frame]} at frame {frame}: every frame needs a finite number")
    return array[start:stop].astype(np.float64)
