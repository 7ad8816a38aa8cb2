"""Kernels and their references, called with the same arguments by name, and compared."""

from __future__ import annotations

import importlib
import inspect
import itertools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorskin import kernels
from mirrorskin.kernels.device import C_TYPES, Device

FILES = {file.stem: file for file in Path(*kernels.__path__).glob("*/*.cl")}
SOURCES = {name: file.read_text(encoding="utf-8") for name, file in FILES.items()}
KERNELS = {
    name: file
    for file, text in SOURCES.items()
    for name in re.findall(r"__kernel(?: GROUP_SIZE| SUM_GROUP)? void\s+(\w+)", text)
}
"""The file of each kernel."""
CASES: list[Any] = []
"""Names of kernels, functions that return the values of their arguments, and options of `agree`."""

Values = dict[str, Any]
Check = Callable[[Any, Any, Values], None]


def case(name: str, axes: Mapping[str, Any] | None = None, **options: Any) -> Callable[[Any], Any]:
    """Let a function return what a kernel is tested with, for every combination of the axes' values."""

    def add(function: Callable[..., Values]) -> Callable[..., Values]:
        for combination in itertools.product(*(axes or {}).values()):
            chosen = dict(zip(axes or {}, combination, strict=True))
            label = "-".join([name, *map(str, combination)])
            CASES.append(pytest.param(name, function, chosen, options, id=label))
        return function

    return add


def named(names: str, *values: Any) -> Values:
    """Return values by their names, which are divided by spaces."""
    return dict(zip(names.split(), values, strict=True))


def near(rtol: float, atol: float, *, fraction: float = 0.0, of: str = "", inside: Any = ...) -> Check:
    """Return a check: all but a share of the values are close; inside, or where ``of`` is not 0."""

    def check(actual: Any, expected: Any, values: Values) -> None:
        part = values[of] != 0 if of else inside
        off = ~np.isclose(actual[part], expected[part], rtol, atol, equal_nan=True)
        assert np.count_nonzero(off) <= fraction * off.size, np.nanmax(np.abs(actual - expected)[part])

    return check


def agree(
    device: Device,
    name: str,
    values: Values,
    *,
    per: str | Callable[[Device, Values], int] = "picture",
    pairs: str = "",
    returns: str = "",
    rtol: float = 1e-5,
    atol: float = 0.0,
    checks: Mapping[str, Check] | None = None,
) -> None:
    """Run a kernel and its reference, and hold all answers equal.

    Both take their arguments from ``values``. Answers are the arrays that the reference returns, which are
    the kernel's other arguments in their order, or ``returns`` if some of them were given; and all given
    arrays as they are afterwards: what is only read must not change. If the reference returns a number, the
    kernel returns its sum, divided among the items.

    Parameters
    ----------
    values : dict
        Arguments by name. ``macros`` are those of the kernel in addition to ``FRAME``; ``shape`` is that of
        pairs : str
        Arrays that the kernel holds as sums of two float32.
    rtol, atol : float
        Tolerance, the latter as a share of an answer's largest value. Whole numbers and inputs must be equal.
    checks : dict
        Instead of that: what to do with the kernel's and the reference's answer, and all values afterwards.
    """
    values = {key: _rounded(value, key in pairs.split()) for key, value in values.items()}
    rows, columns = values.pop("shape", (1, 1))
    macros, frames = values.get("macros", {}), values.get("frames", values.get("frame"))
    if isinstance(frames, np.ndarray):
        macros = {"FRAME": C_TYPES[frames.dtype.name], "BITS": 8 * frames.itemsize} | macros
    group = 1  # items that share a sum
    if f"__kernel GROUP_SIZE void {name}(" in SOURCES[KERNELS[name]]:
        group = device.layout.group
        macros = {"GROUP": group} | macros
    kernel = device.kernel(KERNELS[name], name, **macros)
    pixels, tile = rows * columns, device.layout.tile
    sizes = {"rows": rows, "columns": columns, "pixels": pixels}
    sizes |= {"stride": pixels + 3, "each": pixels + 3}
    sizes |= {"count": len(values.get("place", frames if isinstance(frames, np.ndarray) else ()))}
    values |= {key: size for key, size in sizes.items() if key in kernel.arguments and key not in values}
    counts = {"picture": -(-pixels // tile), "row": rows * -(-columns // min(tile, 256))}
    counts |= {"whole row": rows * -(-columns // tile)}
    items = counts[per] if isinstance(per, str) else per(device, values)

    file = FILES[KERNELS[name]]
    function = getattr(importlib.import_module(f"mirrorskin.kernels.{file.parent.name}.{file.stem}"), name)
    parameters = inspect.signature(function).parameters
    expected = {key: np.copy(value) for key, value in values.items() if isinstance(value, np.ndarray)}
    answer = function(**{key: expected.get(key, value) for key, value in values.items() if key in parameters})
    answers = answer if isinstance(answer, tuple) else () if answer is None else (answer,)
    others = returns.split() or [key for key in kernel.arguments if key not in values]
    expected |= dict(zip(others, answers, strict=True))

    arrays = {}
    for key in kernel.arguments:
        values_in = values[key] if key in values else _untouched(expected[key], -(-items // group))
        if key == "frames" and max(values.get("each", 0), values.get("stride", 0)) > pixels:
            # The reference sees the pixels of rows.
            values_in = expected[key] = np.pad(values_in, ((0, 0), (0, 3)), constant_values=77)
        if key in pairs.split():
            values_in = np.stack(
                [values_in.astype(np.float32), values_in - values_in.astype(np.float32)], axis=-1
            )
        if isinstance(values_in, np.ndarray):
            kind = np.float32 if values_in.dtype == np.float64 else values_in.dtype
            arrays[key] = device.from_host(key, values_in, kind)
    kernel(items, **{key: arrays[key] if key in arrays else values[key] for key in kernel.arguments}, moved=0)

    for key, array in arrays.items():
        actual, goal = array.read(), expected[key]
        actual = actual.sum(axis=-1, dtype=np.float64) if key in pairs.split() else actual
        if key in (checks or {}):
            checks[key](actual, goal, values | expected)
        elif np.asarray(goal).dtype.kind != "f":
            np.testing.assert_array_equal(actual, goal, err_msg=key)
        else:
            changed = key in others or not np.array_equal(goal, values.get(key, goal), equal_nan=True)
            largest = np.max(np.abs(np.where(np.isfinite(goal), goal, 0.0)), initial=0.0)
            actual = actual if np.ndim(goal) else actual.sum(dtype=np.float64)
            close = (rtol, atol * largest) if changed else (1e-13, 0.0)
            np.testing.assert_allclose(actual, goal, *close, err_msg=key)


def _rounded(value: Any, pair: bool) -> Any:
    """Round numbers and arrays to what a device holds, so that reference and kernel get the same."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and not pair:
        return value.astype(np.float32).astype(np.float64)
    return float(np.float32(value)) if isinstance(value, float) else value


def _untouched(expected: Any, items: int) -> Any:
    """Return an array for an answer that holds what no kernel should leave there."""
    expected = np.asarray(expected)
    return np.full(expected.shape or items, 77 if expected.dtype.kind in "iu" else np.nan, expected.dtype)
