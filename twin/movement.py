"""The movements of section 2.1 of the paper: the pose of the object relative to the sensor's body."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.io.base.types import Block, Floats, Header, InputError, Motion
from mirrorskin.io.model.positions import check_phase, check_strokes

TILT_MAX = math.radians(30.0)

_UPRIGHT = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid move: the object's point p is at ``rotation @ p + shift`` in the body's frame, mm."""

    rotation: Floats
    shift: Floats

    @property
    def upright(self) -> bool:
        """Whether the object is neither tilted nor turned."""
        return bool((self.rotation == _UPRIGHT).all())


class Movement:
    """The motion of the body in each frame: base of `Vertical`, `Axial`, `Horizontal` and `Twist`.

    Positions are indexed by frame; fractional indices are positions between the exposures of two frames. In
    this class the body stays upright and its positions have no jumps.

    Attributes
    ----------
    motion : {"vertical", "axial", "horizontal", "twist"}
    positions : ndarray, (T, ...), float64
        Position of the body in each frame, as in a recording.
    path : ndarray, (T, ...), float64
        The same without jumps, for positions between two frames.
    deepest : float
        Greatest travel, mm.
    presses : bool
        Whether travel differs from frame to frame.
    steepest : float
        Greatest tilt to either side, radians.
    pivot : (float, float, float)
        Pivot of the tilt, from the rest sheet's centre, mm, in the body's frame.
    """

    path: Floats
    motion: Motion
    presses = False
    steepest: float = 0.0
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _recorded_as: str

    def __init__(self, positions: Floats, name: str, deepest: float) -> None:
        if len(positions) == 0:
            raise InputError(f"{name} is empty: give the position of at least one frame")
        bad = ~np.isfinite(positions).reshape(len(positions), -1).all(axis=1)
        if bad.any():
            frame = int(np.argmax(bad))
            raise InputError(f"{name} is not finite at frame {frame}: every frame needs a position")
        if not math.isfinite(deepest):
            raise InputError(f"press {deepest} mm is not possible: give the travel of the body")
        self.positions = self.path = positions
        self.deepest: float = float(deepest)

    def rise(self, radius: float, /) -> float:
        """Return an upper bound of the height of an object of a radius above the rest plane, mm.

        It is the press plus the rise by tilting about the pivot and by the object's own width.
        """
        x, y, z = self.pivot
        lowered = z + (self.deepest - z) * math.cos(self.steepest)
        return lowered + (radius + math.hypot(x, y)) * math.sin(self.steepest)

    def reduced(self, path: Floats, /) -> Floats:
        """Map equivalent positions on the path to equal values."""
        return path

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose of the object at a position of the body, one item of the path."""
        raise NotImplementedError

    def pose_at(self, frame: int, late: float = 0.0) -> Pose:
        """Return the pose of the object a number of frames after a frame's middle, or before if negative.

        The velocity is constant between two frames; beyond the ends it is that of the nearest interval.
        """
        first = frame - 1 if late < 0 else frame
        first = max(0, min(first, len(self.path) - 2))
        step = self.path[first + 1] - self.path[first] if len(self.path) > 1 else 0 * self.path[0]
        return self.pose(self.reduced(self.path[frame] + late * step))

    def header(self) -> Header:
        """Return the metadata of the whole movement."""
        return Header(self.motion, press=self.deepest)

    def mark(self, block: Block, /) -> Block:
        """Add the positions of the body to a block."""
        here = slice(block.index, block.index + len(block.frames))
        positions: dict[str, Any] = {self._recorded_as: self.positions[here]}
        return replace(block, **positions)


def pose_at_press(travel: float) -> Pose:
    """Return the pose of the object when the body is lowered, upright: it rises in the body's frame."""
    return Pose(np.eye(3), np.array([0.0, 0.0, travel]))


