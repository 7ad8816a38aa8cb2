"""The types that every layer shares: frames on the move, where they come from, what comes out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from mirrorskin.io.calibration.types import Calibration

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


class Shown:
    """Maps that show themselves: as text, in a notebook, and as figures."""

    __slots__ = ()

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return the maps that there are, by name."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}  # type: ignore[arg-type]
        return {name: one for name, one in values.items() if isinstance(one, np.ndarray) and one.ndim > 1}

    def numbers(self) -> dict[str, float]:
        """Return the single numbers that there are, by name."""
        return {}

    def plot(self, name: str | None = None, axes: Axes | None = None) -> Axes:
        """Draw a map with its scale, in millimetres where the pixels' places are known.

        Parameters
        ----------
        name : str, optional
            Of the map; by default the height, or what there is instead.
        axes : matplotlib.axes.Axes, optional
            Where to draw; by default in a new figure.

        Raises
        ------
        InputError
            There is no such map, or it is no picture: vectors, or several turns.
        ImportError
            Matplotlib is not installed: ``pip install 'mirrorskin[view]'``.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> result.plot("height").get_xlabel()
        'x [mm]'
        """
        from mirrorskin.io.notebook import plot

        return plot(self, name, axes)

    def __repr__(self) -> str:
        from mirrorskin.io.notebook import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        from mirrorskin.io.notebook import as_html

        return as_html(self)


@dataclass(frozen=True, slots=True, repr=False)
class Result(Shown):
    """The maps of a reconstruction; one that was not computed is None.

    Of a result for each turn of a rotation all maps have a leading axis, (turns, H, W) and (turns, H, W, 3);
    components are numbered through all turns.

    Attributes
    ----------
    height, height_sigma : ndarray, (H, W), float32
        Millimetres, and the standard deviation that is expected of the height; NaN where there is no answer.
    status : ndarray, (H, W), uint8
        0 invalid input, 1 onset, 2 never light, 3 light at start; of a release: 0 invalid input, 1 release,
        2 dark at start, 3 light to the end. Of a body with a tilt of each frame: 1 normal, 2 none, 4 only the
        slope along one direction. Of a slide or a twist: 0 unknown, 1 slipped, 2 sticks, 3 no contact, 4 no
        texture. Of a focus stack: 0 invalid input, 1 in focus, 2 no peak, 3 peak at an end of the stack.
    hysteresis, hysteresis_sigma : ndarray, (H, W), float32
        Millimetres by which the release is higher than the onset, and the standard deviation of that.
    strokes : ndarray, (H, W), uint16
        In how many strokes of an oscillating press there was what the height is made of.
    growth, growth_sigma : ndarray, (H, W), float32
        Share of full light that a pixel gains for each mm of travel of a dithering press, 1/mm, and the
        standard deviation.
    slope, slope_sigma : ndarray, (H, W), float32
        Millimetres that the surface rises for each along the direction of rocking, ``slope_direction`` in the
        process, and the standard deviation.
    normals : ndarray, (H, W, 3), float32
        Unit vectors along x, y and z in the mean pose; NaN where there is no answer.
    zenith, azimuth : ndarray, (H, W), float32
        Radians, of the normal; NaN where there is no answer.
    normal_sigma : ndarray, (H, W), float32
        Radians: the RMS angular error that is expected of the normal.
    mean, cosine, sine, modulation, residual : ndarray, (H, W), float32
        Counts, of the fit of mean + cosine cos(phase) + sine sin(phase) to a pixel's brightness: the
        modulation is its amplitude, the residual the standard deviation that is left.
    edges : ndarray, (H, W), uint8
        1 on thin lines where the normal jumps or contact ends.
    filled : ndarray, (H, W), uint8
        1 where the height was not measured but filled from those around.
    contact : ndarray, (H, W), uint8
        1 where the sheet was in contact in every frame; of a slide or a twist in the first.
    component : ndarray, (H, W), int32
        Number of the connected piece that a height belongs to, from 0; -1 where there is no height.
    offset_unknown : ndarray, (components,), uint8
        1 of a component whose heights are relative: no absolute one is known in it, and their mean is 0.
    slope_min, slope_max : ndarray, (H, W), float32
        Radians: bounds of the sheet's zenith, by a wall with levels; NaN where there is none.
    pressure : ndarray, (H, W), float32
        MPa between sensor and object at the greatest travel; 0 where nothing touches.
    displacement : ndarray, (H, W, 2) or (T, H, W, 2), float32
        Millimetres along x and y that the skin has moved in the picture since the first frame of a slide or a
        twist, in the last frame or in each: of the point that was seen at the pixel first.
    displacement_sigma : ndarray, (H, W), float32
        Millimetres: standard deviation of the displacement along either axis, the root of their mean square.
    slip_onset, slip_onset_sigma : ndarray, (H, W), float32
        The way of the body, mm or (of a twist) radians, after which the skin broke loose, and the standard
        deviation; NaN where it did not.
    way, stick_ratio : ndarray, (T,), float64
        How far the body has slid or turned, mm or radians, and the share of the contact that sticks, in each
        frame; NaN from where the body turns back.
    traction : ndarray, (H, W, 2), float32
        MPa along x and y that the object exerts on the sensor at the end of a slide or a twist; 0 outside the
        contact.
    force_x, force_x_sigma, force_y, force_y_sigma : float
        Newtons along the sheet that the object exerts on the sensor then, and the standard deviations that
        are expected.
    force, force_sigma : float
        Newtons at the greatest travel, normal to the sheet, and the standard deviation that is expected.
    x, y : ndarray, (W,) and (H,), float64
        Millimetres of the pixel centres from the picture's centre; y runs up the picture.
    own_maps : mapping of ndarray, (H, W)
        Those of a user's own estimator, by names that are none of the above; see `mirrorskin.engine.run`.
    process : mapping
        Program, version, date, every parameter, device, source and its hash.
    calibration : Calibration or None
        That with which it was made, of the camera's whole picture.
    """

    height: NDArray[np.float32] | None = None
    height_sigma: NDArray[np.float32] | None = None
    status: NDArray[np.uint8] | None = None
    hysteresis: NDArray[np.float32] | None = None
    hysteresis_sigma: NDArray[np.float32] | None = None
    strokes: NDArray[np.uint16] | None = None
    growth: NDArray[np.float32] | None = None
    growth_sigma: NDArray[np.float32] | None = None
    slope: NDArray[np.float32] | None = None
    slope_sigma: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    zenith: NDArray[np.float32] | None = None
    azimuth: NDArray[np.float32] | None = None
    normal_sigma: NDArray[np.float32] | None = None
    mean: NDArray[np.float32] | None = None
    cosine: NDArray[np.float32] | None = None
    sine: NDArray[np.float32] | None = None
    modulation: NDArray[np.float32] | None = None
    residual: NDArray[np.float32] | None = None
    edges: NDArray[np.uint8] | None = None
    filled: NDArray[np.uint8] | None = None
    contact: NDArray[np.uint8] | None = None
    component: NDArray[np.int32] | None = None
    offset_unknown: NDArray[np.uint8] | None = None
    slope_min: NDArray[np.float32] | None = None
    slope_max: NDArray[np.float32] | None = None
    pressure: NDArray[np.float32] | None = None
    displacement: NDArray[np.float32] | None = None
    displacement_sigma: NDArray[np.float32] | None = None
    slip_onset: NDArray[np.float32] | None = None
    slip_onset_sigma: NDArray[np.float32] | None = None
    traction: NDArray[np.float32] | None = None
    way: Floats | None = None
    stick_ratio: Floats | None = None
    force: float | None = None
    force_sigma: float | None = None
    force_x: float | None = None
    force_x_sigma: float | None = None
    force_y: float | None = None
    force_y_sigma: float | None = None
    x: Floats | None = None
    y: Floats | None = None
    own_maps: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    process: Mapping[str, ProcessValue] = field(default_factory=dict)
    calibration: Calibration | None = None

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return the maps that were computed, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in NO_MAPS}
        return {name: value for name, value in values.items() if value is not None} | {**self.own_maps}

    def numbers(self) -> dict[str, float]:
        """Return the single numbers that were computed, by name."""
        values = {name: getattr(self, name) for name in SCALARS}
        return {name: value for name, value in values.items() if value is not None}

    def series(self) -> dict[str, Floats]:
        """Return what was computed frame by frame, by name."""
        values = {name: getattr(self, name) for name in SERIES}
        return {name: value for name, value in values.items() if value is not None}

    def to_xarray(self) -> xarray.Dataset:
        """Return the maps as an `xarray.Dataset`: coordinates ``x`` and ``y`` in mm, units as attributes.

        Standard deviations stand beside the values as variables of their own (``height_sigma``,
        ``normal_sigma``); the process becomes the dataset's attributes. It needs the package xarray:
        ``pip install 'mirrorskin[xarray]'``.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> float(result.to_xarray().height.sel(x=1, y=0))
        0.0
        """
        from mirrorskin.io.notebook import as_xarray

        return as_xarray(self)

    @classmethod
    def from_xarray(cls, dataset: xarray.Dataset) -> Result:
        """Return the result that a dataset was made of by ``to_xarray``, without its calibration.

        Variables that results do not know become ``own_maps``.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> Result.from_xarray(result.to_xarray()).height.shape
        (2, 3)
        """
        known = {one.name for one in fields(cls)}
        arrays: dict[str, Any] = {str(name): one.to_numpy() for name, one in dataset.variables.items()}
        own = {name: arrays[name] for name in map(str, dataset.data_vars) if name not in known}
        values: dict[str, Any] = {
            name: float(one) if name in SCALARS else one for name, one in arrays.items() if name in known
        }
        process = {str(name): one for name, one in dataset.attrs.items()}
        return cls(**values, own_maps=own, process=process)


SCALARS = ("force", "force_sigma", "force_x", "force_x_sigma", "force_y", "force_y_sigma")
"""The single numbers that a result has."""

SERIES = ("way", "stick_ratio")
"""What a result has of each frame."""

NO_MAPS = ("offset_unknown", *SCALARS, *SERIES, "x", "y", "own_maps", "process", "calibration")
"""What a result has besides maps."""

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
