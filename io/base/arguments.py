"""Check and convert the arguments of public functions."""

from __future__ import annotations

import difflib
import functools
import inspect
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.samples import order_of, order_of_map, packing_of
from mirrorskin.io.base.threads import computation
from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.units import PLAIN, ratio

P = ParamSpec("P")
R = TypeVar("R")
Check = Callable[[str, Any], Any]
"""Function that takes the name and value of an argument, and returns the value, or a converted one."""

_NUMBERS = "buif"  # kinds of NumPy's types that are numbers
_PROTOCOLS = ("__array__", "__array_interface__", "__array_struct__")
# Of `mirrorskin.io.base.samples.ATTRIBUTES`, those that xarray removes from an array when it applies them.
_PACKING = ("_Unsigned", "_FillValue", "missing_value", "scale_factor", "add_offset")
_COUNTS = ("frames", "reference", "dark", "bright", "zenith_offset")  # arguments whose numbers are counts

_PRESSES = "an option of presses: engine.reconstruct, engine.Press, engine.find_onset"
_ROTATIONS = "an option of rotations: engine.reconstruct, engine.Rotation, engine.estimate_normals"
_POSITIONS = "given to io.open_recording, or with frames in an array to engine.reconstruct"
_ELSEWHERE = {
    **dict.fromkeys(("dark", "bright"), f"{_PRESSES}; or part of a recording or calibration"),
    **dict.fromkeys(("threshold", "hold", "event"), _PRESSES),
    **dict.fromkeys(("zenith_gain", "zenith_offset"), f"{_ROTATIONS}; or part of a calibration"),
    **dict.fromkeys(("travel", "phase", "pixel_size"), _POSITIONS),
    "tilt": f"{_ROTATIONS}; or given to io.open_recording",
    "calibration": "given to engine.reconstruct",
    "device": "given to what computes: engine.reconstruct, engine.find_onset, ...",
}
"""Functions to which an argument belongs, for arguments that are often given to others."""


def unknown_argument(owner: str, name: str, valid: Collection[str], what: str = "argument") -> str:
    """Return a message about an argument or option that a function or a class does not have.

    Examples
    --------
    >>> unknown_argument("find_onset()", "treshold", ["threshold", "hold"])
    'find_onset() has no argument treshold: did you mean threshold?'
    """
    remedy = f"it has {', '.join(valid) or 'none'}"
    if close := nearest(name, valid):
        remedy = f"did you mean {close}?"
    elif what in ("argument", "option") and name in _ELSEWHERE:
        remedy = f"it is {_ELSEWHERE[name]}"
    return f"{owner} has no {what} {name}: {remedy}"


def nearest(name: str, candidates: Iterable[str], similarity: float = 0.75) -> str:
    """Return the name that a misspelt one is likely to mean; empty if none is as similar, from 0 to 1."""
    return next(iter(difflib.get_close_matches(name, list(candidates), n=1, cutoff=similarity)), "")


def checked(**checks: Check) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that checks arguments by functions; None is valid if it is the default.

    Examples
    --------
    >>> @checked(values=as_array, weight=check_number)
    ... def mean(values, weight=1.0):
    ...     return weight * float(np.nanmean(values))
    >>> mean([1, 2, 6]), mean(np.ma.masked_array([1.0, 5.0], [False, True]))
    (3.0, 1.0)
    >>> mean("none")
    Traceback (most recent call last):
    ...
    mirrorskin.io.base.types.InputError: values is 'none': numbers are needed
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        parameters = list(inspect.signature(function).parameters.values())
        places = {parameter.name: index for index, parameter in enumerate(parameters)}
        optional = {parameter.name for parameter in parameters if parameter.default is None}
        argument_checks = [(places[name], name, check) for name, check in checks.items()]
        takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            values: list[Any] = list(args)
            for index, name, check in argument_checks:
                if index < len(values):
                    if values[index] is not None or name not in optional:
                        values[index] = check(name, values[index])
                elif name in kwargs and (kwargs[name] is not None or name not in optional):
                    kwargs[name] = check(name, kwargs[name])
            if (
                kwargs
                and not takes_any
                and (unknown := next((keyword for keyword in kwargs if keyword not in places), ""))
            ):
                raise TypeError(unknown_argument(f"{function.__name__}()", unknown, [*places]))
            with computation():
                return function(*values, **kwargs)

        return call

    return decorate


