"""Types shared by all layers: blocks of frames, their sources, and their properties."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Literal, Protocol, Self, get_args
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.properties import attributes_of, declared_in, stated

Motion = Literal["vertical", "axial", "horizontal", "twist"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
FRAME_DTYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))

Floats = NDArray[np.float64]
ProcessValue = str | int | float | bool


LEVELS = "bright", "zenith_gain", "zenith_offset"
"""Counts of a header that depend on the exposure."""


class InputError(ValueError):
    """Invalid input by the user; the message is one line with the problem and the remedy."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive frames, and the position of the sensor body in each of them.

    Attributes
    ----------
    frames : ndarray, (n, H, W), uint8, uint16 or float32
        Raw counts; may be a view of a buffer that the next read overwrites.
    index : int
        Number of the first frame in the stack.
    time : ndarray, (n,), float64, or None
        Seconds since the start of the recording.
    travel : ndarray, (n,), float64, or None
        Downward displacement of the body, mm (vertical motion, and axial if it also presses).
    phase : ndarray, (n,), float64, or None
        Phase of the precession, radians, counter-clockwise (axial motion).
    displacement : ndarray, (n, 2), float64, or None
        Displacement of the body along x and y, mm (horizontal motion).
    twist : ndarray, (n,), float64, or None
        Rotation of the body about its axis, radians, counter-clockwise (twist).
    tilt : ndarray, (n,), float64, or None
        Half-angle of the lean, radians, if it varies between frames (axial motion).
    axes : ndarray, (n, 3) or (n, 4), float64, or None
        The body's axis in each frame, unit vectors towards the camera, and its travel, mm, if these are given
        instead of phases and tilts.
    frame_weights : ndarray, (n,), float64, or None
        Weight of each frame, such as its inverse variance; 0 for a missing frame.
    origin : (int, int)
        Row and column of the first pixel in the full picture.
    dropped : int
        Frames lost between the preceding block and this one.
    lateness : float
        Seconds by which ``time`` is later than the exposures, such as the delay of a camera; 0 if unknown.
    stays_valid : bool
        Whether the memory of the frames belongs to the source, is not overwritten while it is referenced, and
        is readable for 64 bytes beyond the frames, so that a device can use it without a copy.
    """

    frames: NDArray[Any]
    index: int
    time: Floats | None = None
    travel: Floats | None = None
    phase: Floats | None = None
    displacement: Floats | None = None
    twist: Floats | None = None
    tilt: Floats | None = None
    axes: Floats | None = None
    frame_weights: Floats | None = None
    origin: tuple[int, int] = (0, 0)
    dropped: int = 0
    lateness: float = 0.0
    stays_valid: bool = False

    @property
    def pose(self) -> Floats | None:
        """The axis and travel of the body in each frame, (n, 4): unit vectors, and mm, 0 if unknown.

        It is None without axes, or phases and tilts.
        """
        if self.axes is not None:
            return self.axes
        if self.phase is None or self.tilt is None:
            return None
        travel = np.zeros(len(self.phase)) if self.travel is None else self.travel
        return np.column_stack([body_axes(self.phase, self.tilt), travel])


def _prior(of: str, default: float, text: str, unit: str = "", *, example: str, most: float = 1.0) -> Any:
    """Declare the standard deviation of something that frames may not show; see `Header.prior`."""
    return stated(
        of=of,
        unit=unit,
        text=f"standard deviation of {text}",
        use="what the frames do not show of it is in the standard deviations of maps",
        short=f"{unit}: standard deviation of {text}".removeprefix(": "),
        kind="standard deviation",
        within=(0.0, most),
        example=example,
        default=default,
    )


@dataclass(frozen=True, slots=True)
class Header:
    """Properties of a whole stack: everything in a recording but the frames and their positions.

    Attributes
    ----------
    motion : {"vertical", "axial", "horizontal", "twist"}
    title, start_time : str
        Free text; ISO 8601.
    pixel_size : (float, float) or None
        Millimetres at the sheet along x and y.
    dark, bright : ndarray, (H, W), float32, or None
        Counts of each pixel without light and with full light.
    press : float or None
        Travel of the press during other motions, mm.
    tilt : float or None
        Half-angle of the precession, radians, if it is the same for all frames.
    pivot : (float, float, float) or None
        Pivot of the body, mm, from the centre of the sheet at rest, with the body pressed and upright.
    zenith_gain, zenith_offset : ndarray, scalar or (H, W), float64, or None
        Counts per radian of zenith, and counts at zenith zero.
    camera : str
        Name of the camera; empty if unknown.
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
    travel_sigma: float | None = stated(
        of="stage",
        unit="mm",
        text="standard deviation of the travel of each frame, independent from frame to frame",
        use="it is added to the standard deviation of heights",
        short="mm: standard deviation of the travel of a frame",
        kind="standard deviation",
        within=(0.0, 1.0),
        example="0.002",
    )
    line_time: float | None = stated(
        of="camera",
        unit="s",
        text="from the exposure of a row to that of the next one, of a rolling shutter; negative if the last"
        " row is the first",
        use="heights of a press that moves are corrected for it",
        short="s from row to row of a rolling shutter; negative if the last is first",
        kind="time",
        within=(-0.01, 0.01),
        example="15e-6",
        in_steps=False,
    )
    exposure_ratio: float | None = stated(
        of="camera",
        unit="",
        text="exposure of the frames, relative to that for which a calibration holds; 1 if it is not stated",
        use="bright level and response of a calibration are multiplied by it, about the dark level",
        short="exposure, relative to that of the calibration",
        kind="number",
        within=(0.001, 1000.0),
        example="0.5",
    )
    gamma: float | None = stated(
        of="camera",
        unit="",
        text="power of the light that brightness follows, relative to full light; 1 if it is not stated",
        use="frames of a rotation are corrected for it",
        short="power of the light that brightness follows",
        kind="number",
        within=(0.2, 5.0),
        example="1.02",
        default=1.0,
    )
    gamma_sigma: float | None = _prior("camera", 0.02, "the camera's gamma about 1", example="0.005")
    frame_gain_sigma: float | None = _prior(
        "camera", 0.005, "the light of a frame, as a share of it", example="0.001"
    )
    drift_sigma: float | None = _prior(
        "camera", 0.005, "the change of the light over a recording, as a share of it", example="0.001"
    )
    lag_sigma: float | None = _prior(
        "camera", 0.01, "the share of a frame that the next one still shows", example="0.002"
    )
    pixel_gain_sigma: float | None = _prior(
        "camera", 0.01, "the gain of a pixel, as a share of it", example="0.005"
    )
    uneven_light_sigma: float | None = _prior(
        "camera", 0.02, "the light over the picture without references, as a share of it", example="0.01"
    )
    blur_sigma: float | None = _prior(
        "camera", 0.3, "the lens's blur, which is 0.3 pixels at best", "pixels", example="0.1", most=10.0
    )
    zenith_gain_sigma: float | None = _prior(
        "camera", 0.01, "the zenith gain, as a share of it", example="0.003"
    )
    zenith_offset_sigma: float | None = _prior(
        "camera", 0.5, "the zenith offset", "counts", example="0.1", most=1000.0
    )
    tilt_sigma: float | None = _prior("stage", 0.01, "the tilt, as a share of it", example="0.002")
    phase_sigma: float | None = _prior(
        "stage", 0.0052, "the phase that all frames have in common", "rad", example="0.001"
    )

    def exposed(self, ratio: float, names: Collection[str] = LEVELS) -> Header:
        """Return the header of the same light after another exposure: counts change about the dark level.

        Parameters
        ----------
        ratio : float
            Of the exposures.
        names : collection of str
            Which of ``bright``, ``zenith_gain`` and ``zenith_offset`` change.

        Examples
        --------
        >>> header = Header("axial", dark=np.full((1, 1), 10.0), zenith_offset=np.asarray(30.0))
        >>> float(header.exposed(0.5).zenith_offset)
        20.0
        """
        if ratio == 1:
            return self
        changed: dict[str, Any] = {}
        for name in set(LEVELS) & set(names):
            counts = getattr(self, name)
            if counts is not None:
                level: Any = 0.0
                if name != "zenith_gain" and self.dark is not None:
                    level = np.nanmean(self.dark, dtype=np.float64) if np.ndim(counts) == 0 else self.dark
                changed[name] = np.asarray(level + ratio * (counts - level), np.asarray(counts).dtype)
        return replace(self, **changed)

    def prior(self, name: str) -> float:
        """Return a stated number, or the default of a camera and a stage that nobody characterised.

        Examples
        --------
        >>> Header("axial").prior("gamma_sigma"), Header("axial", gamma_sigma=0.001).prior("gamma_sigma")
        (0.02, 0.001)
        """
        for value in (getattr(self, name), PROPERTIES[name].default):
            if value is not None:
                return float(value)
        raise KeyError(name)


