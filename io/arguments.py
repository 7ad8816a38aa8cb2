"""Check and convert the arguments of public functions, according to their annotations."""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.types import InputError

_ARRAYS = ("ArrayLike", "NDArray", "Floats", "Doubles", "Mask")

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Check the arguments of a function against its annotations, and convert array-likes to arrays.

    Arguments annotated ``ArrayLike`` or ``NDArray`` may be lists and the like; they are converted to arrays
    and must hold numbers. Masked values become NaN (frames of integers then become float32), or 0 in maps of
    integers, such as contact. For ``float``, ``int``, ``bool``, a path, ``Result`` and ``Truth`` the type
    must match. Other annotations are not checked.

    Raises
    ------
    InputError
        An argument has another type; the message names it.

    Examples
    --------
    >>> @checked
    ... def mean(values: ArrayLike, weight: float = 1.0) -> float:
    ...     return weight * float(np.nanmean(values))
    >>> mean([1, 2, 6]), mean(np.ma.masked_array([1.0, 5.0], [False, True]))
    (3.0, 1.0)
    >>> mean("none")
    Traceback (most recent call last):
    ...
    mirrorskin.io.types.InputError: values is 'none': numbers are needed
    """
    checks = []
    for index, parameter in enumerate(inspect.signature(function).parameters.values()):
        kinds = [part.strip() for part in str(parameter.annotation).split("|")]
        check = _check_of(kinds)
        if check is not None:
            checks.append((index, parameter.name, check, "None" in kinds))

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        places: list[Any] = list(args)
        for index, name, check, optional in checks:
            if index < len(places):
                if places[index] is not None or not optional:
                    places[index] = check(name, places[index])
            elif name in kwargs and (kwargs[name] is not None or not optional):
                kwargs[name] = check(name, kwargs[name])
        return function(*places, **kwargs)

    return call


def _check_of(kinds: list[str]) -> Callable[[str, Any], Any] | None:
    """Return a function that checks an argument of some annotation, given as source text split at "|"."""
    first = kinds[0].split("[")[0]
    if first in _ARRAYS:
        words = [kind for kind in kinds[1:] if kind not in ("None", "float")]
        if not words:
            return _as_array_or_number if first == "ArrayLike" else as_array
        if all(kind.startswith("Literal") for kind in words):
            return functools.partial(_as_array_or_word, set(re.findall(r"[\w-]+", " ".join(words))))
        return None
    if kinds in (["float"], ["float", "None"]):
        return _check_number
    if kinds in (["int"], ["int", "None"]):
        return _check_count
    if kinds == ["bool"]:
        return check_flag
    if first in ("Result", "Truth") and len(kinds) == 1:
        return functools.partial(_check_kind, first)
    return _check_path if kinds == ["str", "Path"] else None


def as_array(name: str, value: Any) -> NDArray[Any]:
    """Return an argument as an array of numbers; see `checked`. An array is returned unchanged."""
    if type(value) is np.ndarray and value.dtype.kind in "buif":
        return value
    masked = isinstance(value, np.ma.MaskedArray)
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:  # rows of different lengths
        raise InputError(f"{name} is not an array: {_line(error)}") from error
    if array.dtype.kind not in "buif":
        raise InputError(f"{name} is {shown(value)}: numbers are needed")
    mask = np.ma.getmaskarray(value) if masked else None
    if mask is None or not mask.any():
        return array
    if array.dtype.kind == "f":
        return np.where(mask, array.dtype.type(np.nan), array)
    if name == "frames":
        return np.where(mask, np.float32(np.nan), array.astype(np.float32))
    return np.where(mask, array.dtype.type(0), array)


def _as_array_or_number(name: str, value: Any) -> Any:
    return value if isinstance(value, Real) else as_array(name, value)


def _as_array_or_word(words: set[str], name: str, value: Any) -> Any:
    return value if isinstance(value, str) and value in words else _as_array_or_number(name, value)


def _check_number(name: str, value: Any) -> Any:
    scalar = isinstance(value, np.ndarray | np.generic) and not value.ndim and value.dtype.kind in "buif"
    if not (scalar or isinstance(value, Real)):
        raise InputError(f"{name} is {shown(value)}: a number is needed")
    return value


def _check_count(name: str, value: Any) -> Any:
    if not hasattr(value, "__index__") or isinstance(value, bool | np.ndarray):
        raise InputError(f"{name} is {shown(value)}: a whole number is needed")
    return value


def check_flag(name: str, value: Any) -> bool:
    """Return a flag as a bool, or raise InputError if it is something else."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {shown(value)}: use True or False")
    return bool(value)


def _check_kind(kind: str, name: str, value: Any) -> Any:
    if not any(one.__name__ == kind for one in type(value).__mro__):
        raise InputError(f"{name} is {shown(value)}: a mirrorskin.io.{kind} is needed")
    return value


def _check_path(name: str, value: Any) -> Any:
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
