"""Declarations of the parameters of a calibration.

The layout of files, docstrings, the tables of ``calibrate show`` and of the documentation, and titles of
figures are derived from the declaration.
"""

from __future__ import annotations

import functools
import inspect
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar, dataclass_transform

import numpy as np

from mirrorskin.io.base.units import ratio

Kind = Literal["map", "array", "number", "integer", "flag", "numbers", "integers", "text", "names", "mapping"]

_SHOWN = {"rad": "deg", "pixel": "px", "MPa": "kPa"}  # default units of tables and figures
_KINDS: dict[str, Kind] = {
    "float": "number",
    "int": "integer",
    "bool": "flag",
    "str": "text",
    "Floats": "array",
    "tuple[str, ...]": "names",
    "tuple[float, ...]": "numbers",
    "Mapping[str, float]": "mapping",
}
_FACTORS = {"%": 100.0, "px": 1.0, "deg": math.degrees(1)}  # for units that `ratio` does not convert
_TYPES = {
    "number": "float",
    "integer": "int",
    "flag": "bool",
    "text": "str",
    "names": "tuple of str",
    "numbers": "tuple of float",
    "mapping": "mapping of str to float",
}
_COLUMNS = 100  # maximum length of the lines of a docstring


@dataclass(frozen=True, slots=True)
class Parameter:
    """The declaration of a parameter.

    Attributes
    ----------
    text : str
        Description: a phrase without a full stop. Titles of figures end at its first semicolon.
    unit : str
        Unit in memory and in files; empty for none.
    title : str or None
        Name in tables, by default the name of the parameter; empty to hide it. Vectors whose components have
        no names are hidden as well. ``{}`` is replaced by the name of the component, which otherwise follows.
    shown_unit : str
        Unit of tables and figures, by default degrees for radians and kPa for MPa.
    components : tuple of str
        Names of the components of "numbers" or an "array".
    shape : tuple
        Shape of an array; letters are sizes common to the parameters of a part.
    valid : callable, optional
        Returns whether a value in a file is accepted.
    place : bool
        Whether the first two numbers are relative to the picture's centre.
    convert : callable, optional
        Returns the values shown in tables.
    flags : mapping of str to int
        Bits of a map whose pixels are counted, by name.
    optional : bool
        Whether it may be missing in a file, because it has a default.
    kind : str
        From the annotation: a "map" (NDArray) has one value per pixel of the camera, and is cropped with the
        picture. "numbers", "integers" and "names" are tuples. A "mapping" contains numbers by the names of
        parameters or of their components, in the units of these parameters; in files it is a group.
    dtype : dtype
        Type of a map or an array.
    """

    text: str
    unit: str = ""
    title: str | None = None
    shown_unit: str = ""
    components: Sequence[str] = ()
    shape: tuple[int | str, ...] = ()
    valid: Callable[[Any], bool] | None = None
    place: bool = False
    convert: Callable[[Any], Any] | None = None
    flags: Mapping[str, int] = field(default_factory=dict)
    optional: bool = False
    kind: Kind = "array"
    dtype: np.dtype[Any] = np.dtype(np.float64)  # noqa: RUF009

    def settled(self, annotation: str) -> Parameter:
        """Return the declaration of an attribute with this annotation."""
        annotation = annotation.removesuffix(" | None")
        kind, shape, dtype = _KINDS.get(annotation), self.shape or (len(self.components),), self.dtype
        if annotation.startswith("tuple") and kind is None:
            kind, shape = "integers" if "int" in annotation else "numbers", (annotation.count(",") + 1,)
        elif annotation.startswith("NDArray"):
            kind, shape = "map", ("rows", "columns")
            dtype = np.dtype(annotation.removeprefix("NDArray[np.").removesuffix("]"))
        elif kind not in ("array", "names", "numbers"):
            shape = ()
        hidden = kind in ("array", "numbers", "integers", "names", "mapping") and not self.components
        return replace(
            self,
            kind=kind or "array",
            shape=shape,
            dtype=dtype,
            title="" if hidden else self.title,
            shown_unit=self.shown_unit or _SHOWN.get(self.unit, self.unit),
        )

    @property
    def factor(self) -> float:
        """Factor from values to tables and figures."""
        return _FACTORS.get(self.shown_unit) or ratio(self.unit, self.shown_unit)

    @property
    def size(self) -> str:
        """The shape as text, such as ``(H, W)``; empty for a single value."""
        if self.kind == "map":
            return "(H, W)"
        return str(self.shape).replace("'", "") if self.shape else ""

    def described(self) -> str:
        """Return the type in Python and the unit, such as ``(float, float), mm``."""
        if self.kind in ("map", "array"):
            kind = f"ndarray, {self.size}, {self.dtype.name}"
        elif self.kind in ("numbers", "integers") and isinstance(count := self.shape[0], int):
            kind = f"({', '.join([_TYPES[self.kind[:-1]]] * count)})"
        else:
            kind = _TYPES[self.kind]
        return f"{kind}, {self.unit}" if self.unit else kind