PROPERTIES = declared_in(Header.__dataclass_fields__)
"""The declared numbers of a header; time and position of a frame refer to its middle row."""

Header.__doc__ = inspect.cleandoc(Header.__doc__ or "") + "\n" + attributes_of(PROPERTIES)


class Closing:
    """A context manager that closes itself on exit."""

    def close(self) -> None:
        """Release resources; by default there are none."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.close()


def block_memory(out: NDArray[Any] | None, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the array that a source reads into: ``out``, if it fits the stack, or memory for one frame."""
    if out is None:
        return np.empty((1, *shape[1:]), dtype)
    if out.dtype != dtype or out.shape[1:] != shape[1:] or not len(out):
        raise ValueError(f"out is {out.shape} {out.dtype}; needed is (n, {shape[1]}, {shape[2]}) {dtype}")
    return out


class Source(Protocol):
    """A source of frames: a recording, a rig of camera and stage, the digital twin.

    A source is its own context manager; leaving it stops hardware and closes files.
    """

    @property
    def name(self) -> str:
        """Name in messages and in the provenance of a result."""

    @property
    def header(self) -> Header:
        """Properties of all frames."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample: uint8, uint16 or float32."""

    @property
    def motion(self) -> Motion:
        """Motion of the body."""

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


_locks: WeakValueDictionary[int, Any] = WeakValueDictionary()  # of objects in use, by their id
_choosing = threading.Lock()


