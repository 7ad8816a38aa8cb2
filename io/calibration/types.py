"""What a calibration holds: the camera it is of, and its parts, each field with how a file keeps it.

Coordinates are those of a result: x to the right and y up, mm from the picture's centre; z up to the camera
from the sheet's rest plane, in the frame of the body. To add a field, declare it with `kept`, and give it a
default if older files are to be read still: a field with a default may be missing from a file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.types import Floats, ProcessValue

Kind = Literal["map", "array", "number", "integer", "numbers", "integers", "text", "names", "mapping"]


@dataclass(frozen=True, slots=True)
class Stored:
    """How one field is kept in a file.

    A "map" has one value a pixel of the camera, and is cut with the picture. "numbers", "integers" and
    "names" are tuples. A "mapping" is of numbers by names, in a group of its own; each has the unit that
    `unit_of` gives. Letters in ``shape`` are sizes that the fields of one part share. The first two numbers
    of a ``place`` are relative to the picture's centre.
    """

    kind: Kind
    unit: str | None = None
    shape: tuple[int | str, ...] = ()
    dtype: np.dtype[Any] = np.dtype(np.float64)  # noqa: RUF009
    valid: Callable[[Any], bool] | None = None
    place: bool = False


def kept(
    kind: Kind,
    unit: str | None = None,
    *,
    shape: tuple[int | str, ...] = (),
    dtype: DTypeLike = np.float64,
    valid: Callable[[Any], bool] | None = None,
    place: bool = False,
) -> Mapping[str, Stored]:
    """Return the metadata of a dataclass's field, as in ``field(metadata=kept("number", "mm"))``."""
    shape = ("rows", "columns") if kind == "map" else shape
    return {"stored": Stored(kind, unit, shape, np.dtype(dtype), valid, place)}


def stored(part: Any) -> dict[str, Stored]:
    """Return how the fields of a part, or of its class, are kept, by their names."""
    return {one.name: one.metadata["stored"] for one in fields(part)}


def unit_of(name: str, how: Mapping[str, Stored]) -> str | None:
    """Return the unit of a field by its name, or by that with ``_x``, ``_y`` or ``_z``."""
    one = how.get(name) or how.get(name.rpartition("_")[0])
    return None if one is None else one.unit


HOT, DEAD, SATURATED = 1, 2, 4
BITS = {"hot": HOT, "dead": DEAD, "saturated": SATURATED}
"""The bits of ``References.defects``, and what they are called."""

PATTERNS = ("graded", "uniform")


def _above_zero(values: float | tuple[float, ...]) -> bool:
    return all(0 < value < math.inf for value in np.ravel(values))


