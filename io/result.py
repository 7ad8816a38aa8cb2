"""Result files: the maps of a reconstruction and how they came about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.hdf5 import Hdf5File, Node, Shape
from mirrorskin.io.plain import legible
from mirrorskin.io.types import NO_MAPS, InputError, Result

MARK = "mirrorskin_result"
_UNITS = (
    dict.fromkeys(("height", "height_sigma"), "mm")
    | dict.fromkeys(("zenith", "azimuth", "normal_sigma"), "rad")
    | dict.fromkeys(("mean", "cosine", "sine", "modulation", "residual"), "counts")
)
_DTYPES = (
    dict.fromkeys(("status", "edges", "filled", "contact", "offset_unknown"), np.uint8)
    | {"component": np.int32}
    | dict.fromkeys(("x", "y"), np.float64)
)
_MAPS = [field.name for field in fields(Result) if field.name not in NO_MAPS]
_VECTORS, _OFFSETS = "normals", "offset_unknown"
_RESULT, _PROCESS = "/entry/result", "/entry/process"


def save_result(result: Result, path: str | Path) -> None:
    """Write a result; the file exists whole or not at all.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    with new_hdf5(Path(path)) as new:
        file = new.root
        file.attrs.update(NX_class="NXroot", default="entry")
        entry = file.create_group("entry")
        entry.attrs.update({"NX_class": "NXentry", "default": "result", MARK: 1})
        _write_maps(entry.create_group("result"), result)
        process = entry.create_group("process")
        process.attrs["NX_class"] = "NXprocess"
        for name, value in result.process.items():
            process[name] = legible(value) if isinstance(value, str) else value


def _write_maps(data: h5py.Group, result: Result) -> None:
    """Write the maps, and what a viewer should plot of them unasked.

    What is plotted together must be of one shape, so vectors are not. How to show them is left open: NeXus
    has no word for a picture of vectors, and of one of colours viewers expect numbers from 0 to 1.
    """
    maps = result.maps()
    plotted = [name for name in maps if name != _VECTORS]
    data.attrs["NX_class"] = "NXdata"
    if plotted:
        data.attrs.update(signal=plotted[0], auxiliary_signals=plotted[1:])
    for name, values in maps.items():
        data[name] = values
        if name in plotted:
            data[name].attrs["interpretation"] = "image"
        if name in _UNITS:
            data[name].attrs["units"] = _UNITS[name]
    if result.offset_unknown is not None:
        data[_OFFSETS] = result.offset_unknown
    _write_axes(data, result, maps[plotted[0]].shape if plotted else ())


def _write_axes(data: h5py.Group, result: Result, plotted: Shape) -> None:
    """Write what is known of a plot's axes: the turns, and where the pixels are."""
    axes: dict[str, tuple[NDArray[Any], str | None]] = {}
    if len(plotted) == 3:
        axes["turn"] = np.arange(plotted[0], dtype=np.int32), None
    if result.x is not None and result.y is not None:
        axes |= {"y": (result.y, "mm"), "x": (result.x, "mm")}
    for name, (positions, unit) in axes.items():
        data[name] = positions
        if unit is not None:
            data[name].attrs["units"] = unit
    if axes:
        data.attrs["axes"] = [*axes, *["."] * (len(plotted) - len(axes))]


def open_result(path: str | Path) -> Result:
    """Read a result.

    Raises
    ------
    InputError
        There is no such file, it is no result, or it is damaged.
    """
    path = Path(path)
    with Hdf5File(path) as file:
        if not file.marked(MARK):
            raise InputError(f"{path} is no result: 'mirrorskin reconstruct' makes one from a recording")
        maps = _read_maps(file)
        maps |= _read_offsets(file, maps.get("component"))
        process = {
            name: file.value(file.follow(f"{_PROCESS}/{name}", "reconstruct it again"))
            for name in file.names(_PROCESS)
        }
    return Result(**maps, process=process)


def _read_maps(file: Hdf5File) -> dict[str, NDArray[Any]]:
    """Read the maps and axes that are there, all of one size, or of one for each turn."""
    found = {name: file.find(f"{_RESULT}/{name}") for name in (*_MAPS, "x", "y")}
    found = {name: node for name, node in found.items() if node is not None}
    size = _size_of(found)
    if size is None:
        raise InputError(f"{file.path}: {_RESULT} holds no maps: reconstruct it again")
    shapes = {"x": size[-1:], "y": size[-2:-1], _VECTORS: (*size, 3)}
    return {
        name: file.read(node, shapes.get(name, size), remedy="reconstruct it again").astype(
            _DTYPES.get(name, np.float32)
        )
        for name, node in found.items()
    }


def _read_offsets(file: Hdf5File, component: NDArray[np.int32] | None) -> dict[str, NDArray[Any]]:
    """Read which components have an unknown offset, if that is told: a list, one number a component."""
    node = file.find(f"{_RESULT}/{_OFFSETS}")
    if component is not None and component.min(initial=-1) < -1:
        raise InputError(f"{file.path}: {_RESULT}/component has numbers below -1: reconstruct it again")
    if node is None or component is None:
        return {}
    count = int(component.max(initial=-1)) + 1
    return {_OFFSETS: file.read(node, (count,), remedy="reconstruct it again").astype(_DTYPES[_OFFSETS])}


def _size_of(found: Mapping[str, Node]) -> Shape | None:
    """Return (H, W) or (turns, H, W), the size of the first map, if it is one."""
    for name in _MAPS:
        if name in found:
            shape: Shape = getattr(found[name], "shape", None) or ()
            size = shape[:-1] if name == _VECTORS else shape
            return size if len(size) in (2, 3) else None
    return None
