"""Calibration files, and the copies in recordings and results: read, write, replace one part.

The layout follows from the parameters that the parts declare.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import FRAME_DTYPES, InputError, ProcessValue
from mirrorskin.io.model.calibrated import check_camera
from mirrorskin.io.model.calibration import (
    PARTS,
    Calibration,
    CameraId,
)
from mirrorskin.io.model.parameters import Parameter, Part, parameters, unit_of
from mirrorskin.io.storage.atomic import Item, fixed_text, process_items, write_file, write_item
from mirrorskin.io.storage.hdf5 import Hdf5File, Node, read_process
from mirrorskin.io.storage.zarr import open_file

MARK, VERSION = "mirrorskin_calibration", 1
"""Attribute of the group that contains a calibration, and the version of the layout."""

ENTRY, CARRIED = "/entry", "/entry/calibration"
"""Group of the calibration in a calibration file, and of the copy in recordings and results."""

_REMEDY = "calibrate again"
T = TypeVar("T")


def open_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, or the copy of a calibration in a recording or a result.

    Raises
    ------
    InputError
        The file does not exist, contains no calibration or one of another version, or is damaged.

    Examples
    --------
    >>> open_calibration("left.h5").lens.pixel_size  # doctest: +SKIP
    (0.03, 0.03)
    """
    with open_file(path) as file:
        if file.marked(MARK):
            return _read(file, ENTRY, str(path))
        carried = carried_by(file)
    if carried is None:
        raise InputError(f"{path} is not a calibration: 'mirrorskin calibrate' creates one")
    return carried


