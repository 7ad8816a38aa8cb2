"""Turns of the body on a ball or on a plate, read from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError, Source

Doubles = NDArray[np.float64]

_MOST = 2_000_000_000  # bytes of frames that are held


@dataclass(frozen=True, slots=True, eq=False)
class BallTurn:
    """A turn of the body on a ball.

    Attributes
    ----------
    name : str
        Of where it comes from.
    frames : ndarray, (T, H, W)
        Counts.
    phase : ndarray, (T,), float64
        Radians, as the recording says.
    pixel_size : (float, float)
        Millimetres along x and y.
    radius : float
        Of the ball, mm.
    press : float or None
        By how much the stage says that it is pressed, upright, mm.
    """

    name: str
    frames: NDArray[Any]
    phase: Doubles
    pixel_size: tuple[float, float]
    radius: float
    press: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlateTurn:
    """A turn of the body on a flat plate.

    Attributes
    ----------
    name, frames, phase
        See `BallTurn`.
    level : bool
        Whether the plate is known to be level; else it is a wedge, inclined anyhow.
    """

    name: str
    frames: NDArray[Any]
    phase: Doubles
    level: bool


def read_ball(source: Source, radius: float) -> BallTurn:
    """Read an axial recording of a ball of some radius, mm.

    Raises
    ------
    InputError
        It is of another motion, has no pixel size, or is too long to be held.
    """
    pixel_size = source.header.pixel_size
    if pixel_size is None:
        raise InputError(f"{source.name}: its pixel size is not told: give it, as in --pixel-size 0.03mm")
    if not radius > 0:
        raise InputError(f"a ball of {2 * radius:g} mm cannot be: give its diameter")
    return BallTurn(source.name, *_read(source), pixel_size, radius, source.header.press)


def read_plate(source: Source, level: bool) -> PlateTurn:
    """Read an axial recording of a flat plate, level or not; see `read_ball`."""
    return PlateTurn(source.name, *_read(source), level)


def _read(source: Source) -> tuple[NDArray[Any], Doubles]:
    """Return all frames and their phases."""
    if source.motion != "axial":
        raise InputError(f"{source.name} is of {source.motion} motion: an axial recording is needed")
    frames = int(np.prod(source.shape)) * source.dtype.itemsize
    if frames > _MOST:
        raise InputError(f"{source.name}: {frames / 1e9:.1f} GB of frames are too much: take a turn or two")
    room = np.empty(source.shape, source.dtype)
    phases: list[Doubles] = []
    count = 0
    while count < len(room) and (block := source.read(room[count:])) is not None:
        if block.phase is None:
            raise InputError(f"{source.name} tells no phases: give them, as in --phase-step 45deg")
        room[count : count + len(block.frames)] = block.frames
        count += len(block.frames)
        phases.append(block.phase)
    return room[:count], np.concatenate([*phases, np.zeros(0)])