@dataclass(frozen=True, slots=True, eq=False)
class CameraId:
    """Which camera a calibration is of.

    Attributes
    ----------
    name : str
        As the rig file calls it; empty where unknown.
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

    dark: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    bright: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    dark_sigma: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    bright_sigma: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    defects: NDArray[np.uint8] = field(metadata=kept("map", dtype=np.uint8))


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

    pixel_size: tuple[float, float] = field(metadata=kept("numbers", "mm", shape=(2,), valid=_above_zero))
    camera: Floats = field(metadata=kept("array", shape=(3, 3)))
    distortion: Floats = field(metadata=kept("array", shape=(5,)))
    matrix: Floats = field(metadata=kept("array", shape=(3, 3)))
    shape: tuple[int, int] = field(metadata=kept("integers", shape=(2,), valid=_above_zero))
    error: float = field(metadata=kept("number", "pixel"))
    scale_sigma: float = field(default=math.nan, metadata=kept("number"))


@dataclass(frozen=True, slots=True, eq=False)
class WallResponse:
    """How bright a mirror under a cylindrical wall looks, by its normal and its place.

    A pixel looks at (x, y) on the rest plane; X = x - x0, Y = y - y0. Its light is
    (E - dark) / ((bright - dark) V) with
    V = 1 + s0 X/R + s1 Y/R + s2 (X/R)^2 + s3 XY/R^2 + s4 (Y/R)^2. ``kernels/response.py`` gives the light
    of a normal.

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
        Whether the wall gives angles, or only a threshold.
    zenith_sigma, azimuth_sigma : ndarray, (H, W), float32
        Radians: standard deviations of what the response says of zenith, and of azimuth times sin(zenith).
    parameters : tuple of str
        What was fitted.
    covariance : ndarray, (P, P), float64
        Of the parameters, in their units.
    error : float
        Upper end, by one standard error, of what is left of the zenith on the balls, radians RMS.
    """

    radius: float = field(metadata=kept("number", "mm", valid=_above_zero))
    rim: float = field(metadata=kept("number", "mm", valid=_above_zero))
    axis: tuple[float, float] = field(metadata=kept("numbers", "mm", shape=(2,), place=True))
    sight: tuple[float, float] = field(metadata=kept("numbers", shape=(2,)))
    lamps: tuple[float, float] = field(metadata=kept("numbers", shape=(2,)))
    scatter: float = field(metadata=kept("number", "rad"))
    curve: Floats = field(metadata=kept("array", shape=("n",)))
    reach: tuple[float, float] = field(metadata=kept("numbers", shape=(2,)))
    shade: Floats = field(metadata=kept("array", shape=(5,)))
    pattern: str = field(metadata=kept("text", valid=lambda value: value in PATTERNS))
    zenith_sigma: NDArray[np.float32] = field(metadata=kept("map", "rad", dtype=np.float32))
    azimuth_sigma: NDArray[np.float32] = field(metadata=kept("map", "rad", dtype=np.float32))
    parameters: tuple[str, ...] = field(metadata=kept("names", shape=("p",)))
    covariance: Floats = field(metadata=kept("array", shape=("p", "p")))
    error: float = field(metadata=kept("number", "rad"))

    def sight_slopes(self, from_axis: Floats) -> Floats:
        """Return by how much lines of sight at (X, Y), (2, ...), mm, move along x and y for each mm of z."""
        near, far = self.sight
        return np.asarray(-(near + far * (from_axis**2).sum(axis=0)) * from_axis, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Precession:
    """How the body's axis goes round with the phase.

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

    tilt: float = field(metadata=kept("number", "rad", valid=lambda value: value > 0))
    phase_offset: float = field(metadata=kept("number", "rad"))
    direction: int = field(metadata=kept("integer", valid=lambda value: value in (1, -1)))
    ellipticity: float = field(metadata=kept("number"))
    major_axis: float = field(metadata=kept("number", "rad"))
    centre: tuple[float, float] = field(metadata=kept("numbers", "rad", shape=(2,)))
    pivot: tuple[float, float, float] = field(metadata=kept("numbers", "mm", shape=(3,), place=True))
    sigma: Mapping[str, float] = field(default_factory=dict, metadata=kept("mapping"))

    def lean(self, phase: Floats) -> Floats:
        """Return how the body leans.

        Parameters
        ----------
        phase : ndarray, (n,), float64
            Radians, as the recording has them.

        Returns
        -------
        ndarray, (n, 2), float64
            The lean vector l, radians along x and y: the body's axis is (-sin|l| l / |l|, cos|l|).

        Examples
        --------
        >>> circle = Precession(0.04, 0.0, 1, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0, 0.0))
        >>> circle.lean(np.array([0.0, np.pi / 2])).round(3) + 0.0
        array([[0.04, 0.  ],
               [0.  , 0.04]])
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
            Radians, as the recording has them.
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
    """The elastomer's compliance, and the slope of the sheet that turns a pixel light.

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
        Of the stage, mm for each N / (N/mm^2): its flexure times the gel's modulus, 1/mm.
    travel_zero : float
        Travel at which the sheet met the ball that it was learned from, mm: a check of the stage, not used.
    error : float
        RMS height left on what it was learned from, mm.
    sigma : mapping of str to float
        Standard errors, by the names of the fields.
    """

    threshold: float = field(metadata=kept("number", "rad", valid=lambda value: 0 < value < math.pi / 4))
    compliance: float = field(metadata=kept("number", "1/mm", valid=lambda value: value >= 0))
    curvature: float = field(default=0.0, metadata=kept("number", "1/mm", valid=lambda value: value >= 0))
    axis: tuple[float, float] = field(
        default=(0.0, 0.0), metadata=kept("numbers", "mm", shape=(2,), place=True)
    )
    travel_zero: float = field(default=0.0, metadata=kept("number", "mm"))
    error: float = field(default=0.0, metadata=kept("number", "mm", valid=lambda value: value >= 0))
    sigma: Mapping[str, float] = field(default_factory=dict, metadata=kept("mapping"))


@dataclass(frozen=True, slots=True, eq=False)
class Stiffness:
    """The elastomer's modulus, from presses of known force.

    Attributes
    ----------
    modulus : float
        Young's modulus, MPa.
    gel_shift : (float, float, float)
        By how many standard errors the gel's threshold, compliance and curvature are off, as forces show.
    covariance : ndarray, (4, 4), float64
        Of the modulus and of its products with the shifts, MPa^2.
    scatter : float
        Standard deviation of a press's force that neither noise nor these numbers explain, as a share of it.
    gel_threshold : float
        That of the gel with which it was learned, radians: a gel learned again needs a modulus learned again.
    error : float
        RMS error of each force by what the other presses show, as a share of it; NaN of fewer than 2.
    presses : int
        How many it was learned from.
    """

    modulus: float = field(metadata=kept("number", "MPa", valid=_above_zero))
    gel_shift: tuple[float, float, float] = field(metadata=kept("numbers", shape=(3,)))
    covariance: NDArray[np.float64] = field(metadata=kept("array", shape=(4, 4)))
    scatter: float = field(metadata=kept("number", valid=lambda value: value >= 0))
    gel_threshold: float = field(metadata=kept("number", "rad"))
    error: float = field(default=math.nan, metadata=kept("number"))
    presses: int = field(default=1, metadata=kept("integer", valid=lambda value: value >= 1))

    @property
    def modulus_sigma(self) -> float:
        """Standard error of the modulus, MPa."""
        return math.sqrt(self.covariance[0, 0])


Part = References | Lens | WallResponse | Precession | Gel | Stiffness


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
    stiffness : Stiffness or None
    process : mapping
        How each part came about: "references.program", "zenith.sources" and so on, by the names of the
        commands: references, scale, zenith, tilt, elastic, force.
    name : str
        The file that it was read from, for messages.
    """

    camera: CameraId
    references: References | None = None
    lens: Lens | None = None
    zenith: WallResponse | None = None
    precession: Precession | None = None
    gel: Gel | None = None
    stiffness: Stiffness | None = None
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
    "stiffness": "force",
}
"""The attributes of a calibration, and what their groups in a file and the commands are called."""

KINDS: dict[str, type[Part]] = dict(
    zip(GROUPS, (References, Lens, WallResponse, Precession, Gel, Stiffness), strict=True)
)
