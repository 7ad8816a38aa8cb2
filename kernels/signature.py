"""The arguments of kernels, as the driver describes them, so that a launch can name them."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from mirrorskin.kernels.errors import DeviceError

_SCALARS = {
    "char": np.int8, "uchar": np.uint8, "short": np.int16, "ushort": np.uint16, "int": np.int32,
    "uint": np.uint32, "long": np.int64, "ulong": np.uint64, "float": np.float32, "double": np.float64,
}  # fmt: skip

OPTION = "-cl-kernel-arg-info"
"""Compiler option with which the driver keeps names and types of arguments."""

Convert = Callable[[Any], Any]
Signature = list[tuple[str, str]]
"""Names and types in order; a buffer's type ends in ``*``."""


def read_signatures(program: cl.Program) -> dict[str, Signature]:
    """Return the arguments of each kernel of a built program."""
    return {
        kernel.function_name: [_argument(kernel, place) for place in range(kernel.num_args)]
        for kernel in program.all_kernels()
    }


def _argument(kernel: cl.Kernel, place: int) -> tuple[str, str]:
    name, type_name = (
        str(kernel.get_arg_info(place, info))
        for info in (cl.kernel_arg_info.NAME, cl.kernel_arg_info.TYPE_NAME)
    )
    return name.removeprefix("_cl_"), type_name  # PoCL's prefix for the names of OpenCL functions


def converter(argument: str, type_name: str) -> Convert | None:
    """Return a function that converts a number to the type of an argument; None for a buffer.

    A vector, such as float16, is converted from as many numbers.

    Raises
    ------
    DeviceError
        It is neither.
    """
    if type_name.endswith("*"):
        return None
    kind = type_name.replace("unsigned ", "u").rstrip("0123456789")
    length = type_name[len(type_name.rstrip("0123456789")) :]
    scalar = _SCALARS.get(kind)
    if scalar is None:
        raise DeviceError(f"argument {argument} is of type {type_name}: use a number or a __global pointer")
    if length:
        return lambda values: _vector(values, scalar, int(length))
    if issubclass(scalar, np.integer):
        return lambda value: scalar(operator.index(value))
    return scalar


def _vector(values: Any, scalar: Any, length: int) -> NDArray[Any]:
    """Return numbers as a vector argument."""
    vector = np.array(values, scalar)
    if vector.shape != (length,):
        raise TypeError(f"{length} numbers are needed")
    return vector
