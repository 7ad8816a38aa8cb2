"""Position of the body in each frame: checks shared by readers and operations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.arguments import check_number
from mirrorskin.io.base.types import Floats, InputError

_ROUNDING = 1e-6  # radians
_VALUE_MAX = 1e12  # largest value accepted, in mm, rad or s


@runtime_checkable
class Positions(Protocol):
    """Positions of the body for a number of frames that is not yet known."""

    def positions(self, count: int, /) -> Floats:
        """Return the positions of ``count`` frames, mm or radians; InputError if the number differs."""


def along(
    positions: ArrayLike | Positions | None, count: int, lost: NDArray[np.int32] | None = None
) -> ArrayLike | None:
    """Return positions for ``count`` frames, from an array or an object that computes them.

    Even steps include the frames ``lost`` before each frame.
    """
    if isinstance(positions, Steps) and lost is not None and lost.any():
        return np.asarray(positions.start + positions.step * (np.arange(count) + np.cumsum(lost)))
    return positions.positions(count) if isinstance(positions, Positions) else positions


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

    def __post_init__(self) -> None:
        check_number("step", self.step)
        check_number("start", self.start)

    def positions(self, count: int) -> Floats:
        """Return the positions of ``count`` frames."""
        with np.errstate(invalid="ignore", over="ignore"):  # callers refuse values that are not finite
            return np.asarray(self.start + self.step * np.arange(count), np.float64)


def check_travel(
    travel: ArrayLike | None, count: int, name: str, after: Sequence[float] | Floats = (), falls: bool = False
) -> NDArray[np.float64]:
    """Return the travel of a press, mm, or of a release if it ``falls``, as float64 (T,).

    InputError, whose message begins with ``name``, if it is missing, has another length, is not finite, or
    reverses; ``after`` is the travel of the preceding frame, if any.

    Examples
    --------
    >>> check_travel([0, 1, 2], 3, "travel")
    array([0., 1., 2.])
    """
    values = check_strokes(travel, count, name)
    whole = np.concatenate([after, values])
    back = whole[1:] > whole[:-1] if falls else whole[1:] < whole[:-1]
    if np.any(back):
        frame = int(np.argmax(back)) + 1 - len(after)
        rule = "a release only goes up" if falls else "a press only goes down"
        raise InputError(f"{name} runs back at frame {frame}: {rule}; cut or reverse it")
    return values


def check_strokes(travel: ArrayLike | None, count: int, name: str) -> NDArray[np.float64]:
    """Return the travel of a vertical movement, mm, as float64: any number of strokes down and up.

    Examples
    --------
    >>> check_strokes([0, 1, 1, 0, 2], 5, "travel")
    array([0., 1., 1., 0., 2.])
    """
    if travel is None:
        raise InputError(f"{name} is missing: a vertical press needs the travel of each frame, in mm")
    return check_finite(travel, count, name)


def stroke_starts(travel: NDArray[np.float64], direction: int = 0) -> NDArray[np.intp]:
    """Return the first frames after the turning points, where the direction of travel is reversed.

    A stroke is a sequence of frames with the same direction of travel, including a rest at its end.
    ``direction`` is the direction at the first frame: 1 down, -1 up, 0 unknown.

    Examples
    --------
    >>> stroke_starts(np.array([0.0, 1.0, 1.0, 0.5, 2.0])).tolist()
    [3, 4]
    """
    steps = np.sign(travel[1:] - travel[:-1])
    if direction and not (steps == -direction).any():
        return np.empty(0, np.intp)
    moving = np.flatnonzero(steps)
    turned = np.diff(steps[moving], prepend=direction or (steps[moving[0]] if len(moving) else 0)) != 0
    return np.asarray(moving[turned] + 1, np.intp)


def check_phase(phase: ArrayLike | None, count: int, name: str) -> NDArray[np.float64]:
    """Return the phases of an axial rotation, radians, as float64.

    Examples
    --------
    >>> check_phase([0, 1.5, 3], 3, "phase")
    array([0. , 1.5, 3. ])
    """
    if phase is None:
        raise InputError(f"{name} is missing: an axial rotation needs the phase of each frame, in radians")
    return check_finite(phase, count, name)


def step_in_degrees(phase: NDArray[np.float64]) -> float:
    """Return the median step of phases, radians, if it exceeds a turn, which indicates degrees; else 0.

    Examples
    --------
    >>> step_in_degrees(np.arange(8) * 45.0), step_in_degrees(np.arange(8) * 0.785)
    (45.0, 0.0)
    """
    if phase.ndim != 1 or len(phase) < 3:
        return 0.0
    step = float(np.median(np.abs(np.diff(phase))))
    return step if step > 2 * np.pi + _ROUNDING else 0.0


def check_finite(
    values: ArrayLike,
    count: int,
    name: str,
    within: tuple[int, int] | None = None,
    width: tuple[int, ...] = (),
) -> NDArray[np.float64]:
    """Return the positions of ``count`` frames as float64, (T, *width).

    If ``within`` is given, only the frames from its first to before its end are checked and returned.

    Examples
    --------
    >>> check_finite([[0, 1], [2, 3]], 2, "displacement", width=(2,)).tolist()
    [[0.0, 1.0], [2.0, 3.0]]
    """
    array: NDArray[Any] = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name} is of type {array.dtype}: numbers are needed")
    if array.shape != (count, *width):
        needed = "two numbers a frame are" if width else "one number a frame is"
        raise InputError(f"{name} has shape {array.shape} for {count} frames: {needed} needed")
    start, stop = within or (0, count)
    checked = array[start:stop].astype(np.float64)
    if not (np.abs(checked) <= _VALUE_MAX).all():
        defined = (np.abs(checked) <= _VALUE_MAX).all(axis=tuple(range(1, array.ndim)))
        frame = start + int(np.argmin(defined))
        needed = f"every frame needs a finite number, at most {_VALUE_MAX:g}"
        raise InputError(f"{name} is {array[frame]} at frame {frame}: {needed}")
    return checked