def as_array(name: str, value: Any, unit: str = "", components: bool = False) -> NDArray[Any]:
    """Return an argument as an array of numbers in this machine's byte order, in the argument's unit.

    Every public function converts its arguments here. An array of numbers is returned unchanged.
    ``components``: whether the last axis of a map is that of a vector's components.
    """
    if type(value) is np.ndarray and value.dtype.kind in _NUMBERS and value.dtype.isnative:
        return value
    if type(value).__module__ == "pyopencl.array":  # np.asarray would treat it as a sequence of arrays
        value = value.get()
    numbers, own_unit = _numbers_and_unit(value.data if _is_labelled(value) else value)
    array = _as_numpy(name, numbers, unit, components)
    if array.dtype.kind not in _NUMBERS:
        remedy = ", as in time - time[0]" if array.dtype.kind == "M" and unit == "s" else ""
        raise InputError(f"{name} is {shown(value)}: numbers are needed{remedy}")
    if isinstance(numbers, np.ma.MaskedArray) and np.any(numbers.mask):
        array = _without_masked(array, np.ma.getmaskarray(numbers), as_nan=name in _COUNTS or bool(unit))
    attributes = _attributes(value)
    stored = {key: attributes[key] for key in _PACKING if key in attributes}
    if stored and (packing := packing_of(stored, array.dtype, name)) is not None:
        array = packing.unpack(array, np.float32 if name in _COUNTS else np.float64)
    if _is_labelled(value):
        array = array.transpose(_order(name, value, components))
    stated = own_unit or (attributes.get("units") if unit not in PLAIN else "")
    factor = _factor(name, stated, unit) if stated else 1.0
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    return array if factor == 1 else array.astype(np.float64) * factor


def _as_numpy(name: str, value: Any, unit: str, components: bool) -> NDArray[Any]:
    """Return an array of any library, or a list of arrays, as an array of NumPy."""
    try:
        if not _is_simple(value):
            value = np.stack([as_array(name, part, unit, components) for part in value])
        array: NDArray[Any] = np.from_dlpack(value) if _has_dlpack_only(value) else np.asarray(value)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # rows of different lengths, or whatever another library raises
        raise InputError(f"{name} is not an array: {_line(error)}") from error
    if array.dtype.kind == "m" and unit == "s":
        array = array.astype("m8[ns]") / np.timedelta64(1, "s")
    return array


def _attributes(value: Any) -> Mapping[Any, Any]:
    """Return the attributes of an array of xarray, pandas, h5py or Zarr."""
    attributes = getattr(value, "attrs", None)
    return attributes if isinstance(attributes, Mapping) else {}


def _is_labelled(value: Any) -> bool:
    """Return whether an argument is an array of xarray, whose dimensions have names."""
    return type(value).__module__.startswith("xarray.") and isinstance(value.dims, tuple)


def _order(name: str, value: Any, components: bool) -> tuple[int, ...]:
    """Return the order of the dimensions of an array of xarray that the argument needs."""
    names = [str(dim) for dim in value.dims]
    if name in ("frames", "samples") and len(names) == 3:
        return order_of(names, name)
    return order_of_map(names, name, components)


def _numbers_and_unit(value: Any) -> tuple[Any, str]:
    """Return the numbers and the unit of a quantity of pint, astropy or unyt; no unit for anything else."""
    if isinstance(value, Real | str | list | tuple) or not callable(getattr(value, "to", None)):
        return value, ""
    unit, numbers = (
        next((part for name in names if (part := getattr(value, name, None)) is not None), None)
        for names in (("units", "unit"), ("magnitude", "value"))
    )
    if unit is None or numbers is None:
        return value, ""
    # The short form of pint is in the table of units; a long one, such as "force_kilogram", may not be.
    return numbers, (f"{unit:~}" if hasattr(unit, "dimensionality") else str(unit)) or "dimensionless"


def _factor(name: str, stated: Any, unit: str) -> float:
    """Return the factor that converts an argument from the unit that it states."""
    try:
        return ratio(stated.decode(errors="replace") if isinstance(stated, bytes) else str(stated), unit)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _is_simple(value: Any) -> bool:
    """Return whether NumPy converts an argument as it is: it contains no other arrays or quantities."""
    if isinstance(value, np.ndarray) and value.dtype == object and value.ndim:
        value = value.tolist()
    if not isinstance(value, list | tuple):
        return True
    kinds = {*map(type, value)}
    if all(issubclass(kind, Real | np.generic | np.ndarray | str | bytes) for kind in kinds):
        return not any(issubclass(kind, np.ndarray) and kind is not np.ndarray for kind in kinds)
    return kinds <= {list, tuple} and all(_is_simple(part) for part in value)


