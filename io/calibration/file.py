"""The layout of a calibration in HDF5: a file's ``/entry``, or the group of one that carries a copy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import new_hdf5
from mirrorskin.io.calibration.source import check_camera
from mirrorskin.io.calibration.types import (
    BITS,
    GROUPS,
    KINDS,
    Calibration,
    CameraId,
    Part,
    Stored,
    optional,
    stored,
    unit_of,
)
from mirrorskin.io.dataset_specs import DatasetSpec as Dataset
from mirrorskin.io.dataset_specs import fixed_text, process_specs, read_process, write_dataset
from mirrorskin.io.hdf5 import Hdf5File, Node
from mirrorskin.io.types import FRAME_DTYPES, InputError, ProcessValue

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
    yield Dataset(f"{place}/camera/name", fixed_text(camera.name), {})
    yield Dataset(f"{place}/camera/shape", np.asarray(camera.shape, np.int64), {})
    yield Dataset(f"{place}/camera/dtype", fixed_text(np.dtype(camera.dtype).name), {})
    for name, part in calibration.parts().items():
        yield from _datasets_of_part(part, f"{place}/{GROUPS[name]}", camera)
    yield from process_specs(f"{place}/process", calibration.process)


def write_calibration(file: h5py.File, calibration: Calibration, place: str) -> None:
    """Write a calibration where it belongs; the group of ``place`` may be there already."""
    for name, attributes in groups_of(calibration, place).items():
        file.require_group(name).attrs.update(attributes)
    for dataset in datasets_of(calibration, place):
        write_dataset(file, dataset)


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
        return fixed_text(value)
    if how.kind == "names":
        told = [fixed_text(one).tobytes() for one in value]
        return np.array(told, h5py.string_dtype("utf-8", max(map(len, told), default=1)))
    whole = how.kind in ("integer", "integers")
    return np.ascontiguousarray(value, np.int64 if whole else how.dtype).reshape(np.shape(value))


def sizes_of(camera: CameraId) -> dict[str, int]:
    """Return the sizes that are known before a part is looked at, by their names."""
    return dict(zip(("rows", "columns"), camera.shape, strict=True))


def shape_of(how: Stored, shape: tuple[int, ...], sizes: dict[str, int]) -> tuple[int, ...]:
    """Return the shape that an array must have, by name."""
    there = (*shape, *[0] * len(how.shape))
    return tuple(
        size if isinstance(size, int) else sizes.setdefault(size, there[axis])
        for axis, size in enumerate(how.shape)
    )


def _units(unit: str | None) -> dict[str, str]:
    return {} if unit is None else {"units": unit}


_AGAIN = "calibrate again"


def read_calibration(file: Hdf5File, place: str, name: str) -> Calibration:
    """Read a calibration."""
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


_FEW = 16


def words_of(part: Part) -> dict[str, str]:
    """Return what each field of a part says: numbers with units, angles in degrees, maps by their median."""
    how = stored(part)
    return {name: said for name, one in how.items() for said in _words(getattr(part, name), one, how)}


def _words(value: Any, how: Stored, others: dict[str, Stored]) -> Iterator[str]:
    """Yield the words for a value, or none."""
    if value is None:
        return
    if how.kind in ("text", "integer"):
        yield str(value)
    elif how.kind == "names":
        yield ", ".join(value)
    elif how.kind == "mapping":
        if value:
            yield ", ".join(f"{name} {_number(one, unit_of(name, others))}" for name, one in value.items())
    elif how.is_map:
        yield _map(value, how.unit)
    elif np.size(value) <= _FEW:
        yield _number(value, how.unit)
    else:
        yield f"{' x '.join(map(str, np.shape(value)))} numbers"


def _map(values: Any, unit: str | None) -> str:
    if unit is None:  # flags
        counts = {name: np.count_nonzero(values & bit) for name, bit in BITS.items()}
        return ", ".join(f"{count} {name}" for name, count in counts.items())
    known = values[np.isfinite(values)]
    lacking = values.size - known.size
    return (_number(np.median(known), unit) if known.size else "no pixel known") + (
        f" (median; {lacking} pixels unknown)" if lacking else " (median)"
    )


def _number(value: Any, unit: str | None) -> str:
    if unit == "rad":
        value, unit = np.degrees(value), "deg"
    told = ", ".join(f"{one:.5g}" for one in np.ravel(value))
    return f"{told} {unit}" if unit else told


_MAKE = "'mirrorskin calibrate' makes one"


def open_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, or the calibration that a recording or a result carries.

    Raises
    ------
    InputError
        There is no such file, it holds no calibration, one of another version, or it is damaged.
    """
    with Hdf5File(Path(path)) as file:
        if file.marked(MARK):
            return read_calibration(file, ENTRY, str(path))
        carried = carried_by(file)
    if carried is None:
        raise InputError(f"{path} is no calibration: {_MAKE}")
    return carried


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration; the file exists whole or not at all.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    with new_hdf5(Path(path)) as new:
        new.root.attrs.update(NX_class="NXroot", default="entry")
        write_calibration(new.root, calibration, ENTRY)


def update_calibration(
    path: str | Path,
    part: Part,
    camera: CameraId,
    process: Mapping[str, ProcessValue] | None = None,
) -> Calibration:
    """Add a part to a calibration file, or replace that part in it; without such a file, make one.

    Parameters
    ----------
    path : str or Path
    part : References, Lens, WallResponse, Precession or Gel
    camera : CameraId
        Which camera the part is of.
    process : mapping, optional
        How the part came about: "sources", "date" and so on. The part's name is put before each.

    Returns
    -------
    Calibration
        What the file holds now.

    Raises
    ------
    InputError
        The file is no calibration, one of another camera, or cannot be written.
    """
    path = Path(path)
    before = _there(path, camera)
    name = next(name for name, kind in KINDS.items() if isinstance(part, kind))
    command = GROUPS[name]
    told = {key: value for key, value in before.process.items() if not key.startswith(f"{command}.")}
    told |= {f"{command}.{key.removeprefix(f'{command}.')}": value for key, value in (process or {}).items()}
    one: dict[str, Any] = {name: part}
    after = replace(before, process=told, name=str(path), **one)
    save_calibration(after, path)
    return after


def _there(path: Path, camera: CameraId) -> Calibration:
    """Return the calibration in a file, or an empty one where there is no file."""
    if not path.exists():
        return Calibration(camera)
    with Hdf5File(path) as file:
        if not file.marked(MARK):
            raise InputError(f"{path} is there and no calibration: name another file with -o")
        before = read_calibration(file, ENTRY, str(path))
    check_camera(before, camera, "this", "name another file with -o")
    return replace(before, camera=camera) if camera.name else before
