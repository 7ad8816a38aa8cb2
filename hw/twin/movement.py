"""The movements of section 2.1 of the paper: where the object is, seen from the sensor's body."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.io import check_phase, check_stroke
from mirrorskin.io.types import Block, Floats, Header, InputError, Motion

TILT_MAX = math.radians(30.0)


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid move: the object's point p is at ``rotation @ p + shift`` in the body's frame, mm."""

    rotation: Floats
    shift: Floats

    @property
    def upright(self) -> bool:
        """Whether the object is neither tilted nor turned."""
        return bool(np.array_equal(self.rotation, np.eye(3)))


class Movement(Protocol):
    """What the body does, frame by frame.

    Positions are numbered by frames; one between two frames is passed between their exposures.
    """

    @property
    def motion(self) -> Motion:
        """Which of the four it is."""

    @property
    def positions(self) -> Floats:
        """Where the body is in each frame, (T, ...), float64: what a recording says of it."""

    @property
    def path(self) -> Floats:
        """The same without jumps, to tell what lies between two frames."""

    @property
    def deepest(self) -> float:
        """Greatest travel, mm."""

    def rise(self, radius: float, /) -> float:
        """Bound how far an object of a radius about the origin can rise above the rest plane, mm."""

    def reduced(self, path: Floats, /) -> Floats:
        """Make places on the path equal where they are the same."""

    def pose(self, place: Floats, /) -> Pose:
        """Tell where the object is when the body is at a place, one item of the path."""

    def header(self) -> Header:
        """Tell what holds for the whole movement."""

    def mark(self, block: Block, /) -> Block:
        """Add to a block where the body was in its frames."""


def pose_at_press(travel: float) -> Pose:
    """Lower the body, upright: the object rises in its frame."""
    return Pose(np.eye(3), np.array([0.0, 0.0, travel]))


