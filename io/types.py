"""The types that every layer shares: frames on the move, where they come from, what comes out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Protocol, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Motion = Literal["vertical", "axial", "horizontal", "twist"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
FRAME_DTYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))

Floats = NDArray[np.float64]
ProcessValue = str | int | float | bool


class InputError(ValueError):
    """What the user gave cannot be used; the message is one line that says why and what to do."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Block:
    """Some consecutive frames, and where the sensor body was in each of them.

    Attributes
    ----------
    frames : ndarray, (n, H, W), uint8, uint16 or float32
        Raw counts; may be a view of a buffer that the next read overwrites.
    index : int
        Number of the first frame in its stack.
    time : ndarray, (n,), float64, or None
        Seconds since the recording began.
    travel : ndarray, (n,), float64, or None
        Millimetres that the body has been lowered (vertical motion, and axial where it presses as well).
    phase : ndarray, (n,), float64, or None
        Radians, counter-clockwise, of the precession (axial motion).
    displacement : ndarray, (n, 2), float64, or None
        Millimetres that the body has been moved along x and y (horizontal motion).
    twist : ndarray, (n,), float64, or None
        Radians that the body has been turned about its axis, counter-clockwise (twist).
    tilt : ndarray, (n,), float64, or None
        Half-angle of the lean, radians, where it differs from frame to frame (axial motion).
    origin : (int, int)
        Row and column of the first pixel in the full picture.
    dropped : int
        Frames lost between the block before and this one.
    lent : bool
        Whether the frames lie in memory of the source's own that nobody writes to as long as they are
        referred to, and that can be read 64 bytes beyond them, so that a device may work in it.
    """

    frames: NDArray[Any]
    index: int
    time: Floats | None = None
    travel: Floats | None = None
    phase: Floats | None = None
    displacement: Floats | None = None
    twist: Floats | None = None
    tilt: Floats | None = None
    origin: tuple[int, int] = (0, 0)
    dropped: int = 0
    lent: bool = False

    @property
    def pose(self) -> Floats | None:
        """The body's axis and travel in each frame, (n, 4): unit vectors, and mm, 0 where it is unknown.

        None without phases and tilts.
        """
        if self.phase is None or self.tilt is None:
            return None
        travel = np.zeros(len(self.phase)) if self.travel is None else self.travel
        return np.column_stack([body_axes(self.phase, self.tilt), travel])


@dataclass(frozen=True, slots=True)
class Header:
    """What holds for a whole stack: everything a recording says but its frames and their positions.

    Attributes
    ----------
    motion : {"vertical", "axial", "horizontal", "twist"}
    title, start_time : str
        Free text; ISO 8601.
    pixel_size : (float, float) or None
        Millimetres at the sheet along x and y.
    dark, bright : ndarray, (H, W), float32, or None
        Counts of each pixel without and with full light.
    press : float or None
        Millimetres of travel at which the other motions happen.
    tilt : float or None
        Half-angle of the precession, radians, if it is that of all frames.
    pivot : (float, float, float) or None
        Point that the body turns about, mm, from the rest sheet's centre, with the body pressed and upright.
    zenith_gain, zenith_offset : ndarray, scalar or (H, W), float64, or None
        Counts per radian of zenith, and counts at zenith zero.
    camera : str
        What the camera is called; empty where that is not told.
    """

    motion: Motion
    title: str = ""
    start_time: str = ""
    pixel_size: tuple[float, float] | None = None
    dark: NDArray[np.float32] | None = None
    bright: NDArray[np.float32] | None = None
    press: float | None = None
    tilt: float | None = None
    pivot: tuple[float, float, float] | None = None
    zenith_gain: Floats | None = None
    zenith_offset: Floats | None = None
    camera: str = ""


class Closing:
    """A context manager that closes itself when it is left."""

    def close(self) -> None:
        """Close what is open; by default there is nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.close()


def block_memory(out: NDArray[Any] | None, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return what a source reads into: ``out``, if frames of the stack fit into it, or room for one frame."""
    if out is None:
        return np.empty((1, *shape[1:]), dtype)
    if out.dtype != dtype or out.shape[1:] != shape[1:] or not len(out):
        raise ValueError(f"out is {out.shape} {out.dtype}; needed is (n, *{shape[1:]}) {dtype}")
    return out


