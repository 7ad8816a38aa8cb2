"""The quantities that a result can contain: each is declared once, here or by a user's own operation.

Files, exports, figures, reports, notebooks, undistortion and the documentation are derived from these
declarations.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Container, Iterator, Mapping
from enum import IntEnum
from typing import Any, Literal, get_args, get_origin

import msgspec
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import PIXEL, InputError
from mirrorskin.io.base.units import ratio

SIGMA = "_sigma"
"""Suffix of the name of a map's standard deviation."""

LONGEST_DECLARATION = 60_000
"""Limit of the size of a declaration in a file: attributes in HDF5 have at most 64 kB."""

FILLED_SHADES = "#cc5500", "#ffdcb8"
"""Shades of orange of heights that were not measured but filled, from the lowest to the highest height."""

Axes = Literal["pixels", "frames", "pieces", "none"]
Sampling = Literal["linear", "nearest", "angle", "direction"]
Colours = Literal["sequential", "positive", "signed", "error"]

_DTYPES = (*("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64"), "float32", "float64")
_MOST_CODES = 255
_DISPLAYED = {"rad": "deg"}  # units of figures, unless a declaration specifies another


class Map(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Declaration of a quantity of a result.

    Attributes
    ----------
    caption : str
        Meaning of the values: one sentence without a full stop, for reports and documentation.
    unit : str
        Unit of the values in memory and in files; empty for none.
    dtype : str
        NumPy's name of the type; by default ``"uint8"`` for a map with codes, otherwise ``"float32"``.
    axes : {"pixels", "frames", "pieces", "none"}
        One value per pixel, (H, W); per frame, (T,); per connected component, (n,); or a single number.
    components : tuple of str
        Names of a vector's components, which are a last axis; empty for a scalar.
    codes : mapping of int to str
        Legend of a categorical map.
    undefined : float or None
        The value that marks an undefined pixel; None is NaN.
    quantity : str
        Name of the map in the table that this one stands for: a map of quantity ``"height"`` is used as the
        `height` of a result wherever heights are needed.
    sampling : {"linear", "nearest", "angle", "direction"}
        How the map is interpolated when the picture is undistorted: linearly between pixels, by the nearest
        pixel, the shorter way around the circle, or as unit vectors. Integers use the nearest pixel.
    within : str
        Label map that limits interpolation: the map is not interpolated across its borders. By default the
        label map of the quantity, or ``"contact"``.
    per_frame : bool
        Whether a result may contain one map per frame, (T, H, W).
    title : str
        Title of the figure; by default the name.
    colours : {"sequential", "positive", "signed", "error"}
        Colours of the figure: sequential, the same with a logarithmic scale if the values span decades,
        diverging about zero, or those of standard deviations. Angles have cyclic colours.
    displayed : str
        Unit of figures; by default degrees for radians, otherwise `unit`.
    overview : bool
        Whether the figure of a whole result includes the map.
    included_in : str
        Name of a map whose figure includes this one, so that the overview omits it.
    summary : str
        Name of the pixels that have a value, in the one-line summary of a result; empty to omit them.
    counted : bool
        Whether the summary counts the pixels of each code.

    Raises
    ------
    InputError
        A field has the wrong type, or the fields contradict each other.

    Examples
    --------
    >>> wear = Map("depth of the wear", "mm", colours="signed", displayed="µm")
    >>> wear.figure_unit, wear.figure_scale
    ('µm', 1000.0)
    >>> Map("material", codes={0: "unknown", 1: "steel"}).codes[1]
    'steel'
    """

    caption: str = ""
    unit: str = ""
    dtype: str = ""
    axes: Axes = "pixels"
    components: tuple[str, ...] = ()
    codes: dict[int, str] = {}
    undefined: float | None = None
    quantity: str = ""
    sampling: Sampling = "linear"
    within: str = ""
    per_frame: bool = False
    title: str = ""
    colours: Colours = "sequential"
    displayed: str = ""
    overview: bool = True
    included_in: str = ""
    summary: str = ""
    counted: bool = False

    def __post_init__(self) -> None:
        for name, kind in _field_types().items():
            value = getattr(self, name)
            if type(value) is kind:  # texts and flags, the most common types
                continue
            try:
                msgspec.structs.force_setattr(self, name, msgspec.convert(value, kind))
            except msgspec.ValidationError as error:
                raise InputError(_type_problem(name, kind, value, error)) from None
        if not self.dtype:
            msgspec.structs.force_setattr(self, "dtype", "uint8" if self.codes else "float32")
        problem = next((text for check in _CHECKS for text in check(self)), None)
        if problem is not None:
            raise InputError(problem)
        if not self.within:
            within = TABLE[self.quantity].within if self.quantity else "contact"
            msgspec.structs.force_setattr(self, "within", within)

    @property
    def is_integer(self) -> bool:
        """Whether the values are integers."""
        return not self.dtype.startswith("float")

    @property
    def figure_unit(self) -> str:
        """Unit of figures."""
        return self.displayed or _DISPLAYED.get(self.unit, self.unit)

    @property
    def figure_scale(self) -> float:
        """Factor from values to figures."""
        return ratio(self.unit, self.figure_unit)

    @property
    def undefined_value(self) -> float:
        """The value that marks an undefined pixel."""
        return math.nan if self.undefined is None else self.undefined

    def has_answer(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which pixels are defined: none of their components is NaN or the undefined value."""
        defined: NDArray[np.bool_] = np.isfinite(values)
        if self.undefined is not None:
            defined &= values != self.undefined
        return np.asarray(defined.all(axis=-1)) if self.components else defined

    def title_of(self, name: str) -> str:
        """Return the title of the figure of a map of this name."""
        return self.title or name.replace("_", " ").capitalize()

    def deviation(self, name: str) -> Map:
        """Return the declaration of the standard deviation of a map of this name."""
        title = self.title_of(name)
        title = f"{title[:1].lower()}{title[1:]}"
        return Map(
            f"standard deviation of the {title}",
            self.unit,
            axes=self.axes,
            dtype="float64" if self.dtype == "float64" else "float32",
            within=self.within,
            title=f"Standard deviation of the {title}",
            colours="error",
            displayed=self.displayed or ("µm" if self.unit == "mm" else ""),
            overview="height" in (name, self.quantity),
        )

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the map in files: units, and those of the CF conventions."""
        attributes: dict[str, Any] = {"units": self.unit} if self.unit else {}
        if self.caption:
            attributes["long_name"] = self.caption
        if self.codes:
            attributes["flag_values"] = np.array([*self.codes], self.dtype)
            attributes["flag_meanings"] = " ".join(text.replace(" ", "_") for text in self.codes.values())
        return attributes

    def encode(self) -> str:
        """Return the declaration as JSON, for files."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def decode(cls, text: str, where: str) -> Map:
        """Return the declaration written by `encode`.

        Raises
        ------
        InputError
            The text is not a declaration; the message begins with ``where``.
        """
        try:
            if len(text) > LONGEST_DECLARATION:
                raise ValueError(f"it has {len(text)} characters")
            return msgspec.json.decode(text.encode(), type=cls)
        except (msgspec.MsgspecError, ValueError) as error:
            message = " ".join(str(error).split())
            raise InputError(
                f"{where}: the declaration of the map is invalid ({message}). Reconstruct it again"
            ) from error


@functools.cache
def _field_types() -> dict[str, Any]:
    return {field.name: field.type for field in msgspec.structs.fields(Map)}


def _type_problem(name: str, kind: Any, value: Any, error: Exception) -> str:
    """Return why a field has the wrong type."""
    if name == "codes":
        return f"codes of a map are {value!r:.40}: codes are a dictionary of integers and texts"
    if get_origin(kind) is Literal:
        return f"{name} of a map is {value!r:.40}. Use one of {', '.join(get_args(kind))}"
    return f"{name} of a map is invalid: {error}"


def _subject(declaration: Map) -> str:
    """Return the title or caption of a map, for messages about a map whose name is unknown."""
    words = declaration.title or declaration.caption
    return f"the map {words[:60]!r}" if words else "a map"


def _text_problems(declaration: Map) -> Iterator[str]:
    for name in ("caption", "unit", "title", "displayed", "within", "included_in", "summary"):
        if not getattr(declaration, name).isprintable():
            yield f"the {name} of a map has a line break or another control character. Use one line"
    if not all(text.isprintable() for text in declaration.codes.values()):
        yield "a legend has a line break or another control character. Use one line for each code"
    if len(msgspec.json.encode(declaration)) > LONGEST_DECLARATION:
        yield f"the declaration of a map is longer than {LONGEST_DECLARATION} bytes. Shorten its texts"


def _type_problems(declaration: Map) -> Iterator[str]:
    if declaration.dtype not in _DTYPES:
        yield f"the dtype of a map is {declaration.dtype[:40]!r}. Use one of {', '.join(_DTYPES)}"
        return
    numbers = (
        [*declaration.codes] if declaration.undefined is None else [*declaration.codes, declaration.undefined]
    )
    if declaration.is_integer:
        limits = np.iinfo(declaration.dtype)
        wrong = [n for n in numbers if n != int(n) or not limits.min <= n <= limits.max]
        if wrong:
            yield f"{wrong[0]:g} is not a value of {declaration.dtype}. Declare another dtype"
    elif declaration.codes:
        yield f"a map of {declaration.dtype} has codes. Declare a dtype of integers"
    if len(declaration.codes) > _MOST_CODES:
        yield f"a legend has {len(declaration.codes)} codes; at most {_MOST_CODES} are supported"


def _shape_problems(declaration: Map) -> Iterator[str]:
    names = declaration.components
    if names and (declaration.axes != "pixels" or declaration.codes):
        yield "a map has components, but is not a map of vectors: leave axes and codes out"
    if names and not (
        2 <= len(set(names)) == len(names) <= 16 and all(name.isidentifier() for name in names)
    ):
        yield "the components of a map are not 2 to 16 different names"
    if declaration.sampling == "direction" and len(names) != 3:
        yield "a map sampled as a direction needs three components"
    if declaration.sampling == "angle" and (names or declaration.unit != "rad"):
        unit = declaration.unit or "no unit"
        yield f"a map sampled as an angle is in {unit}. Use radians, without components"


def _unit_problems(declaration: Map) -> Iterator[str]:
    subject = _subject(declaration)
    if declaration.displayed and not declaration.unit:
        yield f"{subject} has no unit, but is displayed in {declaration.displayed[:40]}. Declare its unit"
    elif declaration.displayed:
        try:
            ratio(declaration.unit, declaration.displayed)
        except InputError as error:
            yield f"{subject} cannot be displayed: {error}"
    if declaration.quantity and declaration.quantity not in TABLE:
        yield f"the quantity of {subject} is {declaration.quantity[:40]!r}. Use one of {', '.join(TABLE)}"
    elif declaration.quantity:
        yield from conflicts(
            declaration, TABLE[declaration.quantity], f"{subject} of quantity {declaration.quantity}"
        )


_CHECKS = (_text_problems, _type_problems, _shape_problems, _unit_problems)


def conflicts(declaration: Map, other: Map, what: str) -> Iterator[str]:
    """Yield why a declaration cannot replace another, whose unit, axes and components are used by code."""
    for name in ("unit", "axes", "components"):
        wrong, right = getattr(declaration, name), getattr(other, name)
        if wrong != right:
            yield f"{what} has the {name} {wrong or 'none'}. Declare {right or 'none'}"


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


class DisplacementStatus(IntEnum):
    """Codes of ``status`` of a displacement."""

    INVALID_INPUT = 0
    FOUND = 1
    NOT_FOUND = 2
    NO_TEXTURE = 3


class FocusStatus(IntEnum):
    """Codes of ``status`` of a focus stack."""

    INVALID_INPUT = 0
    IN_FOCUS = 1
    NO_PEAK = 2
    PEAK_AT_AN_END = 3


class StitchStatus(IntEnum):
    """Codes of ``status`` of a surface stitched from several touches."""

    NO_HEIGHT = 0
    CONSISTENT = 1
    INCONSISTENT = 2


def status_of(codes: type[IntEnum]) -> Map:
    """Return the declaration of a map ``status`` with the legend of these codes."""
    legend = {int(code): code.name.lower().replace("_", " ") for code in codes}
    return Map("outcome at each pixel", codes=legend, undefined=0, counted=codes is SlipStatus)


def _flag(yes: str, no: str, caption: str, **more: Any) -> Map:
    legend = {0: no, 1: yes}
    return Map(caption, codes=legend, **{"overview": False, **more})


_ALONG = ("x", "y")

TABLE: Mapping[str, Map] = {
    "height": Map(
        "height of the surface; 0 is the sheet at rest, and z points towards the camera",
        "mm",
        within="component",
        summary="height",
    ),
    "status": Map("outcome at each pixel", dtype="uint8", undefined=0),
    "frame": Map(
        "number of the first frame after the event, from 0",
        dtype="int32",
        undefined=-1,
        overview=False,
    ),
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
        summary="slope",
    ),
    "normals": Map(
        "unit normals of the surface",
        components=("x", "y", "z"),
        sampling="direction",
    ),
    "zenith": Map(
        "angle between the normal and the direction to the camera", "rad", overview=False, summary="normals"
    ),
    "azimuth": Map(
        "direction in which the normal leans, counter-clockwise from x",
        "rad",
        title="Azimuth of the normal",
        sampling="angle",
        included_in="normals",
    ),
    "normals_sigma": Map(
        "RMS angle between the estimated and the true normal",
        "rad",
        title="Standard deviation of the normals",
        colours="error",
    ),
    "mean": Map("mean brightness over the turn", "counts", overview=False),
    "cosine": Map("coefficient of the cosine of the phase in the brightness", "counts", overview=False),
    "sine": Map("coefficient of the sine of the phase in the brightness", "counts", overview=False),
    "modulation": Map(
        "amplitude of the brightness over the turn",
        "counts",
        colours="positive",
        included_in="normals",
        summary="modulation",
    ),
    "residual": Map(
        "standard deviation of the brightness that the fit does not explain", "counts", overview=False
    ),
    "edges": _flag(
        "edge",
        "no edge",
        "thin lines where the normal jumps, contact ends or the surface is discontinuous",
        overview=True,
    ),
    "filled": _flag(
        "filled", "measured", "pixels whose height was not measured but interpolated from their surroundings"
    ),
    "contact": _flag(
        "in contact",
        "no lasting contact",
        "pixels where the sheet was in contact in every frame; of a slide or a twist, in the first",
    ),
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
        per_frame=True,
        title="Displacement of the skin",
        displayed="µm",
    ),
    "slip_onset": Map(
        "distance that the body has slid when the skin breaks loose; undefined where it does not",
        "mm",
        title="Onset of slip",
        displayed="µm",
        summary="slip onset",
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
        "share of the contact that sticks; undefined after the body turns back",
        dtype="float64",
        axes="frames",
        summary="stick ratio",
    ),
    "force": Map("normal force at the greatest travel", "N", "float64", "none"),
    "force_x": Map("force along x that the object exerts on the sensor at the end", "N", "float64", "none"),
    "force_y": Map("force along y that the object exerts on the sensor at the end", "N", "float64", "none"),
    "pressure_centre_x": Map(
        "centre of pressure along x; undefined if nothing touches", "mm", "float64", "none"
    ),
    "pressure_centre_y": Map(
        "centre of pressure along y; undefined if nothing touches", "mm", "float64", "none"
    ),
}
"""The maps, series and numbers that built-in operations return, in the order of files and figures."""