def pose_at_lean(
    travel: float, tilt: float, phase: float, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Pose:
    """Lower the body, upright, by a travel; then tilt it about its pivot at a phase, see `Axial`.

    Without a tilt the body stays upright, whatever the phase.
    """
    if tilt == 0:
        return pose_at_press(travel)
    rotation = _about_z(phase) @ _about_y(tilt) @ _about_z(-phase)
    centre = np.asarray(pivot, np.float64)
    return Pose(rotation, rotation @ (np.array([0.0, 0.0, travel]) - centre) + centre)


class _Upright:
    """What all movements share that do not tilt the body."""

    positions: Floats
    deepest: float

    @property
    def path(self) -> Floats:
        """The positions, which do not jump."""
        return self.positions

    def rise(self, radius: float, /) -> float:
        """Return how far the body is lowered: nothing tilts."""
        return self.deepest

    def reduced(self, path: Floats, /) -> Floats:
        """Return the places as they are."""
        return path


class Vertical(_Upright):
    """Press, release, or one after the other.

    Parameters
    ----------
    travel : array_like, (T,)
        Millimetres that the stage has been lowered in each frame.
    compliance : float
        By how much the stage gives way, mm/N; needs elastic contact, which knows the force.

    Raises
    ------
    InputError
        The travel is empty, not finite, or goes down again after it came up; the compliance is negative.
    """

    motion: Motion = "vertical"

    def __init__(self, travel: ArrayLike, *, compliance: float = 0.0) -> None:
        self.positions = check_stroke(travel, _count(travel), "travel")
        _check_frames(self.positions, "travel")
        if not (math.isfinite(compliance) and compliance >= 0):
            raise InputError(f"compliance {compliance} mm/N cannot be: give 0 or more")
        self.compliance = compliance
        self.deepest = float(self.positions.max())

    def pose(self, place: Floats, /) -> Pose:
        """Lower the body to a travel, mm."""
        return pose_at_press(float(place))

    def header(self) -> Header:
        """Tell the motion."""
        return Header(self.motion)

    def mark(self, block: Block, /) -> Block:
        """Add the travel."""
        return replace(block, travel=self.positions[_frames(block)])


class Axial:
    """Precession: the body's axis goes round on a cone of half-angle ``tilt``.

    At phase alpha the axis leans towards alpha + pi, and a vector x of the world is, in the body's frame ::

        x' = Rz(alpha) Ry(tilt) Rz(-alpha) x

    which is eq. 10 of the paper. The body turns about ``pivot``, so that the object moves in the picture.

    Parameters
    ----------
    phase : array_like, (T,)
        Radians, counter-clockwise; evenly spaced or not.
    tilt : float
        Radians, above 0 and at most 30 degrees.
    press : float
        Millimetres that the body is lowered, upright, before it tilts.
    pivot : (float, float, float)
        From the rest sheet's centre, mm, in the body's frame.

    Raises
    ------
    InputError
        A value cannot be.
    """

    motion: Motion = "axial"

    def __init__(
        self, phase: ArrayLike, tilt: float, press: float, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        self.positions = check_phase(phase, _count(phase), "phase")
        _check_frames(self.positions, "phase")
        self.path = np.unwrap(self.positions)
        if not (math.isfinite(tilt) and 0 < tilt <= TILT_MAX):
            raise InputError(
                f"tilt {math.degrees(tilt):g} degrees cannot be: give more than 0 and at most"
                f" {math.degrees(TILT_MAX):g} degrees"
            )
        if np.shape(pivot) != (3,) or not np.isfinite(pivot).all():
            raise InputError(f"pivot {pivot} cannot be: give x, y and z in mm")
        self.deepest = _check_press(press)
        self.tilt = tilt
        self.pivot = pivot

    def rise(self, radius: float, /) -> float:
        """Add to the press what tilting about the pivot and the object's own width can raise."""
        x, y, z = self.pivot
        outwards = radius + math.hypot(x, y)
        return z + (self.deepest - z) * math.cos(self.tilt) + outwards * math.sin(self.tilt)

    def reduced(self, path: Floats, /) -> Floats:
        """Drop whole turns, and what of the phase rounding may differ by."""
        return np.asarray(2 * np.pi * (np.round(path / (2 * np.pi) % 1, 12) % 1))

    def pose(self, place: Floats, /) -> Pose:
        """Tilt the body about its pivot at a phase, radians."""
        return pose_at_lean(self.deepest, self.tilt, float(place), self.pivot)

    def header(self) -> Header:
        """Tell motion, press, tilt and pivot."""
        x, y, z = map(float, self.pivot)
        return Header(self.motion, press=self.deepest, tilt=self.tilt, pivot=(x, y, z))

    def mark(self, block: Block, /) -> Block:
        """Add the phase."""
        return replace(block, phase=self.positions[_frames(block)])


class _Pressed(_Upright):
    """What movements share that go on at one depth."""

    motion: Motion

    def __init__(self, positions: Floats, name: str, press: float) -> None:
        _check_frames(positions, name)
        self.positions, self.deepest = positions, _check_press(press)

    def header(self) -> Header:
        """Tell motion and press."""
        return Header(self.motion, press=self.deepest)


class Horizontal(_Pressed):
    """Move the pressed body sideways.

    Parameters
    ----------
    displacement : array_like, (T, 2)
        Millimetres along x and y.
    press : float
        Millimetres that the body is lowered.

    Raises
    ------
    InputError
        A value cannot be.
    """

    motion: Motion = "horizontal"

    def __init__(self, displacement: ArrayLike, press: float) -> None:
        positions = np.asarray(displacement, np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2:
            raise InputError(f"displacement of shape {positions.shape} cannot be: give x and y a frame")
        super().__init__(positions, "displacement", press)

    def pose(self, place: Floats, /) -> Pose:
        """Move the body by x and y, mm: the object goes the other way in the picture."""
        return Pose(np.eye(3), np.array([-place[0], -place[1], self.deepest]))

    def mark(self, block: Block, /) -> Block:
        """Add the displacement."""
        return replace(block, displacement=self.positions[_frames(block)])


class Twist(_Pressed):
    """Turn the pressed body about its axis.

    Parameters
    ----------
    twist : array_like, (T,)
        Radians, counter-clockwise as the camera sees it.
    press : float
        Millimetres that the body is lowered.

    Raises
    ------
    InputError
        A value cannot be.
    """

    motion: Motion = "twist"

    def __init__(self, twist: ArrayLike, press: float) -> None:
        positions = np.asarray(twist, np.float64)
        if positions.ndim != 1:
            raise InputError(f"twist of shape {positions.shape} cannot be: give one angle a frame")
        super().__init__(positions, "twist", press)

    def pose(self, place: Floats, /) -> Pose:
        """Turn the body by an angle: the object goes the other way in the picture."""
        return Pose(_about_z(-float(place)), np.array([0.0, 0.0, self.deepest]))

    def mark(self, block: Block, /) -> Block:
        """Add the twist."""
        return replace(block, twist=self.positions[_frames(block)])


def _frames(block: Block) -> slice:
    return slice(block.index, block.index + len(block.frames))


def _count(values: ArrayLike) -> int:
    shape = np.shape(values)
    return shape[0] if len(shape) == 1 else -1


def _check_frames(positions: Floats, name: str) -> None:
    if len(positions) == 0:
        raise InputError(f"{name} is empty: give the position of at least one frame")
    bad = ~np.isfinite(positions).reshape(len(positions), -1).all(axis=1)
    if bad.any():
        raise InputError(f"{name} is not finite at frame {int(np.argmax(bad))}: every frame needs a position")


def _check_press(press: float) -> float:
    if not math.isfinite(press):
        raise InputError(f"press {press} mm cannot be: give how far the body is lowered")
    return float(press)


def _about_y(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def _about_z(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