class Source(Protocol):
    """Anything frames come from: a recording, a rig of camera and stage, the digital twin.

    A source is its own context manager; leaving it stops any hardware and closes any file.
    """

    @property
    def name(self) -> str:
        """What to call it in messages and in a result's provenance."""

    @property
    def header(self) -> Header:
        """What holds for all of its frames."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample: uint8, uint16 or float32."""

    @property
    def motion(self) -> Motion:
        """How the body moves."""

    @property
    def rewindable(self) -> bool:
        """Whether the frames can be read a second time."""

    def rewind(self) -> None:
        """Go back to the first frame."""

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames, at most ``len(out)`` of them into ``out``, or one; None at the end."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...


class LiveSource(Source, Protocol):
    """A source whose frames come while something happens: the first of ``shape`` is how many are expected.

    The positions in its blocks are those that were known when the frames came. A block's ``dropped`` counts
    the frames that were lost between the block before and this one.
    """

    def now(self) -> float:
        """Return the time, in seconds on the scale of ``Block.time``."""

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames read so far, as well as they are known by now.

        It can be asked after the source was left, too; NaN stands where nothing better is known than what
        the blocks said.

        Returns
        -------
        mapping
            ``travel``, mm, ``phase``, ``tilt`` or ``twist``, radians; one value a frame; or ``displacement``,
            mm, two a frame.
        """


@dataclass(frozen=True, slots=True)
class Truth:
    """What a simulation knows of its object, in the mean pose: pressed, upright, neither moved nor twisted.

    Attributes
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN where there is no object.
    zenith, azimuth : ndarray, (H, W), float32
        Radians, of the surface normal.
    contact : ndarray, (H, W), uint8
        1 where sheet and object touch: of a vertical motion at some time, of the others in every frame.
    slip : ndarray, (H, W), uint8, or None
        1 where the sheet slips on the object at some time; None where no friction was worked out.
    force : ndarray, (T, 3), float64, or None
        Newtons in each frame that the object exerts on the sensor: along the body's x and y, by friction, and
        normal, positive where it presses; None where no contact mechanics was worked out.
    displacement : ndarray, (T, H, W, 2), float32, or None
        Millimetres along the body's x and y by which the skin has moved in each frame since the press: that
        of the point of the skin that lay at the pixel then.
    slip_onset : ndarray, (H, W), float32, or None
        The way of the body since the press, mm or radians along its path, after which the point of the skin
        that lay at the pixel broke loose from the object; NaN where it stuck to the end or was not touched.
    """

    height: NDArray[np.float32]
    zenith: NDArray[np.float32]
    azimuth: NDArray[np.float32]
    contact: NDArray[np.uint8]
    slip: NDArray[np.uint8] | None = None
    force: Floats | None = None
    displacement: NDArray[np.float32] | None = None
    slip_onset: NDArray[np.float32] | None = None


UNDISTORTED = "undistorted"
"""What the process of a result says once its maps lie on the sheet, and no longer in the camera's pixels."""


def body_axes(phase: ArrayLike, tilt: ArrayLike) -> Floats:
    """Return the body's axis at phases and tilts, radians, as unit vectors towards the camera, (n, 3).

    At phase alpha it leans towards alpha + pi.

    Examples
    --------
    >>> body_axes([0.0], 0.1).round(3).tolist()
    [[-0.1, -0.0, 0.995]]
    """
    alpha, lean = np.broadcast_arrays(np.asarray(phase, np.float64), np.asarray(tilt, np.float64))
    return np.stack([-np.sin(lean) * np.cos(alpha), -np.sin(lean) * np.sin(alpha), np.cos(lean)], axis=-1)


def pixel_axes(shape: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[Floats, Floats]:
    """Place the pixel centres in millimetres from the picture's centre.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    pixel_size : (float, float)
        Millimetres along x and y.

    Returns
    -------
    x : ndarray, (W,), float64
        Increases to the right.
    y : ndarray, (H,), float64
        Runs up the picture: decreases with the row.

    Examples
    --------
    >>> pixel_axes((2, 3), (0.1, 0.2))
    (array([-0.1,  0. ,  0.1]), array([ 0.1, -0.1]))
    """
    rows, columns = shape
    x = (np.arange(columns) - (columns - 1) / 2) * pixel_size[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel_size[1]
    return np.asarray(x, np.float64), np.asarray(y, np.float64)