@contextmanager
def exclusive_use(used: object) -> Iterator[None]:
    """Let no other thread into such a context with the same object, or with a source that both read.

    A source has one position of reading. So that no two threads wait for each other, enter with one source
    at a time.
    """
    parts = _sources_in(used, {})
    with _choosing:
        locks = [_locks.setdefault(number, threading.RLock()) for number in sorted(parts)]
    with ExitStack() as held:
        for lock in locks:
            held.enter_context(lock)
        yield


def _sources_in(used: object, parts: dict[int, object]) -> dict[int, object]:
    """Add an object, and the sources that it reads, such as the recording behind a calibrated source."""
    parts[id(used)] = used
    for part in list(getattr(used, "__dict__", {}).values()):
        is_source = all(callable(getattr(part, name, None)) for name in ("read", "rewind"))
        if is_source and id(part) not in parts:
            _sources_in(part, parts)
    return parts


class LiveSource(Source, Protocol):
    """A source whose frames arrive in real time: the first of ``shape`` is the expected number of frames.

    The positions in its blocks are estimates at the arrival of the frames. ``dropped`` of a block counts the
    frames lost between the preceding block and this one.
    """

    def now(self) -> float:
        """Return the time, in seconds on the scale of ``Block.time``."""

    def positions(self) -> Mapping[str, Floats]:
        """Return the best estimate of the positions of all frames read so far.

        It can also be called after the source was closed. NaN marks frames without a better estimate than in
        the blocks.

        Returns
        -------
        mapping
            ``travel``, mm, ``phase``, ``tilt`` or ``twist``, radians; one value per frame; or
            ``displacement``, mm, two per frame.
        """


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a simulation in the mean pose: pressed, upright, neither displaced nor twisted.

    Attributes
    ----------
    height : ndarray, (H, W), float32
        Millimetres; NaN where there is no object.
    zenith, azimuth : ndarray, (H, W), float32
        Radians, of the surface normal.
    contact : ndarray, (H, W), uint8
        1 where sheet and object touch: in some frame of a vertical motion, in every frame of the others.
    slip : ndarray, (H, W), uint8, or None
        1 where the sheet slips on the object at some time; None if friction was not simulated.
    force : ndarray, (T, 3), float64, or None
        Newtons in each frame that the object exerts on the sensor: along the body's x and y, by friction, and
        normal, positive in compression; None if contact mechanics was not simulated.
    displacement : ndarray, (T, H, W, 2), float32, or None
        Displacement in mm along the body's x and y, in each frame since the press, of the point of the skin
        that was at the pixel after the press.
    slip_onset : ndarray, (H, W), float32, or None
        Distance travelled by the body since the press, mm or radians along its path, at which the point of
        the skin at the pixel starts to slip; NaN where it sticks to the end or was not touched.
    """

    height: NDArray[np.float32]
    zenith: NDArray[np.float32]
    azimuth: NDArray[np.float32]
    contact: NDArray[np.uint8]
    slip: NDArray[np.uint8] | None = None
    force: Floats | None = None
    displacement: NDArray[np.float32] | None = None
    slip_onset: NDArray[np.float32] | None = None


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
    """Return the positions of pixel centres in mm from the picture's centre.

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
        Points up the picture: decreases with the row.

    Examples
    --------
    >>> pixel_axes((2, 3), (0.1, 0.2))
    (array([-0.1,  0. ,  0.1]), array([ 0.1, -0.1]))
    """
    rows, columns = shape
    x = (np.arange(columns) - (columns - 1) / 2) * pixel_size[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel_size[1]
    return np.asarray(x, np.float64), np.asarray(y, np.float64)


PIXEL = "px"
"""Unit of lengths where the pixel size is unknown."""


def axes_with_unit(
    shape: tuple[int, int], pixel_size: tuple[float, float] | None
) -> tuple[Floats, Floats, str]:
    """Return the positions of pixel centres from the picture's centre, and their unit: mm, or pixels.

    Examples
    --------
    >>> axes_with_unit((1, 3), None)
    (array([-1.,  0.,  1.]), array([0.]), 'px')
    """
    return *pixel_axes(shape, pixel_size or (1.0, 1.0)), PIXEL if pixel_size is None else "mm"
