"""The quantities that a result can contain: each is declared once, here or by a user's own operation.

Files, exports, figures, reports, notebooks, undistortion and the documentation derive what they need to know
of a map from its declaration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Literal

import msgspec

from mirrorskin.io.types import InputError
from mirrorskin.io.units import conversion_factor

SIGMA = "_sigma"
"""What the name of a map's standard deviation ends in."""

LONGEST_DECLARATION = 100_000
"""Bytes of a declaration in a file."""

_DISPLAYED = {"rad": "deg"}  # units of figures, unless a declaration names another
_PLAIN = {"µm": "um"}  # of units, as conversions name them


class Map(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Declaration of a quantity of a result.

    Attributes
    ----------
    caption : str
        What the values mean: one sentence without a full stop, for reports and documentation.
    unit : str
        Unit of the values in memory and in files; empty for none.
    dtype : str
        NumPy's name of the type.
    axes : {"pixels", "frames", "pieces", "none"}
        One value per pixel, (H, W); per frame, (T,); per connected component, (n,); or a single number.
    components : tuple of str
        Names of a vector's components, which are a last axis; empty for a scalar.
    codes : mapping of int to str
        Legend of a categorical map.
    undefined : float or None
        The value that marks a pixel without an answer; None is NaN.
    quantity : str
        Name of the map that this one stands for: a map of quantity ``"height"`` is a result's `height` for
        everything that consumes heights.
    sampling : {"linear", "nearest", "angle", "direction"}
        How the map is interpolated when the picture is undistorted: between pixels, by the nearest pixel, the
        short way round the circle, or as unit vectors. A map with codes is always sampled at the nearest.
    within : str
        The label map across whose borders nothing is interpolated.
    title : str
        Title of the figure; by default the name.
    colours : {"sequential", "positive", "signed", "cyclic", "error"}
        Colours of the figure: sequential, the same with a logarithmic scale where the values span decades,
        diverging about zero, for angles all the way round, or those of standard deviations.
    displayed : str
        Unit of figures; by default degrees for radians, otherwise `unit`.
    overview : bool
        Whether the figure of a whole result includes the map.
    included_in : str
        Name of a map whose figure shows this one as well, so that the overview leaves this one out.

    Examples
    --------
    >>> wear = Map("depth of the wear", "mm", colours="signed", displayed="µm")
    >>> wear.figure_unit, wear.figure_scale
    ('µm', 1000.0)
    >>> Map("material", dtype="uint8", codes={0: "unknown", 1: "steel"}).codes[1]
    'steel'
    """

    caption: str = ""
    unit: str = ""
    dtype: str = "float32"
    axes: Literal["pixels", "frames", "pieces", "none"] = "pixels"
    components: tuple[str, ...] = ()
    codes: dict[int, str] = {}
    undefined: float | None = None
    quantity: str = ""
    sampling: Literal["linear", "nearest", "angle", "direction"] = "linear"
    within: str = "contact"
    title: str = ""
    colours: Literal["sequential", "positive", "signed", "cyclic", "error"] = "sequential"
    displayed: str = ""
    overview: bool = True
    included_in: str = ""

    @property
    def figure_unit(self) -> str:
        """Unit of figures."""
        return self.displayed or _DISPLAYED.get(self.unit, self.unit)

    @property
    def figure_scale(self) -> float:
        """Number that values are multiplied by in figures."""
        if self.figure_unit == self.unit:
            return 1.0
        shown, own = (_PLAIN.get(unit, unit) for unit in (self.figure_unit, self.unit))
        return 1 / conversion_factor(shown, own, "a figure")

    @property
    def undefined_value(self) -> float:
        """The value that marks a pixel without an answer."""
        return math.nan if self.undefined is None else self.undefined

    def title_of(self, name: str) -> str:
        """Return the title of the figure of a map of this name."""
        return self.title or name.replace("_", " ").capitalize()

    def deviation(self, name: str) -> Map:
        """Return the declaration of the standard deviation of a map of this name."""
        title = self.title_of(name)
        return Map(
            f"standard deviation of the {title[:1].lower()}{title[1:]}",
            self.unit,
            axes=self.axes,
            quantity=f"{self.quantity}{SIGMA}" if self.quantity else "",
            sampling="linear",
            within=self.within,
            title=f"Standard deviation of {title[:1].lower()}{title[1:]}",
            colours="error",
            displayed=self.displayed or ("µm" if self.unit == "mm" else ""),
            overview="height" in (name, self.quantity),
        )

    def attributes(self) -> dict[str, Any]:
        """Return what a file says of the map to other programs, by the names of the CF conventions."""
        found: dict[str, Any] = {"units": self.unit} if self.unit else {}
        if self.caption:
            found["long_name"] = self.caption
        if self.codes:
            found["flag_values"] = [*self.codes]
            found["flag_meanings"] = " ".join(text.replace(" ", "_") for text in self.codes.values())
        return found

    def encode(self) -> str:
        """Return the declaration as JSON, for files."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def decode(cls, text: str, where: str) -> Map:
        """Return the declaration that `encode` wrote.

        Raises
        ------
        InputError
            The text is not a declaration; ``where`` begins the message.
        """
        try:
            if len(text) > LONGEST_DECLARATION:
                raise ValueError(f"{len(text)} characters")
            return msgspec.json.decode(text.encode(), type=cls)
        except (msgspec.MsgspecError, UnicodeError, ValueError) as error:
            raise InputError(
                f"{where}: the declaration of the map is invalid ({error}). Reconstruct it again"
            ) from error


class PressStatus(IntEnum):
    """Codes of ``status`` of a press."""

    INVALID_INPUT = 0
    ONSET = 1
    NEVER_LIGHT = 2
    LIGHT_AT_START = 3


class ReleaseStatus(IntEnum):
    """Codes of ``status`` of a release."""

    INVALID_INPUT = 0
    RELEASE = 1
    DARK_AT_START = 2
    LIGHT_TO_THE_END = 3


class PoseStatus(IntEnum):
    """Codes of ``status`` of a rotation whose tilt differs from frame to frame."""

    INVALID_INPUT = 0
    NORMAL = 1
    NONE = 2
    SLOPE_ONLY = 4


class SlipStatus(IntEnum):
    """Codes of ``status`` of a slide or a twist."""

    UNKNOWN = 0
    SLIPPED = 1
    STICKS = 2
    NO_CONTACT = 3
    NO_TEXTURE = 4


class FocusStatus(IntEnum):
    """Codes of ``status`` of a focus stack."""

    INVALID_INPUT = 0
    IN_FOCUS = 1
    NO_PEAK = 2
    PEAK_AT_AN_END = 3


class StitchStatus(IntEnum):
    """Codes of ``status`` of a surface that was stitched from several touches."""

    NO_HEIGHT = 0
    CONSISTENT = 1
    INCONSISTENT = 2


def status_of(codes: type[IntEnum]) -> Map:
    """Return the declaration of a map ``status`` with the legend of these codes."""
    legend = {int(code): code.name.lower().replace("_", " ") for code in codes}
    return Map("outcome at each pixel", dtype="uint8", codes=legend, undefined=0, title="Status")


def _flag(yes: str, no: str, caption: str, **more: Any) -> Map:
    legend = {0: no, 1: yes}
    return Map(caption, dtype="uint8", codes=legend, undefined=0, **{"overview": False, **more})


_ALONG = ("x", "y")

TABLE: Mapping[str, Map] = {
    "height": Map(
        "height of the surface; 0 is the sheet at rest, and z points towards the camera",
        "mm",
        within="component",
    ),
    "status": Map("outcome at each pixel", dtype="uint8", undefined=0),
    "hysteresis": Map(
        "height of the release minus height of the onset, in a press that oscillates",
        "mm",
        colours="signed",
        displayed="µm",
    ),
    "strokes": Map(
        "number of strokes in which the pixel had the event that its height is computed from",
        dtype="uint16",
        undefined=0,
        overview=False,
    ),
    "growth": Map(
        "share of full light that a pixel gains per millimetre of travel of a dithering press",
        "1/mm",
        title="Growth of the light",
        colours="signed",
    ),
    "slope": Map(
        "rise of the surface per unit of length along the direction of rocking",
        title="Slope along the rocking",
        colours="signed",
    ),
    "normals": Map(
        "unit normals of the surface",
        components=("x", "y", "z"),
        sampling="direction",
    ),
    "zenith": Map("angle between the normal and the direction to the camera", "rad", overview=False),
    "azimuth": Map(
        "direction in which the normal leans, counter-clockwise from x",
        "rad",
        title="Azimuth of the normal",
        sampling="angle",
        colours="cyclic",
        included_in="normals",
    ),
    "normals_sigma": Map(
        "RMS angle between the estimated and the true normal",
        "rad",
        title="Standard deviation of normals",
        colours="error",
    ),
    "mean": Map("mean brightness over the turn", "counts", overview=False),
    "cosine": Map("coefficient of the cosine of the phase in the brightness", "counts", overview=False),
    "sine": Map("coefficient of the sine of the phase in the brightness", "counts", overview=False),
    "modulation": Map(
        "amplitude of the brightness over the turn", "counts", colours="positive", included_in="normals"
    ),
    "residual": Map(
        "standard deviation of the brightness that the fit does not explain", "counts", overview=False
    ),
    "edges": _flag("edge", "no edge", "lines where the normal jumps or contact ends", overview=True),
    "filled": _flag(
        "filled", "measured", "1 where the height was not measured but interpolated from its surroundings"
    ),
    "contact": _flag("in contact", "no lasting contact", "1 where the sheet was in contact in every frame"),
    "component": Map(
        "number of the connected piece; heights of two pieces are independent of each other",
        dtype="int32",
        undefined=-1,
        sampling="nearest",
        overview=False,
    ),
    "slope_min": Map(
        "lower bound of the sheet's zenith, from the highest level of light that it passes",
        "rad",
        sampling="nearest",
        overview=False,
    ),
    "slope_max": Map(
        "upper bound of the sheet's zenith, from the lowest level of light that it does not pass",
        "rad",
        sampling="nearest",
        overview=False,
    ),
    "pressure": Map(
        "pressure between sensor and object at the greatest travel; 0 outside the contact",
        "MPa",
        overview=False,
    ),
    "displacement": Map(
        "displacement of the skin along x and y since the first frame",
        "mm",
        components=_ALONG,
        title="Displacement of the skin",
        displayed="µm",
    ),
    "slip_onset": Map(
        "distance that the body has slid when the skin breaks loose; undefined where it does not",
        "mm",
        title="Onset of slip",
        displayed="µm",
    ),
    "traction": Map(
        "tangential stress that the object exerts on the sensor at the end; 0 outside the contact",
        "MPa",
        components=_ALONG,
        overview=False,
    ),
    "offset_unknown": Map(
        "1 for a component whose heights are relative: their mean is 0", dtype="uint8", axes="pieces"
    ),
    "slide_distance": Map("distance that the body has slid", "mm", "float64", "frames"),
    "twist_angle": Map("angle that the body has turned", "rad", "float64", "frames"),
    "stick_ratio": Map(
        "share of the contact that sticks; undefined after the body turns back", "", "float64", "frames"
    ),
    "force": Map("normal force at the greatest travel", "N", "float64", "none"),
    "force_x": Map("force along x that the object exerts on the sensor at the end", "N", "float64", "none"),
    "force_y": Map("force along y that the object exerts on the sensor at the end", "N", "float64", "none"),
}
"""The maps, series and numbers that built-in operations return, in the order of files and figures."""

_PLACES = {name: place for place, name in enumerate(TABLE)}

TWIST: Mapping[str, Map] = {
    "slip_onset": Map(
        "angle that the body has turned when the skin breaks loose; undefined where it does not",
        "rad",
        title="Onset of slip",
    )
}
"""Declarations that differ from the table's when the body twists."""

FORMER_NAMES: Mapping[str, str] = {"normal_sigma": "normals_sigma"}
"""Names that maps had in files of earlier versions, and their names today."""


def is_deviation(name: str) -> bool:
    """Return whether a name is that of a standard deviation."""
    return name.endswith(SIGMA) and name != SIGMA


def is_builtin(name: str) -> bool:
    """Return whether a name belongs to the table: a map, or the standard deviation of one."""
    return name in TABLE or (is_deviation(name) and name.removesuffix(SIGMA) in TABLE)


def place_of(name: str) -> tuple[int, bool]:
    """Return a key that sorts maps in the order of the table, each before its standard deviation."""
    base = name if name in TABLE else name.removesuffix(SIGMA)
    return _PLACES.get(base, len(_PLACES)), base != name and base in _PLACES


def declaration_of(name: str, declared: Mapping[str, Map] | None = None) -> Map:
    """Return the declaration of a map: the result's own, the table's, or an empty one.

    The standard deviation of a declared map needs no declaration.

    Examples
    --------
    >>> declaration_of("slip_onset_sigma").unit
    'mm'
    >>> declaration_of("anything").unit
    ''
    """
    declared = declared or {}
    if name in declared or name in TABLE:
        return declared[name] if name in declared else TABLE[name]
    if is_deviation(name):
        base = name.removesuffix(SIGMA)
        if base in declared or base in TABLE:
            return declaration_of(base, declared).deviation(base)
    return Map()
