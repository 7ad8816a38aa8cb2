"""The layout of a calibration in HDF5: a file's ``/entry``, or the group of one that carries a copy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.calibration.fields import Stored, stored, unit_of
from mirrorskin.io.calibration.types import GROUPS, Calibration, CameraId, Part
from mirrorskin.io.parts import Part as Dataset
from mirrorskin.io.parts import parts_of_process, text_of, write_part

MARK, VERSION = "mirrorskin_calibration", 1
"""The attribute of the group that holds a calibration, and the layout that is written and read here."""

ENTRY, CARRIED = "/entry", "/entry/calibration"
"""Where a calibration file has it, and where recordings and results have a copy."""

# The maps that a viewer shows unasked, of the groups that have maps.
_SIGNALS = {"references": "bright", "zenith": "zenith_sigma"}


def groups_of(calibration: Calibration, place: str) -> dict[str, dict[str, Any]]:
    """Return the groups that hold a calibration, outer ones first, and their attributes."""
    parts = [GROUPS[name] for name in calibration.parts()]
    shown = [name for name in parts if name in _SIGNALS]
    default = {"default": shown[0]} if shown else {}
    kind = "NXentry" if place == ENTRY else "NXcollection"
    groups: dict[str, dict[str, Any]] = {place: {"NX_class": kind, MARK: VERSION, **default}}
    for name in ("camera", *parts):
        signal = {"signal": _SIGNALS[name]} if name in _SIGNALS else {}
        groups[f"{place}/{name}"] = {"NX_class": "NXdata" if signal else "NXcollection", **signal}
    groups[f"{place}/process"] = {"NX_class": "NXprocess"}
    return groups


def datasets_of(calibration: Calibration, place: str) -> Iterator[Dataset]:
    """Yield all that is in these groups."""
    camera = calibration.camera
    yield Dataset(f"{place}/camera/name", text_of(camera.name), {})
    yield Dataset(f"{place}/camera/shape", np.asarray(camera.shape, np.int64), {})
    yield Dataset(f"{place}/camera/dtype", text_of(np.dtype(camera.dtype).name), {})
    for name, part in calibration.parts().items():
        yield from _datasets_of_part(part, f"{place}/{GROUPS[name]}", camera)
    yield from parts_of_process(f"{place}/process", calibration.process)


def write_calibration(file: h5py.File, calibration: Calibration, place: str) -> None:
    """Write a calibration where it belongs; the group of ``place`` may be there already."""
    for name, attributes in groups_of(calibration, place).items():
        file.require_group(name).attrs.update(attributes)
    for dataset in datasets_of(calibration, place):
        write_part(file, dataset)


def size_of(calibration: Calibration) -> int:
    """Return how many bytes its values have."""
    return sum(dataset.values.nbytes for dataset in datasets_of(calibration, ""))


def _datasets_of_part(part: Part, place: str, camera: CameraId) -> Iterator[Dataset]:
    """Yield what a part holds; one that does not fit the camera or itself is a mistake of the caller."""
    sizes = sizes_of(camera)
    how = stored(part)
    for name, one in how.items():
        value = getattr(part, name)
        if value is None:
            continue
        if one.kind == "mapping":
            for key, entry in value.items():
                unit = _units(unit_of(key, how))
                yield Dataset(f"{place}/{name}/{key}", np.asarray(entry, np.float64), unit)
            continue
        values = _values_of(value, one)
        if values.shape != shape_of(one, values.shape, sizes):
            raise ValueError(f"{place}/{name} is of shape {values.shape}: {one.shape} is needed")
        image = {"interpretation": "image"} if one.is_map else {}
        yield Dataset(f"{place}/{name}", values, image | _units(one.unit))


def _values_of(value: Any, how: Stored) -> NDArray[Any]:
    if how.kind == "text":
        return text_of(value)
    if how.kind == "names":
        told = [text_of(one).tobytes() for one in value]
        return np.array(told, h5py.string_dtype("utf-8", max(map(len, told), default=1)))
    whole = how.kind in ("integer", "integers")
    return np.ascontiguousarray(value, np.int64 if whole else how.dtype).reshape(np.shape(value))


def sizes_of(camera: CameraId) -> dict[str, int]:
    """Return the sizes that are known before a part is looked at, by their names."""
    return dict(zip(("rows", "columns"), camera.shape, strict=True))


def shape_of(how: Stored, shape: tuple[int, ...], sizes: dict[str, int]) -> tuple[int, ...]:
    """Return the shape that an array must have, by name.

    Parameters
    ----------
    how : Stored
    shape : tuple of int
        The one that it has.
    sizes : dict
        Those that are known; a size that is met here first is taken from ``shape`` and remembered.
    """
    there = (*shape, *[0] * len(how.shape))
    return tuple(
        size if isinstance(size, int) else sizes.setdefault(size, there[axis])
        for axis, size in enumerate(how.shape)
    )


def _units(unit: str | None) -> dict[str, str]:
    return {} if unit is None else {"units": unit}
