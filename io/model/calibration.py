"""The contents of a calibration: the camera, and the parts with their parameters.

Coordinates are as in a result: x to the right and y up, mm from the picture's centre; z towards the camera
from the sheet's rest plane, in the frame of the body. To add a parameter, declare it with `parameter`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats, InputError, ProcessValue
from mirrorskin.io.model.parameters import Part, Row, median, parameter, part

HOT, DEAD, SATURATED = 1, 2, 4
BITS = {"hot": HOT, "dead": DEAD, "saturated": SATURATED}
"""The bits of ``References.defects``, and their names."""

PATTERNS = ("graded", "uniform")


def _above_zero(values: float | tuple[float, ...]) -> bool:
    return all(0 < value < math.inf for value in np.ravel(values))


def _at_least_zero(value: float) -> bool:
    return value >= 0


def _zeniths_on_axis(reach: tuple[float, float]) -> list[float]:
    """Return the zeniths, degrees, of mirrors on the axis that show the wall at q, in ascending order."""
    return sorted(math.degrees(math.pi / 4 - math.atan(q)) for q in reach)


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


@part
class References(Part):
    """Dark and bright level of each pixel."""

    command: ClassVar[str] = "references"
    signal: ClassVar[str] = "bright"

    dark: NDArray[np.float32] = parameter("dark level, without light; NaN at defects", "counts")
    bright: NDArray[np.float32] = parameter("bright level, in full light; NaN at defects", "counts")
    dark_sigma: NDArray[np.float32] = parameter("standard error of dark", "counts", title="")
    bright_sigma: NDArray[np.float32] = parameter("standard error of bright", "counts", title="")
    defects: NDArray[np.uint8] = parameter(
        "0 for a sound pixel, or a sum of 1 hot, 2 dead, 4 saturated", flags=BITS
    )

    def standard_errors(self) -> Mapping[str, float]:
        """Return the medians of the standard errors."""
        return {name: median(getattr(self, f"{name}_sigma")) for name in ("dark", "bright")}


@part
class Lens(Part):
    """Mapping from pixels to positions on the sheet.

    The undistorted map has as many pixels as the picture, all of one size, and the same centre. See
    ``mirrorskin.engine.base.undistort``.
    """

    command: ClassVar[str] = "scale"

    pixel_size: tuple[float, float] = parameter(
        "size along x and y of a pixel of the undistorted map",
        "mm",
        title="pixel size along {}",
        shown_unit="µm",
        components="xy",
        valid=_above_zero,
    )
    camera: Floats = parameter(
        "homography from a pixel (column, row, 1) of a picture without distortion to millimetres on the"
        " sheet, (x, y, 1), with (0, 0) at the centre of the undistorted map; it includes the perspective",
        shape=(3, 3),
    )
    distortion: Floats = parameter(
        "coefficients k1, k2, p1, p2, k3 of OpenCV", components=("k1", "k2", "p1", "p2", "k3")
    )
    matrix: Floats = parameter(
        "the corresponding pinhole camera matrix, in pixels of the picture", shape=(3, 3)
    )
    shape: tuple[int, int] = parameter(
        "rows and columns of the undistorted map, and of the full picture",
        title="{} of the map",
        components=("rows", "columns"),
        valid=_above_zero,
    )
    error: float = parameter(
        "RMS distance between the detected and the fitted marks", "pixel", title="left on the board"
    )
    scale_sigma: float = parameter("relative standard error of the pixel size", title="", default=math.nan)

    def standard_errors(self) -> Mapping[str, float]:
        """Return the standard errors of the pixel size."""
        sizes = zip("xy", self.pixel_size, strict=True)
        return {f"pixel_size_{axis}": size * self.scale_sigma for axis, size in sizes}


@part
class WallResponse(Part):
    """Brightness of a mirror under a cylindrical wall, as a function of its normal and position.

    A pixel sees (x, y) on the rest plane. ``kernels/rotation/response.py`` computes the brightness.
    """

    command: ClassVar[str] = "zenith"
    signal: ClassVar[str] = "zenith_sigma"
    motion: ClassVar[str] = "axial"

    radius: float = parameter("radius R of the wall", "mm", valid=_above_zero)
    rim: float = parameter("height H of the wall", "mm", valid=_above_zero)
    axis: tuple[float, float] = parameter(
        "position (x0, y0) of the wall's axis; X = x - x0, Y = y - y0", "mm", components="xy", place=True
    )
    sight: tuple[float, float] = parameter(
        "k0, 1/mm, and k2, 1/mm^3: the line of sight is along (-(k0 + k2 r^2) X, -(k0 + k2 r^2) Y, 1),"
        " r^2 = X^2 + Y^2",
        title="line of sight k{}",
        components=("0", "2"),
    )
    lamps: tuple[float, float] = parameter(
        "relative increase of the wall's brightness towards x and y",
        title="lamps towards {}",
        shown_unit="%",
        components="xy",
    )
    scatter: float = parameter("half-angle of the sheet's scatter", "rad")
    curve: Floats = parameter(
        "coefficients of the brightness as a polynomial in q, lowest first", shape=("n",)
    )
    reach: tuple[float, float] = parameter(
        "range of q in which the polynomial is valid",
        title="known on the axis {}",
        shown_unit="deg",
        components=("from", "to"),
        convert=_zeniths_on_axis,
    )
    shade: Floats = parameter(
        "s0 to s4 of the shading V = 1 + s0 X/R + s1 Y/R + s2 (X/R)^2 + s3 XY/R^2 + s4 (Y/R)^2; the"
        " relative brightness is (counts - dark) / ((bright - dark) V)",
        title="shading s{}",
        components="01234",
    )
    pattern: str = parameter(
        "`graded`, or `uniform` for a wall that determines only a threshold",
        valid=lambda value: value in PATTERNS,
    )
    zenith_sigma: NDArray[np.float32] = parameter(
        "standard error of zenith, from the response", "rad", title="error of zenith"
    )
    azimuth_sigma: NDArray[np.float32] = parameter(
        "standard error of azimuth times sin(zenith), from the response",
        "rad",
        title="error of azimuth x sin(zenith)",
    )
    parameters: tuple[str, ...] = parameter("names of the fitted parameters", shape=("p",))
    covariance: Floats = parameter("covariance of the fitted parameters, in their units", shape=("p", "p"))
    error: float = parameter(
        "residual of the zenith on the balls plus one standard error, RMS; of touches: the median standard"
        " error",
        "rad",
        title="left of the zenith at most",
    )
    swing_sigma: float | None = parameter(
        "relative standard error of the swing of the brightness over a turn, at given mean brightness",
        title="error of the swing",
        shown_unit="%",
        default=None,
    )
    names: tuple[str, ...] | None = parameter(
        "of touches: names of their parameters", shape=("k",), default=None
    )
    values: Floats | None = parameter(
        "of touches: their parameters, those of the movement relative to the precession",
        shape=("k",),
        default=None,
    )
    information: Floats | None = parameter(
        "of touches: information about the parameters, without priors", shape=("k", "k"), default=None
    )
    pull: Floats | None = parameter(
        "of touches: information times the deviation of the parameters that touches alone would have",
        shape=("k",),
        default=None,
    )
    touches: int | None = parameter("number of touches used", default=None)
    time: float | None = parameter(
        "time of the last touch since 1970; NaN if unknown", "s", title="", default=None
    )

    def standard_errors(self) -> Mapping[str, float]:
        """Return the standard errors of the fitted parameters; 0 if fixed."""
        names = (name.replace("lamp_", "lamps_") for name in self.parameters)
        return dict(zip(names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@part
class LinearResponse(Part):
    """Brightness as a function of the zenith, from touches, and what these touches determine.

    A mirror whose zenith is theta has the brightness ``offset + gain theta``, to the power ``gamma`` relative
    to full light; see `mirrorskin.engine.diagnosis.turn_light`.
    """

    command: ClassVar[str] = "self"
    signal: ClassVar[str] = "gain"
    motion: ClassVar[str] = "axial"

    gain: NDArray[np.float32] = parameter("counts per radian of zenith", "counts/rad", title="zenith gain")
    offset: NDArray[np.float32] = parameter("counts at zenith 0", "counts", title="zenith offset")
    gamma: float = parameter("power of the light that the brightness follows", valid=_above_zero)
    names: tuple[str, ...] = parameter("names of the parameters of the touches", shape=("p",))
    values: Floats = parameter(
        "parameters of the touches, relative to the other numbers of the calibration", shape=("p",)
    )
    information: Floats = parameter(
        "information of all touches about the parameters, and of what the calibration stated before",
        shape=("p", "p"),
    )
    pull: Floats = parameter(
        "information times the deviation of the parameters that touches alone would have", shape=("p",)
    )
    touches: int = parameter("number of touches used", valid=lambda value: value >= 1)
    time: float = parameter("time of the last touch since 1970; NaN if unknown", "s", title="")
    sigma: Mapping[str, float] = parameter("standard errors, by the names of the parameters", default=dict)


@part
class Precession(Part):
    """Lean of the body's axis as a function of the phase."""

    command: ClassVar[str] = "tilt"
    motion: ClassVar[str] = "axial"

    tilt: float = parameter(
        "mean half-angle of the cone", "rad", title="half-angle", valid=lambda value: value > 0
    )
    phase_offset: float = parameter("azimuth of the lean at phase zero", "rad")
    direction: int = parameter(
        "sense of rotation: 1 if it is that of the phase, counter-clockwise; otherwise -1",
        valid=lambda value: value in (1, -1),
        convert=lambda value: "with the phase" if value > 0 else "against the phase",
    )
    ellipticity: float = parameter("(a - b) / (a + b) of the largest and the smallest half-angle")
    major_axis: float = parameter("azimuth of the largest half-angle", "rad")
    centre: tuple[float, float] = parameter(
        "the mean lean along x and y", "rad", title="mean lean along {}", components="xy"
    )
    pivot: tuple[float, float, float] = parameter(
        "centre of the rotation; NaN if undetermined", "mm", components="xyz", place=True
    )
    sigma: Mapping[str, float] = parameter(
        "standard errors, by the names of the parameters; of vectors `pivot_z` and so on", default=dict
    )

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
        """Return the azimuth on the circle that is mapped to the ellipse."""
        return self.direction * np.asarray(phase, np.float64) + self.phase_offset

    def _ellipse(self, phase: Floats) -> tuple[Floats, Floats]:
        """Return the lean relative to its mean, along the major axis and across it."""
        angle = self._angle(phase) - self.major_axis
        along = self.tilt * (1 + self.ellipticity) * np.cos(angle)
        return along, self.tilt * (1 - self.ellipticity) * np.sin(angle)


