"""Check and convert the arguments of public functions."""

from __future__ import annotations

import difflib
import functools
import inspect
import os
from collections.abc import Callable, Collection
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.samples import order_of
from mirrorskin.io.types import InputError

P = ParamSpec("P")
R = TypeVar("R")
Check = Callable[[str, Any], Any]
"""Function that takes the name and value of an argument, and returns the value, or a converted one."""

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


def unknown_argument(owner: str, name: str, known: Collection[str], what: str = "argument") -> str:
    """Return a message about an argument or option that a function or a class does not have.

    Examples
    --------
    >>> unknown_argument("find_onset()", "treshold", ["threshold", "hold"])
    'find_onset() has no argument treshold: did you mean threshold?'
    """
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    remedy = f"it has {', '.join(known) or 'none'}"
    if close:
        remedy = f"did you mean {close[0]}?"
    elif name in _ELSEWHERE:
        remedy = f"it is {_ELSEWHERE[name]}"
    return f"{owner} has no {what} {name}: {remedy}"


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
    mirrorskin.io.types.InputError: values is 'none': numbers are needed
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        parameters = list(inspect.signature(function).parameters.values())
        places = {one.name: index for index, one in enumerate(parameters)}
        optional = {one.name for one in parameters if one.default is None}
        known = [(places[name], name, check) for name, check in checks.items()]
        takes_any = any(one.kind is one.VAR_KEYWORD for one in parameters)

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            given: list[Any] = list(args)
            for index, name, check in known:
                if index < len(given):
                    if given[index] is not None or name not in optional:
                        given[index] = check(name, given[index])
                elif name in kwargs and (kwargs[name] is not None or name not in optional):
                    kwargs[name] = check(name, kwargs[name])
            if (
                kwargs
                and not takes_any
                and (unknown := next((one for one in kwargs if one not in places), ""))
            ):
                raise TypeError(unknown_argument(f"{function.__name__}()", unknown, [*places]))
            return function(*given, **kwargs)

        return call

    return decorate


def as_array(name: str, value: Any) -> NDArray[Any]:
    """Return an argument as an array of numbers; an array of numbers is returned unchanged.

    Masked values become NaN (frames and references of integers then become float32), or 0 in other maps of
    integers. Arrays on a device are copied to the host. Frames of xarray are transposed to (T, H, W) if their
    dimensions are in another order.
    """
    if type(value) is np.ndarray and value.dtype.kind in "buif":
        return value
    if type(value).__module__ == "pyopencl.array":  # np.asarray would treat it as a sequence of arrays
        value = value.get()
    if name == "frames" and type(value).__module__.startswith("xarray.") and value.ndim == 3:
        value = value.to_numpy().transpose(order_of([str(one) for one in value.dims], name))
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
    if name in _COUNTS:
        return np.where(mask, np.float32(np.nan), array.astype(np.float32))
    return np.where(mask, array.dtype.type(0), array)


def as_array_or_number(name: str, value: Any) -> Any:
    """Return an argument as an array of numbers, or unchanged if it is a number."""
    return value if isinstance(value, Real) else as_array(name, value)


def check_number(name: str, value: Any) -> Any:
    """Return a number; InputError for anything else."""
    scalar = isinstance(value, np.ndarray | np.generic) and not value.ndim and value.dtype.kind in "buif"
    if not (scalar or isinstance(value, Real)):
        raise InputError(f"{name} is {shown(value)}: a number is needed")
    return value


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
