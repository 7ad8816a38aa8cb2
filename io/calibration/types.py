"""The contents of a calibration: the camera, and the parts, with the storage of each field.

Coordinates are as in a result: x to the right and y up, mm from the picture's centre; z towards the camera
from the sheet's rest plane, in the frame of the body. To add a field, declare it with `kept`, and give it a
default if older files are still to be read: a field with a default may be missing from a file.
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
    """How one field is stored in a file.

    A "map" has one value per pixel of the camera, and is cropped with the picture. "numbers", "integers" and
    "names" are tuples. A "mapping" contains numbers by name, in a group of its own; `unit_of` returns its
    unit. Letters in ``shape`` are sizes shared by the fields of one part. The first two numbers
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
    """Return how the fields of a part, or of its class, are stored, by name."""
    return {one.name: one.metadata["stored"] for one in fields(part)}


def unit_of(name: str, how: Mapping[str, Stored]) -> str | None:
    """Return the unit of a field by its name, with or without the suffix ``_x``, ``_y`` or ``_z``."""
    one = how.get(name) or how.get(name.rpartition("_")[0])
    return None if one is None else one.unit


HOT, DEAD, SATURATED = 1, 2, 4
BITS = {"hot": HOT, "dead": DEAD, "saturated": SATURATED}
"""The bits of ``References.defects``, and their names."""

PATTERNS = ("graded", "uniform")


def _above_zero(values: float | tuple[float, ...]) -> bool:
    return all(0 < value < math.inf for value in np.ravel(values))


@dataclass(frozen=True, slots=True, eq=False)
class CameraId:
    """The camera that a calibration belongs to.

    Attributes
    ----------
    name : str
        Name in the rig file; empty if unknown.
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
    """Dark and bright level of each pixel.

    Attributes
    ----------
    dark, bright : ndarray, (H, W), float32
        Counts; NaN at defects.
    dark_sigma, bright_sigma : ndarray, (H, W), float32
        Counts: the standard errors of the two means.
    defects : ndarray, (H, W), uint8
        0 for a sound pixel, otherwise a sum of 1 hot, 2 dead, 4 saturated.
    """

    dark: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    bright: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    dark_sigma: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    bright_sigma: NDArray[np.float32] = field(metadata=kept("map", "counts", dtype=np.float32))
    defects: NDArray[np.uint8] = field(metadata=kept("map", dtype=np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Mapping from pixels to positions on the sheet.

    The undistorted map has as many pixels as the picture, all of one size; its centre and that of the picture
    are the same point of the sheet. See ``mirrorskin.engine.undistort``.

    Attributes
    ----------
    pixel_size : (float, float)
        Size in mm along x and y of a pixel of the undistorted map.
    camera : ndarray, (3, 3), float64
        Homography from a pixel (column, row, 1) of a picture without distortion to millimetres on the sheet,
        (x, y, 1); (0, 0) is the centre of the undistorted map. It includes the perspective.
    distortion : ndarray, (5,), float64
        Coefficients k1, k2, p1, p2, k3 of OpenCV.
    matrix : ndarray, (3, 3), float64
        The corresponding pinhole camera matrix, in pixels of the picture.
    shape : (int, int)
        Rows and columns of the undistorted map, and of the full picture.
    error : float
        RMS distance between the detected and the fitted marks, pixels.
    scale_sigma : float
        Relative standard error of the pixel size.
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
    """Brightness of a mirror under a cylindrical wall, as a function of its normal and position.

    A pixel sees (x, y) on the rest plane; X = x - x0, Y = y - y0. Its relative brightness is
    (E - dark) / ((bright - dark) V) with
    V = 1 + s0 X/R + s1 Y/R + s2 (X/R)^2 + s3 XY/R^2 + s4 (Y/R)^2. ``kernels/response.py`` computes the
    brightness for a normal.

    Attributes
    ----------
    radius, rim : float
        Radius R and height H of the wall, mm.
    axis : (float, float)
        Position (x0, y0) of its axis, mm.
    sight : (float, float)
        k0, 1/mm, and k2, 1/mm^3: the line of sight is along
        (-(k0 + k2 r^2) X, -(k0 + k2 r^2) Y, 1), r^2 = X^2 + Y^2.
    lamps : (float, float)
        Relative increase of the wall's brightness towards x and y.
    scatter : float
        Half-angle of the sheet's scatter, radians.
    curve : ndarray, (n,), float64
        Coefficients of the brightness as a polynomial in q, lowest first.
    reach : (float, float)
        Range of q in which the polynomial is valid.
    shade : ndarray, (5,), float64
        s0 to s4, the shading of the picture.
    pattern : {"graded", "uniform"}
        Whether the wall determines angles, or only a threshold.
    zenith_sigma, azimuth_sigma : ndarray, (H, W), float32
        Radians: standard deviations of the response in zenith, and in azimuth times sin(zenith).
    parameters : tuple of str
        Names of the fitted parameters.
    covariance : ndarray, (P, P), float64
        Covariance of the parameters, in their units.
    error : float
        Residual of the zenith on the balls plus one standard error, radians RMS.
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