@part
class Gel(Part):
    """The elastomer's compliance, and the slope of the sheet at which a pixel turns bright.

    A pixel turns bright where the sheet's zenith passes the one that shows the rim of a round lit wall
    (see `threshold_at` of `mirrorskin.engine.press.elastic`).
    """

    command: ClassVar[str] = "elastic"
    motion: ClassVar[str] = "vertical"

    threshold: float = parameter(
        "zenith at which a pixel on the wall's axis turns bright",
        "rad",
        title="threshold zenith",
        valid=lambda value: 0 < value < math.pi / 4,
    )
    compliance: float = parameter(
        "deflection of the stage in mm per N / (N/mm^2): its flexure times the gel's modulus",
        "1/mm",
        title="flexure times modulus",
        valid=_at_least_zero,
    )
    curvature: float = parameter(
        "1 / radius of the wall: decrease of the threshold towards it; 0 for the same zenith everywhere",
        "1/mm",
        title="curvature of the wall",
        valid=_at_least_zero,
        default=0.0,
    )
    axis: tuple[float, float] = parameter(
        "position of the wall's axis in the picture",
        "mm",
        components="xy",
        place=True,
        default=(0.0, 0.0),
    )
    travel_zero: float = parameter(
        "travel at which the sheet met the calibration ball: a check of the stage, not used",
        "mm",
        title="travel at the touch",
        default=0.0,
    )
    error: float = parameter(
        "RMS residual of the height on the calibration balls",
        "mm",
        title="left on the ball",
        shown_unit="µm",
        valid=_at_least_zero,
        default=0.0,
    )
    sigma: Mapping[str, float] = parameter("standard errors, by the names of the parameters", default=dict)