_PLACES = {name: place for place, name in enumerate(TABLE)}
_DEVIATIONS = {f"{name}{SIGMA}": declaration.deviation(name) for name, declaration in TABLE.items()}

TWIST: Mapping[str, Map] = {
    "slip_onset": Map(
        "angle that the body has turned when the skin breaks loose; undefined where it does not",
        "rad",
        title="Onset of slip",
        summary="slip onset",
    )
}
"""Declarations that differ from the table's when the body twists."""

IN_PIXELS: Mapping[str, Map] = {"height": msgspec.structs.replace(TABLE["height"], unit=PIXEL)}
"""Declarations that differ from the table's when slopes are integrated without a pixel size."""


def is_deviation(name: str) -> bool:
    """Return whether a name is the name of a standard deviation."""
    return name.endswith(SIGMA) and name != SIGMA


def is_builtin(name: str) -> bool:
    """Return whether the table contains a name: of a map, or of the standard deviation of one."""
    return name in TABLE or (is_deviation(name) and name.removesuffix(SIGMA) in TABLE)


def place_of(name: str) -> tuple[int, bool]:
    """Return a sorting key for the order of the table, with each map before its standard deviation."""
    base = name if name in TABLE else name.removesuffix(SIGMA)
    return _PLACES.get(base, len(_PLACES)), base != name and base in _PLACES


