"""How a field of a part of a calibration is kept in a file: told where the field is, read by the layout.

The last functions return the metadata of a dataclass's field, as in ``field(metadata=number("mm"))``. A field
with a default may be missing from a file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.types import Floats, ProcessValue

Kind = Literal["array", "number", "integer", "numbers", "integers", "text", "names", "mapping"]
Size = int | str
Check = Callable[[Any], bool]
_STORED = "stored"
_DOUBLE = np.dtype(np.float64)


@dataclass(frozen=True, slots=True)
class Stored:
    """How one field is kept.

    Attributes
    ----------
    kind : str
        "array": a NumPy array; "number", "integer", "text": one; "numbers", "integers": a tuple of them;
        "names": a tuple of texts; "mapping": numbers by names, in a group of their own.
    unit : str or None
        The attribute ``units``; None of values without one, or of several with different ones.
    shape : tuple of int and str
        Of an array or tuple. A letter is a size that the fields of one part share; "rows" and "columns" are
        the camera's.
    dtype : dtype
        Of an array.
    valid : callable or None
        Tells whether a value can be one.
    place : bool
        Whether the first two numbers are a place on the sheet, told from the picture's centre.
    """

    kind: Kind
    unit: str | None = None
    shape: tuple[Size, ...] = ()
    dtype: np.dtype[Any] = _DOUBLE
    valid: Check | None = None
    place: bool = False

    @property
    def is_map(self) -> bool:
        """Whether there is one value a pixel of the camera, which is cut with the picture."""
        return self.shape[:2] == ("rows", "columns")


def stored(part: Any) -> dict[str, Stored]:
    """Return how the fields of a part are kept, by their names; ``part`` is one, or its class."""
    return {one.name: one.metadata[_STORED] for one in fields(part)}


def optional(part: Any) -> set[str]:
    """Name the fields that a file need not have."""
    return {
        one.name for one in fields(part) if one.default is not MISSING or one.default_factory is not MISSING
    }


def unit_of(name: str, how: Mapping[str, Stored]) -> str | None:
    """Return the unit of what is told by a field's name, or by that with ``_x``, ``_y`` or ``_z``."""
    one = how.get(name) or how.get(name.rpartition("_")[0])
    return None if one is None else one.unit


def pixels(dtype: DTypeLike, unit: str | None = None) -> Mapping[str, Stored]:
    """Declare a map: one value a pixel of the camera."""
    return {_STORED: Stored("array", unit, ("rows", "columns"), np.dtype(dtype))}


def array(*shape: Size, unit: str | None = None) -> Mapping[str, Stored]:
    """Declare an array of float64 that has nothing to do with the camera's pixels."""
    return {_STORED: Stored("array", unit, shape)}


