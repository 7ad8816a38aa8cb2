"""Arguments that are arrays in the memory of a device: arrays of `mirrorskin.kernels` and of pyopencl."""

from __future__ import annotations

import sys
from numbers import Real
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike

from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import as_array
from mirrorskin.kernels.array import Array, Operand, adopt
from mirrorskin.kernels.device import Choice, Device, are_several, open_device, opened_devices

AnyArray = Any
"""An array on the host, or a `mirrorskin.kernels.array.Array` on a device."""


def as_any_array(name: str, value: Any, unit: str = "", components: bool = False) -> Any:
    """Return an argument as an array on a device if it is one, otherwise as an array of numbers on the host.

    An array of pyopencl is copied on its device.
    """
    if isinstance(value, Array):
        return value
    if not is_on_device(value):
        return as_array(name, value, unit, components)
    if not value.flags.c_contiguous or 0 in value.shape or value.dtype.kind not in "uif":
        raise InputError(f"{name} is {value.dtype} {value.shape} on a device: numbers in C order are needed")
    owner = next((device for device in opened_devices() if device.context == value.context), None)
    if owner is None:
        raise InputError(
            f"{name} belongs to an OpenCL context that is not mirrorskin's: create it with the queue of "
            "mirrorskin.kernels.device.open_device()"
        )
    return adopt(owner, name, value)


def as_any_array_or_number(name: str, value: Any, unit: str = "") -> Any:
    """Return an argument as `as_any_array` does, or unchanged if it is a number."""
    return value if isinstance(value, Real) else as_any_array(name, value, unit)


def device_of(choice: Choice, *arrays: Any) -> Device:
    """Return the chosen device, by default the arrays' own; InputError if an array is on another one.

    Arrays on the host are on no device.
    """
    on_devices = [array for array in arrays if isinstance(array, Array)]
    if on_devices and are_several(choice):
        raise InputError(
            f"{on_devices[0].name} is on {on_devices[0].device.info.title}, but several devices are chosen:"
            " leave device out to compute there, or pass a NumPy array"
        )
    device = on_devices[0].device if on_devices and choice is None else open_device(choice)
    for array in on_devices:
        if array.device.context != device.context:
            raise InputError(
                f"{array.name} is on {array.device.info.title}, not on {device.info.title}: compute there, "
                "or pass a NumPy array"
            )
    return device


def device_of_maps(choice: Choice, *results: Result) -> Device:
    """Return the chosen device, by default that of the first map of the results that is on one."""
    maps = (result.on_device(name) for result in results for name in result)
    first = next((values for values in maps if isinstance(values, Array)), None)
    return first.device if first is not None and choice is None else open_device(choice)


def operand_of(
    result: Result, quantity: str, dtype: DTypeLike, shape: tuple[int, ...], device: Device
) -> Operand | None:
    """Return a map of a result for kernels, or None if there is none; InputError if its shape differs.

    A map on the device in this type is not copied. Any other is converted on the host, where flags (uint8)
    are 1 for all values but 0.
    """
    name = result.name_of(quantity)
    if name is None:
        return None
    stored = result.on_device(name)
    values = result[name] if stored is None else stored
    map_shape = tuple(getattr(values, "shape", ()))
    if map_shape != shape:
        raise InputError(f"{name} has shape {map_shape}, but the height needs {shape}: give maps of one size")
    if isinstance(stored, Array) and stored.dtype == dtype and stored.device.context == device.context:
        if stored.device is not device and stored.latest is not None:  # kernels of another queue
            stored.device.flush()
            stored.arrived = stored.latest
        return stored
    values = np.asarray(values if stored is None else result[name])
    flags = values != 0 if dtype == np.uint8 else values
    return device.share(name, np.ascontiguousarray(flags, dtype))


def stored_map(result: Result, quantity: str) -> AnyArray:
    """Return a map of a result where it is: on a device, or on the host."""
    stored = result.on_device(quantity)
    return getattr(result, quantity) if stored is None else stored


def viewed(array: AnyArray) -> AnyArray:
    """Return an array of a device that shares the host's memory as an array on the host; others unchanged.

    It is not a copy: use it before kernels use the array.
    """
    shared = isinstance(array, Array) and array.device.info.shares_memory
    return np.from_dlpack(cast(Any, array)) if shared else array


def on_host(value: Any) -> Any:
    """Return an argument that is on a device as an array on the host, any other unchanged."""
    return value.read() if isinstance(value, Array) else value


def is_on_device(value: Any) -> bool:
    """Return whether an argument is an array on a device."""
    of_pyopencl = getattr(sys.modules.get("pyopencl.array"), "Array", Array)
    return isinstance(value, Array | of_pyopencl)