def declaration_of(name: str, declared: Mapping[str, Map] | None = None) -> Map:
    """Return the declaration of a map: the result's own, the built-in one, or an empty one.

    The standard deviation of a declared map needs no declaration.

    Examples
    --------
    >>> declaration_of("slip_onset_sigma").unit
    'mm'
    >>> declaration_of("anything").unit
    ''
    """
    for table in (declared or {}, TABLE):
        if name in table:
            return table[name]
    base = name.removesuffix(SIGMA)
    builtin = TABLE.get(base)
    declaration = (declared or {}).get(base, builtin)
    if declaration is None:
        return UNDECLARED
    return _DEVIATIONS[name] if declaration is builtin else declaration.deviation(base)


UNDECLARED = Map()
"""Declaration of a map without one."""


def check_declarations(declarations: Mapping[str, Map]) -> None:
    """Raise InputError if declarations change the meaning of a built-in name, or two maps have one quantity.

    Only the legend and the texts of a built-in map may differ from the table, and the unit of maps that
    become angles in a twist, or lengths in pixels.
    """
    stands_for: dict[str, str] = {}
    for name, declaration in declarations.items():
        if not isinstance(declaration, Map):
            raise InputError(f"the declaration of {name} is {declaration!r:.40}. Use mirrorskin.io.Map(...)")
        table = TABLE
        for variant in (TWIST, IN_PIXELS):
            if name in variant and declaration.unit == variant[name].unit:
                table = variant
        if name in table:
            for problem in conflicts(declaration, table[name], f"the map {name}"):
                raise InputError(f"{problem}, as the built-in map has, or choose another name")
        if declaration.quantity and declaration.quantity != name:
            other = stands_for.setdefault(declaration.quantity, name)
            if other != name:
                raise InputError(
                    f"both {other} and {name} have the quantity {declaration.quantity}. Leave it out of one"
                )


