"""Reads a calibration, and believes nothing of it that is not there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.calibration.fields import Stored, optional, stored
from mirrorskin.io.calibration.layout import CARRIED, MARK, VERSION, shape_of, sizes_of
from mirrorskin.io.calibration.types import GROUPS, KINDS, Calibration, CameraId, Part
from mirrorskin.io.hdf5 import Hdf5File, Node
from mirrorskin.io.parts import read_process
from mirrorskin.io.types import FRAME_DTYPES, InputError

_AGAIN = "calibrate again"


def read_calibration(file: Hdf5File, place: str, name: str) -> Calibration:
    """Read a calibration.

    Parameters
    ----------
    file : Hdf5File
    place : str
        Of its group.
    name : str
        What to call it in messages.

    Raises
    ------
    InputError
        It is of another version, damaged, or lacks something.
    """
    _check_version(file, place)
    camera = _read_camera(file, f"{place}/camera")
    found = {one: file.find(f"{place}/{GROUPS[one]}") for one in GROUPS}
    parts: dict[str, Any] = {
        one: _read_part(file, node, KINDS[one], camera) for one, node in found.items() if node is not None
    }
    return Calibration(camera, **parts, process=read_process(file, f"{place}/process"), name=name)


def carried_by(file: Hdf5File) -> Calibration | None:
    """Read the calibration that a recording or a result carries, if it does."""
    if not file.marked(MARK, CARRIED):
        return None
    return read_calibration(file, CARRIED, f"the calibration in {file.path}")


def _check_version(file: Hdf5File, place: str) -> None:
    version = file.attribute(place, MARK)
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        kind, remedy = ("a newer", f"update the program, or {_AGAIN}") if newer else ("an older", _AGAIN)
        raise InputError(
            f"{file.path} holds a calibration of {kind} layout, {version}, where {VERSION} is read: {remedy}"
        )


def _read_camera(file: Hdf5File, place: str) -> CameraId:
    name, shape, dtype = (file.follow(f"{place}/{one}", _AGAIN) for one in ("name", "shape", "dtype"))
    rows, columns = file.read(shape, (2,), remedy=_AGAIN).tolist()
    told = str(file.value(dtype))
    if not (isinstance(rows, int) and isinstance(columns, int) and rows > 0 and columns > 0):
        raise InputError(f"{file.where(shape)} is ({rows}, {columns}), which no picture has: {_AGAIN}")
    if told not in [one.name for one in FRAME_DTYPES]:
        raise InputError(f"{file.where(dtype)} is {told!r}, which no camera here gives: {_AGAIN}")
    return CameraId(str(file.value(name)), (rows, columns), np.dtype(told))


def _read_part(file: Hdf5File, group: Node, kind: type[Part], camera: CameraId) -> Part:
    """Read one part; what has a default may be missing."""
    sizes, may_miss = sizes_of(camera), optional(kind)
    read: dict[str, Any] = {}
    for name, how in stored(kind).items():
        node = file.walk(group, name)
        if node is None and name not in may_miss:
            raise InputError(f"{file.where(group)} has no {name}: {_AGAIN}")
        if node is not None:
            read[name] = _read_field(file, node, how, sizes)
    return kind(**read)


def _read_field(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> Any:
    value = _READERS.get(how.kind, _read_array)(file, node, how, sizes)
    if how.valid is not None and not how.valid(value):
        raise InputError(f"{file.where(node)} is {value}, which cannot be: {_AGAIN}")
    return value


def _read_array(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> NDArray[Any]:
    shape = shape_of(how, getattr(node, "shape", None) or (), sizes)
    values = file.read(node, shape, unit=how.unit, remedy=_AGAIN).astype(how.dtype, copy=False)
    if how.kind == "array" and not how.is_map and not np.isfinite(values).all():
        raise InputError(f"{file.where(node)} has numbers that are not finite: {_AGAIN}")
    return values


def _read_numbers(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> tuple[float, ...]:
    return tuple(_read_array(file, node, how, sizes).tolist())


def _read_integers(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> tuple[int, ...]:
    return tuple(map(int, _finite(file, node, _read_numbers(file, node, how, sizes))))


def _read_number(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> float:
    return float(_read_array(file, node, how, sizes))


def _read_integer(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> int:
    return int(_finite(file, node, (_read_number(file, node, how, sizes),))[0])


def _finite(file: Hdf5File, node: Node, values: tuple[float, ...]) -> tuple[float, ...]:
    if not np.isfinite(values).all():
        raise InputError(f"{file.where(node)} is {values}, where whole numbers are needed: {_AGAIN}")
    return values


def _read_text(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> str:
    return str(file.value(node))


def _read_names(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> tuple[str, ...]:
    texts = file.texts(node, _AGAIN)
    if (len(texts),) != shape_of(how, (len(texts),), sizes):
        raise InputError(
            f"{file.where(node)} has {len(texts)} names, others in its group more or less: {_AGAIN}"
        )
    return texts


def _read_mapping(file: Hdf5File, node: Node, how: Stored, sizes: dict[str, int]) -> dict[str, float]:
    return {
        key: float(file.read(file.follow(f"{node.name}/{key}", _AGAIN), (), remedy=_AGAIN))
        for key in file.names(str(node.name))
    }


_READERS: dict[str, Any] = {
    "number": _read_number,
    "integer": _read_integer,
    "numbers": _read_numbers,
    "integers": _read_integers,
    "text": _read_text,
    "names": _read_names,
    "mapping": _read_mapping,
}