def parameter(text: str, unit: str = "", *, default: Any = MISSING, **options: Any) -> Any:
    """Declare a parameter in the body of a part, by the fields of `Parameter`.

    Files must contain parameters without a default: declare one if older files are to be read.
    """
    declaration = Parameter(text, unit, optional=default is not MISSING, **options)
    if callable(default):
        return field(default_factory=default, metadata={"parameter": declaration})
    return field(default=default, metadata={"parameter": declaration})


class Row(NamedTuple):
    """A number of a calibration, in the units of tables."""

    part: str  # name of its command
    what: str
    value: float | int | str
    sigma: float = math.nan  # standard error; NaN if unknown
    unit: str = ""
    name: str = ""  # of the parameter, and of the component

    @property
    def text(self) -> str:
        """Value, standard error and unit, such as ``2.2918 ± 0.0057 deg``."""
        _, _, value, sigma, unit = self.cells()
        return " ".join(filter(None, (value, f"± {sigma}" if sigma else "", unit)))

    def cells(self) -> tuple[str, str, str, str, str]:
        """Return part, quantity, value, standard error and unit as text, with the significant digits only."""
        if isinstance(self.value, str | int):
            return self.part, self.what, str(self.value), "", self.unit
        if not math.isfinite(self.value):
            return self.part, self.what, "unknown", "", self.unit
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            return self.part, self.what, f"{self.value:.6g}", "", self.unit
        digits = max(0, 1 - math.floor(math.log10(self.sigma)))
        value, sigma = (f"{number:.{digits}f}" for number in (self.value, self.sigma))
        return self.part, self.what, value, sigma, self.unit


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Base of the parts of a calibration."""

    command: ClassVar[str]
    """Name of the part's group in files, and of the command that calibrates it."""

    signal: ClassVar[str] = ""
    """The map that viewers show by default."""

    motion: ClassVar[str] = ""
    """Motion of the recordings that determine the part, if its lengths depend on the pixel size."""

    def standard_errors(self) -> Mapping[str, float]:
        """Return standard errors by the names of parameters, for vectors also with the component."""
        errors: Mapping[str, float] = getattr(self, "sigma", {})
        return errors

    def rows(self) -> Iterator[Row]:
        """Yield the numbers shown in tables; for maps, the medians."""
        errors = self.standard_errors()
        for name, parameter in parameters(self).items():
            title = name.replace("_", " ") if parameter.title is None else parameter.title
            value = getattr(self, name)
            if not title or value is None:
                continue
            if parameter.flags:
                for flag, bit in parameter.flags.items():
                    yield Row(
                        self.command, flag, int(np.count_nonzero(value & bit)), math.nan, "pixels", flag
                    )
                continue
            if parameter.convert is not None:
                value = parameter.convert(value)
            elif parameter.kind == "map":
                value = median(value)
            named = parameter.components or ("",)
            for component, number in zip(named, value if parameter.components else (value,), strict=True):
                what = title.format(component) if "{}" in title else f"{title} {component}".rstrip()
                key = f"{name}_{component}" if component else name
                if isinstance(number, str | int):
                    yield Row(self.command, what, number, name=key)
                    continue
                factor = 1.0 if parameter.convert is not None else parameter.factor
                sigma = errors.get(key, math.nan) * factor
                yield Row(self.command, what, float(number) * factor, sigma, parameter.shown_unit, key)


K = TypeVar("K")
T = TypeVar("T", bound=Part)


def median(values: Any) -> float:
    """Return the median of the pixels that have a value; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(parameter,))
def part(cls: type[T]) -> type[T]:
    """Convert a class whose attributes are declared by `parameter` to a dataclass."""
    return documented(dataclass(frozen=True, slots=True, eq=False)(cls))


def documented(cls: type[K]) -> type[K]:
    """Add the attributes declared by `parameter` to the docstring of a dataclass."""
    lines = ["Attributes", "----------"]
    for name, parameter in parameters(cls).items():
        text = f"{parameter.text[:1].upper()}{parameter.text[1:]}."
        lines += [f"{name} : {parameter.described()}", textwrap.indent(textwrap.fill(text, _COLUMNS), "    ")]
    cls.__doc__ = "\n\n".join([inspect.cleandoc(cls.__doc__ or ""), "\n".join(lines)])
    return cls


def parameters(of: Any) -> dict[str, Parameter]:
    """Return the declarations of a part, or of its class, by name."""
    return _parameters(of if isinstance(of, type) else type(of))


@functools.cache
def _parameters(kind: Any) -> dict[str, Parameter]:
    return {field.name: field.metadata["parameter"].settled(str(field.type)) for field in fields(kind)}


def unit_of(name: str, declared: Mapping[str, Parameter]) -> str:
    """Return the unit of a parameter by its name, with or without the name of a component."""
    parameter = declared.get(name) or declared.get(name.rpartition("_")[0])
    return "" if parameter is None else parameter.unit
