"""Result files: the maps of a reconstruction and how they came about."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.hdf5 import Hdf5File
from mirrorskin.io.plain import legible
from mirrorskin.io.types import InputError, Result

MARK = "mirrorskin_result"
_UNITS = {"height": "mm", "height_sigma": "mm"}
_DTYPES = {"status": np.uint8, "x": np.float64, "y": np.float64}
_MAPS = [field.name for field in fields(Result) if field.name not in ("x", "y", "process")]
_RESULT, _PROCESS = "/entry/result", "/entry/process"


def save_result(result: Result, path: str | Path) -> None:
    """Write a result; the file exists whole or not at all.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    maps = result.maps()
    with new_hdf5(Path(path)) as new:
        file = new.root
        file.attrs.update(NX_class="NXroot", default="entry")
        entry = file.create_group("entry")
        entry.attrs.update({"NX_class": "NXentry", "default": "result", MARK: 1})
        data = entry.create_group("result")
        data.attrs.update(NX_class="NXdata", signal=next(iter(maps)), auxiliary_signals=list(maps)[1:])
        for name, values in maps.items():
            data[name] = values
            data[name].attrs["interpretation"] = "image"
            if name in _UNITS:
                data[name].attrs["units"] = _UNITS[name]
        if result.x is not None and result.y is not None:
            data.attrs["axes"] = ["y", "x"]
            for axis, positions in (("x", result.x), ("y", result.y)):
                data[axis] = positions
                data[axis].attrs["units"] = "mm"
        process = entry.create_group("process")
        process.attrs["NX_class"] = "NXprocess"
        for name, value in result.process.items():
            process[name] = legible(value) if isinstance(value, str) else value


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
        process = {
            name: file.value(file.follow(f"{_PROCESS}/{name}", "reconstruct it again"))
            for name in file.names(_PROCESS)
        }
    return Result(**maps, process=process)


def _read_maps(file: Hdf5File) -> dict[str, NDArray[Any]]:
    """Read the maps and axes that are there, all of one size."""
    found = {name: file.find(f"{_RESULT}/{name}") for name in (*_MAPS, "x", "y")}
    found = {name: node for name, node in found.items() if node is not None}
    size = next((getattr(node, "shape", None) for name, node in found.items() if name in _MAPS), None)
    if size is None or len(size) != 2:
        raise InputError(f"{file.path}: {_RESULT} holds no maps: reconstruct it again")
    shapes = {"x": size[1:], "y": size[:1]}
    return {
        name: file.read(node, shapes.get(name, size), remedy="reconstruct it again").astype(
            _DTYPES.get(name, np.float32)
        )
        for name, node in found.items()
    }