@dataclass(frozen=True, slots=True, eq=False)
class Precession:
    """Lean of the body's axis as a function of the phase.

    Attributes
    ----------
    tilt : float
        Mean half-angle of the cone, radians.
    phase_offset : float
        Azimuth of the lean at phase zero, radians.
    direction : {1, -1}
        Sense of rotation: 1 if it is that of the phase, counter-clockwise; otherwise -1.
    ellipticity : float
        (a - b) / (a + b) of the largest and the smallest half-angle.
    major_axis : float
        Azimuth of the largest half-angle, radians.
    centre : (float, float)
        The mean lean, radians along x and y.
    pivot : (float, float, float)
        Centre of the rotation, mm.
    sigma : mapping of str to float
        Standard errors, by the names of the fields; for vectors ``centre_x``, ``pivot_z`` and so on.
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
        """Return the lean of the body.

        Parameters
        ----------
        phase : ndarray, (n,), float64
            Radians, as in the recording.

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
        """Return the azimuth of the lean relative to its mean, radians; continuous where the phase is.

        Parameters
        ----------
        phase : ndarray, (n,), float64
            Radians, as in the recording.
        """
        even = self._angle(phase)
        along, across = self._ellipse(phase)
        ahead = self.major_axis + np.arctan2(across, along) - even
        return np.asarray(even + np.remainder(ahead + math.pi, math.tau) - math.pi, np.float64)

    def _angle(self, phase: Floats) -> Floats:
        """Return the azimuth on the circle whose affine image is the ellipse."""
        return self.direction * np.asarray(phase, np.float64) + self.phase_offset

    def _ellipse(self, phase: Floats) -> tuple[Floats, Floats]:
        """Return the lean relative to its mean, along the major axis and across it."""
        angle = self._angle(phase) - self.major_axis
        along = self.tilt * (1 + self.ellipticity) * np.cos(angle)
        return along, self.tilt * (1 - self.ellipticity) * np.sin(angle)


@dataclass(frozen=True, slots=True, eq=False)
class Gel:
    """The elastomer's compliance, and the slope of the sheet at which a pixel turns bright.

    A pixel turns bright where the sheet's zenith passes the one that shows the rim of a round lit wall
    (see `threshold_at` of `mirrorskin.engine.press.elastic`).

    Attributes
    ----------
    threshold : float
        Zenith, radians, at which a pixel on the wall's axis turns bright.
    curvature : float
        1 / radius of the wall, 1/mm: decrease of the threshold towards the wall; 0 for the same zenith
        everywhere.
    axis : (float, float)
        Position of the wall's axis in the picture, mm.
    compliance : float
        Deflection of the stage in mm per N / (N/mm^2): its flexure times the gel's modulus, 1/mm.
    travel_zero : float
        Travel at which the sheet met the calibration ball, mm: a check of the stage, not used.
    error : float
        RMS residual of the height on the calibration balls, mm.
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
        Errors of the gel's threshold, compliance and curvature estimated from forces, in standard errors.
    covariance : ndarray, (4, 4), float64
        Covariance of the modulus and of its products with the shifts, MPa^2.
    scatter : float
        Relative standard deviation of a press's force that neither noise nor these parameters explain.
    gel_threshold : float
        Threshold of the gel used, radians: a gel that is calibrated again needs a new modulus.
    error : float
        Relative RMS error of each force predicted from the other presses; NaN for fewer than 2.
    presses : int
        Number of presses used.
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
    """The calibration of a sensor; a part that was not calibrated is None.

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
        Provenance of each part: "references.program", "zenith.sources" and so on, by the names of the
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
        """Return the existing parts, by the names of the attributes."""
        found = {name: getattr(self, name) for name in GROUPS}
        return {name: part for name, part in found.items() if part is not None}

    @property
    def contents(self) -> str:
        """The existing parts in one line, by the names of the commands that calibrate them."""
        return ", ".join(GROUPS[name] for name in self.parts()) or "nothing"


GROUPS = {
    "references": "references",
    "lens": "scale",
    "zenith": "zenith",
    "precession": "tilt",
    "gel": "elastic",
    "stiffness": "force",
}
"""The attributes of a calibration, with the names of their groups in a file and of the commands."""

KINDS: dict[str, type[Part]] = dict(
    zip(GROUPS, (References, Lens, WallResponse, Precession, Gel, Stiffness), strict=True)
)