def carried_by(file: Hdf5File) -> Calibration | None:
    """Read the copy of a calibration in a recording or a result; None if it has none."""
    return _read(file, CARRIED, f"the calibration in {file.path}") if file.marked(MARK, CARRIED) else None


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration; the file appears complete or not at all.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> save_calibration(Calibration(CameraId("left", (480, 640), np.dtype(np.uint8))), "left.h5")
    >>> print(open_calibration("left.h5").camera)
    'left', 640 x 480, uint8
    """
    root = Item("/", None, {"NX_class": "NXroot", "default": "entry"})
    write_file(Path(path), [root, *calibration_items(calibration, ENTRY)], replaces="calibration")


def update_calibration(
    path: str | Path, part: Part, camera: CameraId, process: Mapping[str, ProcessValue] | None = None
) -> Calibration:
    """Add a part to a calibration file, or replace it; the file is created if it does not exist.

    Parameters
    ----------
    path : str or Path
    part : References, Lens, WallResponse, LinearResponse, Precession, Gel or Stiffness
    camera : CameraId
        Camera that the part belongs to.
    process : mapping, optional
        Provenance of the part: "sources", "date" and so on. The part's name is added as a prefix.

    Returns
    -------
    Calibration
        The contents of the file after the update.

    Raises
    ------
    InputError
        The file is not a calibration, is one of another camera, or cannot be written.

    Examples
    --------
    >>> from mirrorskin.io import Gel
    >>> camera = CameraId("left", (480, 640), np.dtype(np.uint8))
    >>> update_calibration("left.h5", Gel(threshold=0.3, compliance=0.1), camera).gel.threshold
    0.3
    """
    path = Path(path)
    before = Calibration(camera)
    if path.exists():
        with Hdf5File(path) as file:
            if not file.marked(MARK):
                raise InputError(f"{path} exists and is not a calibration: name another file with -o")
            before = _read(file, ENTRY, str(path))
        check_camera(before, camera, "this", "name another file with -o")
        before = replace(before, camera=camera) if camera.name else before
    name = next(name for name, kind in PARTS.items() if isinstance(part, kind))
    command = part.command
    facts = {key: value for key, value in before.process.items() if not key.startswith(f"{command}.")}
    facts |= {f"{command}.{key.removeprefix(f'{command}.')}": value for key, value in (process or {}).items()}
    changed: dict[str, Any] = {name: part}
    after = replace(before, process=facts, name=str(path), **changed)
    save_calibration(after, path)
    return after


# --- writing ------------------------------------------------------------------------------------------------


def write_calibration(file: h5py.File, calibration: Calibration, place: str) -> None:
    """Write a calibration to the group ``place``, which may exist already."""
    for item in calibration_items(calibration, place):
        write_item(file, item)


def calibration_items(calibration: Calibration, place: str) -> Iterator[Item]:
    """Yield the objects of a calibration in the group ``place``."""
    signals = {part.command: part.signal for part in calibration.parts().values()}
    maps = [name for name, signal in signals.items() if signal]
    default = {"default": maps[0]} if maps else {}
    kind = "NXentry" if place == ENTRY else "NXcollection"
    yield Item(place, None, {"NX_class": kind, MARK: VERSION, **default})
    for name, shown in {"camera": "", **signals}.items():
        signal = {"signal": shown} if shown else {}
        yield Item(f"{place}/{name}", None, {"NX_class": "NXdata" if signal else "NXcollection", **signal})
    yield Item(f"{place}/process", None, {"NX_class": "NXprocess"})
    yield from _datasets(calibration, place)


def size_of(calibration: Calibration) -> int:
    """Return the size of the values of a calibration in bytes."""
    items = _datasets(calibration, "")
    return sum(item.values.nbytes for item in items if isinstance(item.values, np.ndarray))


def _datasets(calibration: Calibration, place: str) -> Iterator[Item]:
    camera = calibration.camera
    yield Item(f"{place}/camera/name", fixed_text(camera.name), {})
    yield Item(f"{place}/camera/shape", np.asarray(camera.shape, np.int64), {})
    yield Item(f"{place}/camera/dtype", fixed_text(np.dtype(camera.dtype).name), {})
    for part in calibration.parts().values():
        yield from _part_items(part, f"{place}/{part.command}", camera)
    yield from process_items(f"{place}/process", calibration.process)


def _part_items(part: Part, place: str, camera: CameraId) -> Iterator[Item]:
    """Yield the objects of a part; ValueError if it does not fit the camera or is inconsistent."""
    sizes = _sizes_of(camera)
    how = parameters(part)
    for name, parameter in how.items():
        value = getattr(part, name)
        if value is None:
            continue
        if parameter.kind == "mapping":
            for key, number in value.items():
                values = np.asarray(number, np.float64)
                yield Item(f"{place}/{name}/{key}", values, _units(unit_of(key, how)))
            continue
        values = _values_of(value, parameter)
        if values.shape != _shape_of(parameter, values.shape, sizes):
            raise ValueError(f"{place}/{name} is of shape {values.shape}: {parameter.shape} is needed")
        image = {"interpretation": "image"} if parameter.kind == "map" else {}
        yield Item(f"{place}/{name}", values, image | _units(parameter.unit))


def record_items(record: Any, place: str) -> Iterator[Item]:
    """Yield the known values of a record that `parameter` declares, in a group if there are any."""
    present = {
        name: parameter for name, parameter in parameters(record).items() if getattr(record, name) is not None
    }
    if present:
        yield Item(place, None, {"NX_class": "NXcollection"})
    for name, parameter in present.items():
        yield Item(f"{place}/{name}", _values_of(getattr(record, name), parameter), _units(parameter.unit))


def read_record(file: Hdf5File, place: str, kind: type[T], remedy: str) -> T:
    """Read what `record_items` writes; InputError with a remedy if a value is damaged."""
    values: dict[str, Any] = {}
    for name, parameter in parameters(kind).items():
        node = file.find(f"{place}/{name}")
        if node is not None:
            values[name] = _read_field(file, node, parameter, {}, remedy)
    return kind(**values)


def _values_of(value: Any, how: Parameter) -> NDArray[Any]:
    if how.kind in ("text", "names"):
        return fixed_text(value)
    if how.kind == "flag":
        return np.asarray(value)
    integer = how.kind in ("integer", "integers")
    return np.ascontiguousarray(value, np.int64 if integer else how.dtype).reshape(np.shape(value))


def _units(unit: str) -> dict[str, str]:
    return {"units": unit} if unit else {}


def _sizes_of(camera: CameraId) -> dict[str, int]:
    return dict(zip(("rows", "columns"), camera.shape, strict=True))


def _shape_of(how: Parameter, shape: tuple[int, ...], sizes: dict[str, int]) -> tuple[int, ...]:
    """Return the required shape of an array; sizes that occur for the first time are taken from its shape."""
    expected = (*shape, *[0] * len(how.shape))
    return tuple(
        size if isinstance(size, int) else sizes.setdefault(size, expected[axis])
        for axis, size in enumerate(how.shape)
    )


# --- reading ------------------------------------------------------------------------------------------------


def _read(file: Hdf5File, place: str, name: str) -> Calibration:
    """Read the calibration in a group; ``name`` is its name in messages."""
    version = file.attribute(place, MARK)
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        kind, remedy = ("a newer", f"update the program, or {_REMEDY}") if newer else ("an older", _REMEDY)
        raise InputError(
            f"{file.path} contains a calibration of {kind} layout, {version}, where {VERSION} is read: "
            f"{remedy}"
        )
    camera = _read_camera(file, f"{place}/camera")
    nodes = {name: file.find(f"{place}/{kind.command}") for name, kind in PARTS.items()}
    parts: dict[str, Any] = {
        name: _read_part(file, node, PARTS[name], camera) for name, node in nodes.items() if node is not None
    }
    return Calibration(camera, **parts, process=read_process(file, f"{place}/process"), name=name)


def _read_camera(file: Hdf5File, place: str) -> CameraId:
    name, shape, dtype = (file.follow(f"{place}/{key}", _REMEDY) for key in ("name", "shape", "dtype"))
    rows, columns = file.read(shape, (2,), remedy=_REMEDY).tolist()
    kind = str(file.value(dtype))
    if not (isinstance(rows, int) and isinstance(columns, int) and rows > 0 and columns > 0):
        raise InputError(
            f"{file.where(shape)} is ({rows}, {columns}), which is not a picture size: {_REMEDY}"
        )
    if kind not in [allowed.name for allowed in FRAME_DTYPES]:
        raise InputError(f"{file.where(dtype)} is {kind!r}, which is not a supported data type: {_REMEDY}")
    return CameraId(str(file.value(name)), (rows, columns), np.dtype(kind))


def _read_part(file: Hdf5File, group: Node, kind: type[Part], camera: CameraId) -> Part:
    """Read one part; parameters with a default may be missing."""
    sizes, how, values = _sizes_of(camera), parameters(kind), dict[str, Any]()
    for name, parameter in how.items():
        node = file.walk(group, name)
        if node is not None:
            values[name] = _read_field(file, node, parameter, sizes)
        elif not parameter.optional:
            raise InputError(f"{file.where(group)} has no {name}: {_REMEDY}")
    return kind(**values)


def _read_field(
    file: Hdf5File, node: Node, how: Parameter, sizes: dict[str, int], remedy: str = _REMEDY
) -> Any:
    value: Any
    if how.kind == "text":
        value = str(file.value(node))
    elif how.kind == "names":
        value = file.texts(node, remedy)
        if (len(value),) != _shape_of(how, (len(value),), sizes):
            raise InputError(
                f"{file.where(node)} has {len(value)} names, others in its group more or less: {remedy}"
            )
    elif how.kind == "mapping":
        value = {
            key: float(file.read(file.follow(f"{node.name}/{key}", remedy), (), remedy=remedy))
            for key in file.names(str(node.name))
        }
    else:
        shape = _shape_of(how, getattr(node, "shape", None) or (), sizes)
        value = file.read(node, shape, unit=how.unit or None, remedy=remedy).astype(how.dtype, copy=False)
        if how.kind == "array" and not np.isfinite(value).all():
            raise InputError(f"{file.where(node)} has numbers that are not finite: {remedy}")
        if how.kind in ("integer", "integers") and not np.isfinite(value).all():
            values = tuple(np.ravel(value).tolist())
            raise InputError(f"{file.where(node)} is {values}, where whole numbers are needed: {remedy}")
        if how.kind == "flag":
            value = bool(value)
        elif how.kind in ("number", "numbers", "integer", "integers"):
            number = int if how.kind.startswith("integer") else float
            value = tuple(map(number, value)) if how.kind.endswith("s") else number(value)
    if how.valid is not None and not how.valid(value):
        raise InputError(f"{file.where(node)} is {value}, which is invalid: {remedy}")
    return value