@part
class Stiffness(Part):
    """The elastomer's modulus, from presses of known force."""

    command: ClassVar[str] = "force"
    motion: ClassVar[str] = "vertical"

    modulus: float = parameter("Young's modulus", "MPa", valid=_above_zero)
    gel_shift: tuple[float, float, float] = parameter(
        "errors of the gel's threshold, compliance and curvature found from forces, in standard errors",
        title="shift of the gel's {}",
        components=("threshold", "compliance", "curvature"),
    )
    covariance: Floats = parameter(
        "covariance of the modulus and of its products with the shifts, MPa^2", shape=(4, 4)
    )
    scatter: float = parameter(
        "relative standard deviation of a press's force that neither noise nor these parameters explain",
        title="scatter of a force",
        shown_unit="%",
        valid=_at_least_zero,
    )
    gel_threshold: float = parameter(
        "threshold of the gel used: a gel that is calibrated again needs a new modulus", "rad"
    )
    error: float = parameter(
        "relative RMS error of each force predicted from the other presses; NaN for fewer than 2",
        title="error of held-out forces",
        shown_unit="%",
        default=math.nan,
    )
    presses: int = parameter("number of presses used", valid=lambda value: value >= 1, default=1)

    def standard_errors(self) -> Mapping[str, float]:
        """Return the standard error of the modulus."""
        return {"modulus": self.modulus_sigma}

    @property
    def modulus_sigma(self) -> float:
        """Standard error of the modulus, MPa."""
        return math.sqrt(self.covariance[0, 0])


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
    response : LinearResponse or None
    process : mapping
        Provenance of each part: "references.program", "zenith.sources" and so on, by the names of the
        commands: references, scale, zenith, tilt, elastic, force, self.
    name : str
        The file that it was read from, for messages.

    Raises
    ------
    InputError
        It has two responses of a turn: that of a graded wall, and that of touches.
    """

    camera: CameraId
    references: References | None = None
    lens: Lens | None = None
    zenith: WallResponse | None = None
    precession: Precession | None = None
    gel: Gel | None = None
    stiffness: Stiffness | None = None
    response: LinearResponse | None = None
    process: Mapping[str, ProcessValue] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        if self.response is not None and self.zenith is not None and self.zenith.pattern == "graded":
            raise InputError(
                f"{self.name or 'a calibration'} cannot contain both zenith (balls) and self (touches), two"
                " responses of a turn: write one of them to another file with -o"
            )

    def parts(self) -> dict[str, Part]:
        """Return the existing parts, by the names of the attributes."""
        parts = {name: getattr(self, name) for name in PARTS}
        return {name: part for name, part in parts.items() if part is not None}

    def rows(self) -> Iterator[Row]:
        """Yield its numbers in the units of tables; for maps, the medians."""
        yield Row("camera", "name", self.camera.name or "unknown")
        for what, size in zip(("rows", "columns"), self.camera.shape, strict=True):
            yield Row("camera", f"{what} of a frame", size)
        yield Row("camera", "type of a sample", np.dtype(self.camera.dtype).name)
        for record in self.parts().values():
            yield from record.rows()

    @property
    def contents(self) -> str:
        """The existing parts in one line, by the names of the commands that calibrate them."""
        return ", ".join(part.command for part in self.parts().values()) or "nothing"


PARTS: dict[str, type[Part]] = {
    "references": References,
    "lens": Lens,
    "zenith": WallResponse,
    "precession": Precession,
    "gel": Gel,
    "stiffness": Stiffness,
    "response": LinearResponse,
}
"""The classes of the parts, by the attributes of a calibration."""