def pose_at_lean(
    travel: float, tilt: float, phase: float, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Pose:
    """Return the pose when the body is lowered and then tilted about its pivot at a phase, see `Axial`.

    Without a tilt the body stays upright, whatever the phase.
    """
    if tilt == 0:
        return pose_at_press(travel)
    rotation = _about_z(phase) @ _about_y(tilt) @ _about_z(-phase)
    centre = np.asarray(pivot, np.float64)
    return Pose(rotation, rotation @ (np.array([0.0, 0.0, travel]) - centre) + centre)


class Vertical(Movement):
    """Press, release, or strokes down and up, one after the other.

    Parameters
    ----------
    travel : array_like, (T,)
        Millimetres that the stage has been lowered in each frame.
    compliance : float
        Compliance of the stage, mm/N; needs elastic contact, which computes the force.

    Raises
    ------
    InputError
        The travel is empty or not finite; the compliance is negative.
    """

    motion: Motion = "vertical"
    presses = True
    _recorded_as = "travel"

    def __init__(self, travel: ArrayLike, *, compliance: float = 0.0) -> None:
        positions = check_strokes(travel, _count(travel), "travel")
        super().__init__(positions, "travel", positions.max(initial=-math.inf))
        if not (math.isfinite(compliance) and compliance >= 0):
            raise InputError(f"compliance {compliance} mm/N is not possible: give 0 or more")
        self.compliance = compliance

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose at a travel, mm."""
        return pose_at_press(float(place))

    def header(self) -> Header:
        """Return the motion; there is no constant press."""
        return Header(self.motion)


def oscillating_travel(start: float, stop: float, strokes: int, frames: int) -> Floats:
    """Return a travel that oscillates as a cosine, (frames,), mm.

    Examples
    --------
    >>> oscillating_travel(0.0, 1.0, 2, 5).round(3).tolist()
    [0.0, 0.5, 1.0, 0.5, 0.0]
    """
    oscillation = np.cos(np.pi * strokes * np.arange(frames) / max(1, frames - 1))
    return np.asarray(start + (stop - start) * (1 - oscillation) / 2)


class Axial(Movement):
    """Precession: the body's axis rotates on a cone of half-angle ``tilt``.

    At phase alpha the axis leans towards alpha + pi, and a vector x of the world is, in the body's frame ::

        x' = Rz(alpha) Ry(tilt) Rz(-alpha) x

    which is eq. 10 of the paper. The body rotates about ``pivot``, so the object moves in the picture.

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
        A value is invalid.
    """

    motion: Motion = "axial"
    _recorded_as = "phase"

    def __init__(
        self, phase: ArrayLike, tilt: float, press: float, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        super().__init__(check_phase(phase, _count(phase), "phase"), "phase", press)
        self.path: Floats = np.unwrap(self.positions)
        if not (math.isfinite(tilt) and 0 < tilt <= TILT_MAX):
            raise InputError(
                f"tilt {math.degrees(tilt):g} degrees is not possible: give more than 0 and at most"
                f" {math.degrees(TILT_MAX):g} degrees"
            )
        self.tilt: float = tilt
        self.steepest: float = tilt
        self.pivot: tuple[float, float, float] = _check_pivot(pivot)

    def reduced(self, path: Floats, /) -> Floats:
        """Remove whole turns, and rounding errors of the phase."""
        return _within_turn(path)

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose at a phase, radians: the body is tilted about its pivot."""
        return pose_at_lean(self.deepest, self.tilt, float(place), self.pivot)

    def header(self) -> Header:
        """Return motion, press, tilt and pivot."""
        return Header(self.motion, press=self.deepest, tilt=self.tilt, pivot=self.pivot)


class Leaning(Movement):
    """A lean of any phase and tilt and a travel for each frame; see `Axial`.

    A body that rocks has one phase, and a tilt that is negative on the other side.

    Parameters
    ----------
    phase, tilt : array_like, (T,)
        Radians; at most 30 degrees of tilt to either side.
    travel : float or array_like of (T,)
        Millimetres that the body is lowered, upright, before it tilts.
    pivot : (float, float, float)
        As for `Axial`.

    Raises
    ------
    InputError
        A value is invalid.
    """

    motion: Motion = "axial"

    def __init__(
        self,
        phase: ArrayLike,
        tilt: ArrayLike,
        travel: ArrayLike,
        pivot: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        alpha = check_phase(phase, _count(phase), "phase")
        try:
            lean, depth = (np.broadcast_to(np.asarray(v, np.float64), alpha.shape) for v in (tilt, travel))
        except ValueError:
            raise InputError(
                f"tilt and travel must be one number, or {len(alpha)} numbers like the phase"
            ) from None
        super().__init__(np.column_stack([alpha, lean, depth]), "pose", depth.max(initial=-math.inf))
        self.path: Floats = np.column_stack([np.unwrap(alpha), lean, depth])
        self.steepest: float = float(np.max(np.abs(lean)))
        if not self.steepest <= TILT_MAX:
            raise InputError(f"tilt is too large: the maximum is {math.degrees(TILT_MAX):g} degrees")
        self.presses: bool = bool(np.ptp(depth) > 0)
        self.pivot: tuple[float, float, float] = _check_pivot(pivot)

    def reduced(self, path: Floats, /) -> Floats:
        """Remove whole turns."""
        reduced = path.copy()
        reduced[..., 0] = _within_turn(path[..., 0])
        return reduced

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose for a phase and a tilt, radians, and a travel, mm."""
        phase, tilt, travel = map(float, place)
        return pose_at_lean(travel, tilt, phase, self.pivot)

    def header(self) -> Header:
        """Return motion, pivot, and the press if there is one."""
        return Header(self.motion, press=None if self.presses else self.deepest, pivot=self.pivot)

    def mark(self, block: Block, /) -> Block:
        """Add phases and tilts, and travels if they vary."""
        phase, tilt, travel = self.positions[block.index : block.index + len(block.frames)].T
        return replace(block, phase=phase, tilt=tilt, travel=travel if self.presses else None)


class Horizontal(Movement):
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
        A value is invalid.
    """

    motion: Motion = "horizontal"
    _recorded_as = "displacement"

    def __init__(self, displacement: ArrayLike, press: float) -> None:
        positions = np.asarray(displacement, np.float64)
        if positions.ndim != 2 or positions.shape[1] != 2:
            raise InputError(
                f"displacement of shape {positions.shape} is not possible: give x and y for each frame"
            )
        super().__init__(positions, "displacement", press)

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose for x and y of the body, mm: the object moves in the opposite direction."""
        return Pose(np.eye(3), np.array([-place[0], -place[1], self.deepest]))


class Twist(Movement):
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
        A value is invalid.
    """

    motion: Motion = "twist"
    _recorded_as = "twist"

    def __init__(self, twist: ArrayLike, press: float) -> None:
        positions = np.asarray(twist, np.float64)
        if positions.ndim != 1:
            raise InputError(
                f"twist of shape {positions.shape} is not possible: give one angle for each frame"
            )
        super().__init__(positions, "twist", press)

    def pose(self, place: Floats, /) -> Pose:
        """Return the pose for an angle of the body: the object turns in the opposite direction."""
        return Pose(_about_z(-float(place)), np.array([0.0, 0.0, self.deepest]))


def _check_pivot(pivot: tuple[float, float, float]) -> tuple[float, float, float]:
    if np.shape(pivot) != (3,) or not np.isfinite(pivot).all():
        raise InputError(f"pivot {pivot} is not possible: give x, y and z in mm")
    x, y, z = map(float, pivot)
    return x, y, z


def _within_turn(phase: Floats) -> Floats:
    """Remove whole turns, and rounding errors of a phase."""
    return np.asarray(2 * np.pi * (np.round(phase / (2 * np.pi) % 1, 12) % 1))


def _count(values: ArrayLike) -> int:
    shape = np.shape(values)
    return shape[0] if len(shape) == 1 else -1


def _about_y(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def _about_z(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