def check_new(declarations: Mapping[str, Map], others: Container[str] = ()) -> None:
    """Raise InputError if declarations contradict each other, or the names of other maps in one result.

    This is for declarations in programs; declarations in files are read without these checks.
    """
    check_declarations(declarations)
    for name, declaration in declarations.items():
        base, undefined = name.removesuffix(SIGMA), declaration.undefined
        if is_deviation(name) and name not in TABLE and (base in declarations or is_builtin(base)):
            unit = declaration_of(base, declarations).unit
            if declaration.unit != unit:
                raise InputError(
                    f"the map {name} has the unit {declaration.unit or 'none'}, but {base} has the unit "
                    f"{unit or 'none'}. Declare {unit or 'none'}"
                )
        if declaration.codes and undefined is not None and undefined not in declaration.codes:
            codes = ", ".join(map(str, declaration.codes))
            raise InputError(
                f"the map {name} is undefined at {undefined:g}, which is not in its codes ({codes:.100})"
            )
        quantity = declaration.quantity
        if quantity and quantity != name and (quantity in declarations or quantity in others):
            raise InputError(
                f"both {quantity} and {name} have the quantity {quantity}. Leave one of them out"
            )


FIELDS = ("x", "y", "process", "fitted", "calibration", "declarations")
"""Contents of a result other than maps."""

RESERVED = frozenset(
    {*FIELDS, "own_maps", "turn", "height_errors", "units", "legends", "file", "allow_pickle"}
)
"""Names that maps cannot have, because files use them for other purposes."""


def may_name_a_map(name: str) -> bool:
    """Return whether a map can have a name."""
    return str(name).isidentifier() and name not in RESERVED