def _has_dlpack_only(value: Any) -> bool:
    return hasattr(value, "__dlpack__") and not any(hasattr(value, protocol) for protocol in _PROTOCOLS)


def _without_masked(array: NDArray[Any], mask: NDArray[np.bool_], as_nan: bool) -> NDArray[Any]:
    """Return an array whose masked values are NaN, or 0 in integers unless these become NaN as well."""
    if array.dtype.kind != "f" and not as_nan:
        return np.where(mask, array.dtype.type(0), array)
    dtype = array.dtype if array.dtype.kind == "f" else np.result_type(array.dtype, np.float32)
    return np.where(mask, dtype.type(np.nan), array.astype(dtype))


def is_array(value: Any) -> bool:
    """Return whether an argument is a whole array, or a list of its parts, and not an iterator over them."""
    whole = isinstance(value, list | tuple | memoryview | bytes | bytearray)
    return whole or any(hasattr(value, protocol) for protocol in (*_PROTOCOLS, "__dlpack__"))


def as_array_or_number(name: str, value: Any, unit: str = "") -> Any:
    """Return an argument as an array of numbers, or unchanged if it is a number."""
    return value if isinstance(value, Real) else as_array(name, value, unit)


def as_pixel_size(name: str, value: Any) -> tuple[float, float]:
    """Return width and height of a pixel, mm, from one number or both.

    Examples
    --------
    >>> as_pixel_size("pixel_size", 0.1)
    (0.1, 0.1)
    """
    size = as_array(name, value, "mm")
    if size.shape not in ((), (2,)):
        raise InputError(f"pixel size {size.tolist()}: one length in mm, or (x, y), is needed")
    width, height = np.broadcast_to(size, 2).tolist()
    return width, height


def check_pixel_size(value: Any) -> tuple[float, float]:
    """Return width and height of a pixel, mm; InputError unless they can be those of a pixel.

    Examples
    --------
    >>> check_pixel_size((0.1, 0.2))
    (0.1, 0.2)
    """
    size = as_pixel_size("pixel_size", value)
    if not all(1e-9 < length < 1e6 for length in size):
        text = value if isinstance(value, Real | tuple | list) else size
        raise InputError(f"pixel size {text}: a length from 1e-9 to 1e6 mm is needed")
    return size


def check_number(name: str, value: Any, unit: str = "") -> Any:
    """Return a number, in the argument's unit; InputError for anything else."""
    if not isinstance(value, Real) and getattr(value, "ndim", None) == 0:
        value = as_array(name, value, unit)[()]
    if not isinstance(value, Real | np.bool_):
        raise InputError(f"{name} is {shown(value)}: a number is needed")
    return value


def in_unit(unit: str, check: Callable[..., Any] = as_array_or_number) -> Check:
    """Return a check of an argument that has a unit; plain numbers are in this unit."""
    return functools.partial(check, unit=unit)


def or_none(check: Check) -> Check:
    """Return a check that also allows None, for arguments where that is not the default."""
    return lambda name, value: None if value is None else check(name, value)


def check_count(name: str, value: Any) -> Any:
    """Return a whole number; InputError for anything else."""
    if not hasattr(value, "__index__") or isinstance(value, bool | np.ndarray):
        raise InputError(f"{name} is {shown(value)}: a whole number is needed")
    return value


def check_flag(name: str, value: Any) -> bool:
    """Return a flag as a bool; InputError for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {shown(value)}: use True or False")
    return bool(value)


def check_kind(kind: type) -> Check:
    """Return a function that refuses an argument of another class of `mirrorskin.io`."""

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, kind):
            raise InputError(f"{name} is {shown(value)}: a mirrorskin.io.{kind.__name__} is needed")
        return value

    return check


def check_path(name: str, value: Any) -> Any:
    """Return a path; InputError for anything else."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} is {shown(value)}: a path is needed")
    return value


def shown(value: Any) -> str:
    """Return a value as a short text, or its type."""
    if value is None or isinstance(value, str | int | float | complex):
        text = repr(value)
        return text if len(text) <= 40 else f"{text[:36]} ..."
    return f"a {type(value).__name__}" + (f" of {value.dtype}" if isinstance(value, np.ndarray) else "")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
