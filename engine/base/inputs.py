"""Conversion of arguments to results: mappings, xarray datasets, files and arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import Fitted, InputError, Result, open_result, pixel_axes
from mirrorskin.io.base.arguments import as_array, check_pixel_size
from mirrorskin.io.model.fitted import taken_from
from mirrorskin.io.model.maps import FIELDS, TABLE, declaration_of
from mirrorskin.io.model.result import in_pixels, map_shape, shape_of, size_of_maps

if TYPE_CHECKING:
    import xarray

Maps: TypeAlias = Union[
    Result, Mapping[str, Any], "xarray.Dataset", "xarray.DataArray", str, os.PathLike[str], ArrayLike
]
"""Arguments that functions of maps accept; see `as_result`."""


def as_result(
    maps: Maps, name: str = "maps", *, quantity: str = "height", pixel_size: ArrayLike | None = None
) -> Result:
    """Return maps of any supported kind as a result.

    Parameters
    ----------
    maps : Result, mapping, xarray.Dataset, path or array_like
        A mapping contains arrays by name, and optionally fields of a result, such as ``x`` and ``y``, and
        numbers, such as ``travel``. A dataset contains maps with the dimensions y and x, which are converted
        to the declared units. A path leads to a result file. An array is the map of ``quantity``.
    name : str
        The argument, for messages.
    quantity : str
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default from ``x`` and ``y`` of the maps, if available. Heights in
        pixels become millimetres.

    Raises
    ------
    InputError
        The argument has no maps, maps of different sizes, or values that are not numbers.

    Examples
    --------
    >>> as_result({"height": [[0.0, 1.0]], "height_sigma": [[0.1, 0.1]]}, pixel_size=0.5).x
    array([-0.25,  0.25])
    >>> as_result(np.zeros((2, 3))).height.shape
    (2, 3)
    """
    result = maps if isinstance(maps, Result) else _converted(maps, name, quantity)
    if pixel_size is None:
        return result
    pixels, size = check_pixel_size(pixel_size), map_shape(result)[-2:]
    if len(size) < 2:  # the caller reports a missing map
        return result
    x, y = pixel_axes((size[0], size[1]), pixels)
    return _in_millimetres(result, pixels).assign(x=x, y=y)


def _in_millimetres(result: Result, pixel_size: tuple[float, float]) -> Result:
    """Return a result whose heights are in millimetres, also if they were in pixels."""
    if not in_pixels(result):
        return result
    if pixel_size[0] != pixel_size[1]:
        raise InputError("slopes were integrated along square pixels: integrate again with this pixel_size")
    scaled = {
        name: None if (values := getattr(result, name)) is None else values * np.float32(pixel_size[0])
        for name in ("height", "height_sigma")
    }
    return result.assign(scaled, declarations={"height": TABLE["height"]})


def is_maps(value: Any) -> TypeGuard[Maps]:
    """Return whether an argument of the type `Maps` contains maps by name; otherwise it is an array."""
    return isinstance(value, Mapping | str | os.PathLike) or hasattr(value, "data_vars")


def required_maps(name: str, maps: Maps, *needed: str, pixel_size: ArrayLike | None = None) -> Result:
    """Return maps as `as_result` does; InputError if a needed one is missing. An array is the first one."""
    result = as_result(maps, name, quantity=needed[0], pixel_size=pixel_size)
    missing = [quantity for quantity in needed if result.name_of(quantity) is None]
    if missing:
        has = ", ".join(result) or "no maps"
        raise InputError(f"{name} has no map {missing[0]}: it has {has}")
    return result


def pixel_size_of(result: Result, name: str, pixel_size: ArrayLike | None = None) -> tuple[float, float]:
    """Return millimetres along x and y of a pixel, as given, or from the result.

    Raises
    ------
    InputError
        Neither is available.
    """
    if pixel_size is not None:
        return check_pixel_size(pixel_size)
    if result.x is None or result.y is None:
        raise InputError(f"{name} has no pixel size: specify pixel_size, in millimetres")
    return spacing(result.x, result.y)


def spacing(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distances of pixel centres along x and y, mm; a single row or column has square pixels."""
    steps = [abs(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else None for axis in (x, y)]
    specified = [float(step) for step in steps if step is not None]
    if not specified:
        raise InputError("the result has a single pixel, so its size is unknown: take more")
    return specified[0], specified[-1]


def _converted(maps: Any, name: str, quantity: str) -> Result:
    """Return maps of another kind as a result."""
    if isinstance(maps, str | os.PathLike):
        return open_result(os.fspath(maps))
    if type(maps).__module__.partition(".")[0] == "xarray":
        dataset = maps if hasattr(maps, "data_vars") else maps.to_dataset(name=maps.name or quantity)
        return of_one_size(Result.from_xarray(dataset), name)
    if isinstance(maps, Mapping):
        return of_one_size(_of_mapping(maps, name), name)
    if maps is None or type(maps) is object:
        raise InputError(
            f"{name} is {maps!r:.40}: a Result, a mapping, a dataset, a path or an array is needed"
        )
    declared = declaration_of(quantity)
    array = as_array(name, maps, declared.unit, bool(declared.components))
    if array.ndim < 2:
        raise InputError(f"{name} has shape {array.shape}: a map (H, W) is needed")
    return Result({quantity: array})


def _of_mapping(maps: Mapping[Any, Any], name: str) -> Result:
    """Return arrays by name as a result; numbers and texts that are not declared go to its process.

    Those that `mirrorskin.io.Fitted` declares, such as ``tilt``, are in its ``fitted``, too.
    """
    from mirrorskin.engine.base.device_arrays import as_any_array  # imports OpenCL, which files do not need

    fields = {key: value for key, value in maps.items() if key in FIELDS and value is not None}
    for axis in fields.keys() & {"x", "y"}:
        fields[axis] = np.asarray(as_array(f"{name}[{axis!r}]", fields[axis], "mm"), np.float64)
    arrays: dict[str, Any] = {}
    process: dict[str, Any] = {}
    for key, value in maps.items():
        if key in fields or value is None:
            continue
        declared = declaration_of(key, fields.get("declarations"))
        values = value
        if not isinstance(value, str):
            values = as_any_array(f"{name}[{key!r}]", value, declared.unit, bool(declared.components))
        if isinstance(values, str) or (not values.ndim and declared.axes != "none"):
            process[key] = values if isinstance(values, str) else values.item()
        else:
            arrays[key] = values if values.ndim else float(values)
    fitted = taken_from(process) | fields.get("fitted", Fitted())
    process |= fields.get("process", {})
    return Result(arrays, **{**fields, "process": process, "fitted": fitted})


def of_one_size(result: Result, name: str) -> Result:
    """Return a result; raise InputError unless its maps have one size."""
    size = map_shape(result)[-2:]
    if len(size) < 2:
        raise InputError(f"the maps of {name} are not of size (H, W)")
    for map_name in result:
        declared = result.declaration(map_name)
        map_size = size_of_maps(declared, shape_of(result, map_name))[-2:]
        if declared.axes == "pixels" and map_size != size:
            raise InputError(
                f"map {map_name} of {name} has size {map_size}, others have {size}: give maps of one size"
            )
    for axis, length in zip("yx", size, strict=True):
        places = getattr(result, axis)
        if places is not None and np.shape(places) != (length,):
            raise InputError(f"{axis} of {name} has shape {np.shape(places)}: ({length},) is needed")
    return result