def number(unit: str | None = None, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare one float."""
    return {_STORED: Stored("number", unit, valid=valid)}


def integer(valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare one int."""
    return {_STORED: Stored("integer", valid=valid)}


def numbers(count: Size, unit: str | None = None, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a tuple of floats."""
    return {_STORED: Stored("numbers", unit, (count,), valid=valid)}


def place(count: int) -> Mapping[str, Stored]:
    """Declare a tuple of floats, x and y or more, mm from the picture's centre."""
    return {_STORED: Stored("numbers", "mm", (count,), place=True)}


def integers(count: Size, valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a tuple of ints."""
    return {_STORED: Stored("integers", None, (count,), valid=valid)}


def text(valid: Check | None = None) -> Mapping[str, Stored]:
    """Declare a text."""
    return {_STORED: Stored("text", valid=valid)}


def names(count: Size) -> Mapping[str, Stored]:
    """Declare a tuple of texts."""
    return {_STORED: Stored("names", None, (count,))}


def mapping() -> Mapping[str, Stored]:
    """Declare floats by names; each has the unit that ``unit_of`` tells."""
    return {_STORED: Stored("mapping")}


HOT, DEAD, SATURATED = 1, 2, 4
BITS = {"hot": HOT, "dead": DEAD, "saturated": SATURATED}
"""The bits of ``References.defects``, and what they are called."""

PATTERNS = ("graded", "uniform")


def _above_zero(values: tuple[float, ...]) -> bool:
    return all(0 < value < math.inf for value in values)


@dataclass(frozen=True, slots=True, eq=False)
class CameraId:
    """Which camera a calibration is of.

    Attributes
    ----------
    name : str
        As the rig file calls it; empty where that is not told.
    shape : (int, int)
        Rows and columns of its full picture.
    dtype : dtype
        Type of a sample: uint8, uint16 or float32.
    """

    name: str
    shape: tuple[int, int]
    dtype: np.dtype[Any]

    def __str__(self) -> str:
        rows, columns = self.shape
        called = f"{self.name!r}, " if self.name else ""
        return f"{called}{columns} x {rows}, {np.dtype(self.dtype).name}"


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """What each pixel counts without and with full light.

    Attributes
    ----------
    dark, bright : ndarray, (H, W), float32
        Counts; NaN at defects.
    dark_sigma, bright_sigma : ndarray, (H, W), float32
        Counts: the standard errors of the two means.
    defects : ndarray, (H, W), uint8
        0 of a sound pixel, else a sum of 1 hot, 2 dead, 4 saturated.
    """

    dark: NDArray[np.float32] = field(metadata=pixels(np.float32, "counts"))
    bright: NDArray[np.float32] = field(metadata=pixels(np.float32, "counts"))
    dark_sigma: NDArray[np.float32] = field(metadata=pixels(np.float32, "counts"))
    bright_sigma: NDArray[np.float32] = field(metadata=pixels(np.float32, "counts"))
    defects: NDArray[np.uint8] = field(metadata=pixels(np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Where on the sheet the pixels look.

    The undistorted map has as many pixels as the picture, all of one size; its centre and that of the picture
    see the same point of the sheet. See ``mirrorskin.engine.undistort``.

    Attributes
    ----------
    pixel_size : (float, float)
        Millimetres along x and y of a pixel of the undistorted map.
    camera : ndarray, (3, 3), float64
        Homography from a pixel (column, row, 1) of a picture without distortion to millimetres on the sheet,
        (x, y, 1); (0, 0) is in the middle of the undistorted map. It holds the perspective.
    distortion : ndarray, (5,), float64
        Coefficients k1, k2, p1, p2, k3 of OpenCV.
    matrix : ndarray, (3, 3), float64
        The pinhole camera that goes with them, in pixels of the picture.
    shape : (int, int)
        Rows and columns of the undistorted map, and of the full picture.
    error : float
        RMS distance of the marks that were found from where the fit has them, pixels.
    scale_sigma : float
        Standard error of the pixel size, as a share of it.
    """

    pixel_size: tuple[float, float] = field(metadata=numbers(2, "mm", valid=_above_zero))
    camera: Floats = field(metadata=array(3, 3))
    distortion: Floats = field(metadata=array(5))
    matrix: Floats = field(metadata=array(3, 3))
    shape: tuple[int, int] = field(metadata=integers(2, valid=_above_zero))
    error: float = field(metadata=number("pixel"))
    scale_sigma: float = field(default=math.nan, metadata=number())


@dataclass(frozen=True, slots=True, eq=False)
class WallResponse:
    """How bright a mirror under a cylindrical wall looks, by its normal and its place.

    A pixel looks at (x, y) on the rest plane; X = x - x0, Y = y - y0. Its light is
    (E - dark) / ((bright - dark) V) with
    V = 1 + s0 X/R + s1 Y/R + s2 (X/R)^2 + s3 XY/R^2 + s4 (Y/R)^2. ``kernels/response.py`` tells the light of
    a normal.

    Attributes
    ----------
    radius, rim : float
        Radius R and height H of the wall, mm.
    axis : (float, float)
        Place (x0, y0) of its axis, mm.
    sight : (float, float)
        k0, 1/mm, and k2, 1/mm^3: the line of sight rises along
        (-(k0 + k2 r^2) X, -(k0 + k2 r^2) Y, 1), r^2 = X^2 + Y^2.
    lamps : (float, float)
        By which share the wall is brighter towards x and y.
    scatter : float
        Half-angle by which the sheet scatters, radians.
    curve : ndarray, (n,), float64
        Coefficients of the light as a polynomial in q, the lowest first.
    reach : (float, float)
        The q from and up to which that holds.
    shade : ndarray, (5,), float64
        s0 to s4, the shading of the picture.
    pattern : {"graded", "uniform"}
        Whether the wall tells angles, or only a threshold.
    zenith_sigma, azimuth_sigma : ndarray, (H, W), float32
        Radians: standard deviations of what the response says of zenith, and of azimuth times sin(zenith).
    parameters : tuple of str
        What was fitted.
    covariance : ndarray, (P, P), float64
        Of the parameters, in their units.
    error : float
        Upper end, by one standard error, of what is left of the zenith on the balls, radians RMS.
    """

    radius: float = field(metadata=number("mm", valid=lambda value: 0 < value < math.inf))
    rim: float = field(metadata=number("mm", valid=lambda value: 0 < value < math.inf))
    axis: tuple[float, float] = field(metadata=place(2))
    sight: tuple[float, float] = field(metadata=numbers(2))
    lamps: tuple[float, float] = field(metadata=numbers(2))
    scatter: float = field(metadata=number("rad"))
    curve: Floats = field(metadata=array("n"))
    reach: tuple[float, float] = field(metadata=numbers(2))
    shade: Floats = field(metadata=array(5))
    pattern: str = field(metadata=text(valid=lambda value: value in PATTERNS))
    zenith_sigma: NDArray[np.float32] = field(metadata=pixels(np.float32, "rad"))
    azimuth_sigma: NDArray[np.float32] = field(metadata=pixels(np.float32, "rad"))
    parameters: tuple[str, ...] = field(metadata=names("p"))
    covariance: Floats = field(metadata=array("p", "p"))
    error: float = field(metadata=number("rad"))


@dataclass(frozen=True, slots=True, eq=False)
class Precession:
    """How the body's axis goes round while the phase does.

    Attributes
    ----------
    tilt : float
        Mean half-angle of the cone, radians.
    phase_offset : float
        Azimuth of the lean at phase zero, radians.
    direction : {1, -1}
        Whether it goes round as the phase does, counter-clockwise, or the other way.
    ellipticity : float
        (a - b) / (a + b) of the greatest and the least half-angle.
    major_axis : float
        Azimuth of the greatest, radians.
    centre : (float, float)
        The mean lean, radians along x and y.
    pivot : (float, float, float)
        What the body turns about, mm.
    sigma : mapping of str to float
        Standard errors, by the names of the fields; ``centre_x``, ``pivot_z`` and so on of several numbers.
    """

    tilt: float = field(metadata=number("rad", valid=lambda value: value > 0))
    phase_offset: float = field(metadata=number("rad"))
    direction: int = field(metadata=integer(valid=lambda value: value in (1, -1)))
    ellipticity: float = field(metadata=number())
    major_axis: float = field(metadata=number("rad"))
    centre: tuple[float, float] = field(metadata=numbers(2, "rad"))
    pivot: tuple[float, float, float] = field(metadata=place(3))
    sigma: Mapping[str, float] = field(default_factory=dict, metadata=mapping())

    def lean(self, phase: Floats) -> Floats:
        """Return how the body leans.

        Parameters
        ----------
        phase : ndarray, (n,), float64
            Radians, as the recording tells them.

        Returns
        -------
        ndarray, (n, 2), float64
            The lean vector l, radians along x and y: the body's axis is (-sin|l| l / |l|, cos|l|).
        """
        along, across = self._ellipse(phase)
        cosine, sine = math.cos(self.major_axis), math.sin(self.major_axis)
        x, y = self.centre
        lean = [x + along * cosine - across * sine, y + along * sine + across * cosine]
        return np.asarray(np.stack(lean, axis=-1), np.float64)

    def phase(self, phase: Floats) -> Floats:
        """Return the azimuth at which the body leans from its mean, radians; it runs on where the phase does.

        Parameters
        ----------
        phase : ndarray, (n,), float64
            Radians, as the recording tells them.
        """
        even = self._angle(phase)
        along, across = self._ellipse(phase)
        ahead = self.major_axis + np.arctan2(across, along) - even
        return np.asarray(even + np.remainder(ahead + math.pi, math.tau) - math.pi, np.float64)

    def _angle(self, phase: Floats) -> Floats:
        """Return the azimuth on the circle of which the ellipse is made."""
        return self.direction * np.asarray(phase, np.float64) + self.phase_offset

    def _ellipse(self, phase: Floats) -> tuple[Floats, Floats]:
        """Return the lean from the mean, along the major axis and across it."""
        angle = self._angle(phase) - self.major_axis
        along = self.tilt * (1 + self.ellipticity) * np.cos(angle)
        return along, self.tilt * (1 - self.ellipticity) * np.sin(angle)


@dataclass(frozen=True, slots=True, eq=False)
class Gel:
    """How the sheet gives way around what it touches, and when that turns it light.

    A pixel is taken for light where the sheet's zenith passes the one that shows the rim of a round lit wall
    (see `threshold_at` of `mirrorskin.engine.press.elastic`).

    Attributes
    ----------
    threshold : float
        Zenith, radians, at which a pixel on the wall's axis turns light.
    curvature : float
        1 / radius of the wall, 1/mm: how much sooner pixels nearer to it turn light; 0 for the same zenith
        everywhere.
    axis : (float, float)
        Where the wall's axis meets the picture, mm.
    compliance : float
        Millimetres that the stage gives way by, for each N / (N/mm^2): its flexure times the gel's modulus,
        1/mm.
    travel_zero : float
        Travel at which the sheet met the ball that it was learned from, mm: a check of the stage, not used.
    error : float
        RMS height left on what it was learned from, mm.
    sigma : mapping of str to float
        Standard errors, by the names of the fields.
    """

    threshold: float = field(metadata=number("rad", lambda value: 0 < value < math.pi / 4))
    compliance: float = field(metadata=number("1/mm", lambda value: value >= 0))
    curvature: float = field(default=0.0, metadata=number("1/mm", lambda value: value >= 0))
    axis: tuple[float, float] = field(default=(0.0, 0.0), metadata=place(2))
    travel_zero: float = field(default=0.0, metadata=number("mm"))
    error: float = field(default=0.0, metadata=number("mm", lambda value: value >= 0))
    sigma: Mapping[str, float] = field(default_factory=dict, metadata=mapping())


Part = References | Lens | WallResponse | Precession | Gel


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What is known of a sensor; a part that was not found out is None.

    Attributes
    ----------
    camera : CameraId
    references : References or None
    lens : Lens or None
    zenith : WallResponse or None
    precession : Precession or None
    gel : Gel or None
    process : mapping
        How each part came about: "references.program", "zenith.sources" and so on, by the names of the
        commands: references, scale, zenith, tilt, elastic.
    name : str
        The file that it was read from, for messages.
    """

    camera: CameraId
    references: References | None = None
    lens: Lens | None = None
    zenith: WallResponse | None = None
    precession: Precession | None = None
    gel: Gel | None = None
    process: Mapping[str, ProcessValue] = field(default_factory=dict)
    name: str = ""

    def parts(self) -> dict[str, Part]:
        """Return the parts that there are, by the names of the attributes."""
        found = {name: getattr(self, name) for name in GROUPS}
        return {name: part for name, part in found.items() if part is not None}

    @property
    def contents(self) -> str:
        """The parts that there are, in a line, by the names of the commands that find them out."""
        return ", ".join(GROUPS[name] for name in self.parts()) or "nothing"


GROUPS = {
    "references": "references",
    "lens": "scale",
    "zenith": "zenith",
    "precession": "tilt",
    "gel": "elastic",
}
"""The parts, and what their groups in a file and the commands that find them out are called."""

KINDS: dict[str, type[Part]] = {
    "references": References,
    "lens": Lens,
    "zenith": WallResponse,
    "precession": Precession,
    "gel": Gel,
}
