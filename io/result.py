"""Result files: the maps of a reconstruction, how they came about, and one turn of many."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.arguments import checked
from mirrorskin.io.atomic import Item, fixed_text, process_items, write_file
from mirrorskin.io.calibration.file import CARRIED, calibration_items, carried_by
from mirrorskin.io.hdf5 import Hdf5File, Node, Shape, read_process
from mirrorskin.io.types import NO_MAPS, SCALARS, SERIES, InputError, ProcessValue, Result
from mirrorskin.io.url import is_zarr, path_of
from mirrorskin.io.zarr import open_file

MARK = "mirrorskin_result"
UNITS = (
    dict.fromkeys(("height", "height_sigma", "hysteresis", "hysteresis_sigma"), "mm")
    | dict.fromkeys(("zenith", "azimuth", "normal_sigma", "slope_min", "slope_max"), "rad")
    | {"pressure": "MPa", "traction": "MPa", "growth": "1/mm", "growth_sigma": "1/mm"}
    | dict.fromkeys(("displacement", "displacement_sigma"), "mm")
    | dict.fromkeys(SCALARS, "N")
    | dict.fromkeys(("x", "y"), "mm")
    | dict.fromkeys(("mean", "cosine", "sine", "modulation", "residual"), "counts")
)
_DTYPES = (
    dict.fromkeys(("status", "edges", "filled", "contact", "offset_unknown"), np.uint8)
    | {"component": np.int32, "strokes": np.uint16}
    | dict.fromkeys(("x", "y", *SERIES), np.float64)
)
_MAPS = [field.name for field in fields(Result) if field.name not in NO_MAPS]
_TAKEN = {*NO_MAPS, "turn", "height_errors", "units", "file", "allow_pickle"}  # in files, or to write them
_VECTORS = {"normals": 3, "displacement": 2, "traction": 2}  # and how many components they have
_MOVED, _OFFSETS, _OWN = "displacement", "offset_unknown", "own_maps"
_ALONG_THE_WAY = ("slip_onset", "slip_onset_sigma", "way")
_RESULT, _PROCESS = "/entry/result", "/entry/process"
_AGAIN = "reconstruct it again"


def unit_of(name: str, process: Mapping[str, ProcessValue]) -> str | None:
    """Return the unit of a map, a number or a series of a result; the way of a twist is an angle."""
    if name in _ALONG_THE_WAY:
        return "rad" if process.get("motion") == "twist" else "mm"
    return UNITS.get(name)


def result_of(
    maps: Mapping[str, ArrayLike], shape: tuple[int, int], process: Mapping[str, ProcessValue]
) -> Result:
    """Return a result of copies of maps by name; names that results do not know become ``own_maps``.

    Parameters
    ----------
    maps : mapping of array_like, (H, W), or of vectors as in `Result`
        Those that results know get the type that they have there.
    shape : (int, int)
    process : mapping

    Raises
    ------
    InputError
        A map is of another shape, holds no numbers, or has a name that cannot be.

    Examples
    --------
    >>> result_of({"height": [[0.5, 1.0]], "total": [[7, 8]]}, (1, 2), {}).own_maps["total"].tolist()
    [[7, 8]]
    """
    found: dict[str, NDArray[Any]] = {}
    for name, given in maps.items():
        if not _may_be_own(name):
            taken = ", ".join(sorted(_TAKEN))
            raise InputError(f"a map cannot be called {name!r}: use letters, digits and _, but not {taken}")
        values, size = np.array(given), (*shape, _VECTORS[name]) if name in _VECTORS else shape
        if values.shape != size or values.dtype.kind not in "buif":
            raise InputError(f"map {name} is {values.dtype} {values.shape}: numbers {size} are needed")
        own = np.uint8 if values.dtype.kind == "b" else values.dtype
        found[name] = values.astype(_DTYPES.get(name, np.float32) if name in _MAPS else own, copy=False)
    return with_fields(Result(process=process), found)


def _may_be_own(name: str) -> bool:
    return str(name).isidentifier() and name not in _TAKEN


def with_fields(result: Result, values: Mapping[str, Any]) -> Result:
    """Return a result with other maps and fields; what is no field's name is a map of the user's own."""
    known = {field.name for field in fields(Result)}
    own = {name: one for name, one in values.items() if name not in known}
    return replace(result, **{name: one for name, one in values.items() if name in known}, own_maps=own)


@checked
def save_result(result: Result, path: str | Path) -> None:
    """Write a result; the file exists whole or not at all.

    Parameters
    ----------
    result : Result
    path : str or Path
        HDF5, or ``NAME.zarr``, also at an address such as ``s3://bucket/NAME.zarr``.

    Raises
    ------
    InputError
        It cannot be written there.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import io
    >>> io.save_result(io.Result(height=np.zeros((2, 3), np.float32)), "flat.h5")  # doctest: +SKIP
    """
    target = path_of(path)
    if not is_zarr(target):
        write_file(target, _items(result))
        return
    from mirrorskin.io.zarr_export import save_zarr

    with tempfile.TemporaryDirectory() as folder:
        write_file(Path(folder, "result.h5"), _items(result))
        save_zarr(Path(folder, "result.h5"), target)


def _items(result: Result) -> Iterator[Item]:
    maps = result.maps()
    yield Item("/", None, {"NX_class": "NXroot", "default": "entry"})
    yield Item("/entry", None, {"NX_class": "NXentry", "default": "result", MARK: 1})
    yield Item(_RESULT, None, {"NX_class": "NXdata", **_plot(result, maps)})
    yield Item(_PROCESS, None, {"NX_class": "NXprocess"})
    yield from _map_items(result, maps)
    yield from process_items(_PROCESS, result.process)
    if result.calibration is not None:
        yield from calibration_items(result.calibration, CARRIED)
    if result.height_sigma is not None:
        yield Item(f"{_RESULT}/height_errors", f"{_RESULT}/height_sigma", {})  # where viewers look for them


def _map_items(result: Result, maps: Mapping[str, NDArray[Any]]) -> Iterator[Item]:
    """Yield the maps and a plot's axes: the turns, and where the pixels are."""
    for name, values in maps.items():
        attributes = {} if name in _VECTORS else {"interpretation": "image"}
        yield Item(f"{_RESULT}/{name}", values, attributes | _units(name, result))
    if result.offset_unknown is not None:
        yield Item(f"{_RESULT}/{_OFFSETS}", result.offset_unknown, {})
    if result.own_maps:
        yield Item(f"{_RESULT}/{_OWN}", fixed_text([*result.own_maps]), {})
    for name, value in result.numbers().items():
        yield Item(f"{_RESULT}/{name}", np.asarray(value, np.float64), {"units": UNITS[name]})
    for name, series in result.series().items():
        yield Item(f"{_RESULT}/{name}", series, _units(name, result))
    for name, positions in _axes(result, maps).items():
        yield Item(f"{_RESULT}/{name}", positions, _units(name, result))


def _units(name: str, result: Result) -> dict[str, str]:
    unit = unit_of(name, result.process)
    return {} if unit is None else {"units": unit}


def _axes(result: Result, maps: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    plotted = _plotted(maps)
    axes: dict[str, NDArray[Any]] = {}
    if plotted and maps[plotted[0]].ndim == 3:
        axes["turn"] = np.arange(len(maps[plotted[0]]), dtype=np.int32)
    if result.x is not None and result.y is not None:
        axes |= {"y": result.y, "x": result.x}
    return axes


def _plot(result: Result, maps: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the attributes that make a viewer plot the maps unasked."""
    plotted, axes = _plotted(maps), list(_axes(result, maps))
    plot: dict[str, Any] = {"signal": plotted[0], "auxiliary_signals": plotted[1:]} if plotted else {}
    if axes:
        plot["axes"] = [*axes, *["."] * ((maps[plotted[0]].ndim if plotted else 0) - len(axes))]
    return plot


def _plotted(maps: Mapping[str, NDArray[Any]]) -> list[str]:
    """Name the maps that are plotted together; NeXus has no picture of vectors."""
    return [name for name in maps if name not in _VECTORS]


@checked
def open_result(path: str | Path) -> Result:
    """Read a result.

    Raises
    ------
    InputError
        There is no such file, it is no result, or it is damaged.

    Examples
    --------
    >>> open_result("press-result.h5").height.shape  # doctest: +SKIP
    (480, 640)
    """
    with _opened(path_of(path)) as file:
        maps: dict[str, Any] = {}
        for name, (node, shape) in _find_maps(file).items():
            values = file.read(node, shape, remedy=_AGAIN)
            own = values.dtype if name not in (*_MAPS, "x", "y") else np.float32
            maps[name] = values.astype(_DTYPES.get(name, own), copy=False)
        maps |= _read_offsets(file, maps.get("component"))
        numbers = {name: file.find(f"{_RESULT}/{name}") for name in SCALARS}
        maps |= {
            name: float(file.read(node, (), unit=UNITS[name], remedy=_AGAIN))
            for name, node in numbers.items()
            if node is not None
        }
        for name in SERIES:
            if (node := file.find(f"{_RESULT}/{name}")) is not None:
                series = (getattr(node, "shape", None) or (0,))[:1]
                maps[name] = file.read(node, series, remedy=_AGAIN).astype(np.float64, copy=False)
        _check_frames(path, maps)
        for name, direction in (("x", 1), ("y", -1)):
            if name in maps and not np.all(direction * np.diff(maps[name]) > 0):
                raise InputError(f"{path}: {_RESULT}/{name} does not run as pixels do: {_AGAIN}")
        carried = Result(process=read_process(file, _PROCESS), calibration=carried_by(file))
        return with_fields(carried, maps)


def _check_frames(path: str | Path, maps: Mapping[str, NDArray[Any]]) -> None:
    """Refuse what is known of each frame if it is of different numbers of frames."""
    counts = {name: len(maps[name]) for name in SERIES if name in maps}
    if maps.get(_MOVED, np.empty(0)).ndim == 4:
        counts[_MOVED] = len(maps[_MOVED])
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{name} of {count}" for name, count in counts.items())
        raise InputError(f"{path}: {_RESULT} has values of different numbers of frames ({found}): {_AGAIN}")


def open_process(path: str | Path, *names: str) -> dict[str, ProcessValue]:
    """Read how a result came about, or only some of that; its maps are looked for, and not read.

    What is not there is missing. See ``open_result``.
    """
    with _opened(path_of(path)) as file:
        for node, shape in _find_maps(file).values():
            if getattr(node, "shape", None) != shape:
                raise InputError(f"{file.where(node)} is not of shape {shape}: {_AGAIN}")
        return read_process(file, _PROCESS, names or None)


@contextmanager
def _opened(path: Path) -> Iterator[Hdf5File]:
    with open_file(path) as file:
        if not file.marked(MARK):
            raise InputError(f"{path} is no result: 'mirrorskin reconstruct' makes one from a recording")
        file.check_layout(MARK)
        yield file


def _find_maps(file: Hdf5File) -> dict[str, tuple[Node, Shape]]:
    """Find the maps and axes that are there, and the shapes of a result, or of one for each turn."""
    group = file.find(_RESULT)
    listed = file.find(f"{_RESULT}/{_OWN}")
    own = () if listed is None else filter(_may_be_own, file.texts(listed, _AGAIN))
    names = dict.fromkeys((*_MAPS, *own, "x", "y"))
    found = {} if group is None else {name: file.walk(group, name) for name in names}
    there = {name: node for name, node in found.items() if node is not None}
    size = _size_of(there)
    if size is None:
        raise InputError(f"{file.path}: {_RESULT} holds no maps: {_AGAIN}")
    shapes = {"x": size[-1:], "y": size[-2:-1]}
    shapes |= {name: (*size, components) for name, components in _VECTORS.items()}
    moved: Shape = getattr(there.get(_MOVED), "shape", None) or ()
    if len(moved) == 4 and len(size) == 2:  # of each frame
        shapes[_MOVED] = (moved[0], *shapes[_MOVED])
    return {name: (node, shapes.get(name, size)) for name, node in there.items()}


def _read_offsets(file: Hdf5File, component: NDArray[np.int32] | None) -> dict[str, NDArray[Any]]:
    """Read which components have an unknown offset, if that is known: a list, one number a component."""
    node = file.find(f"{_RESULT}/{_OFFSETS}")
    if component is not None and component.min(initial=-1) < -1:
        raise InputError(f"{file.path}: {_RESULT}/component has numbers below -1: {_AGAIN}")
    if node is None or component is None:
        return {}
    count = int(component.max(initial=-1)) + 1
    return {_OFFSETS: file.read(node, (count,), remedy=_AGAIN).astype(_DTYPES[_OFFSETS])}


def _size_of(found: Mapping[str, Node]) -> Shape | None:
    """Return (H, W) or (turns, H, W), the size of the first map, if it is one."""
    for name in found:
        if name not in ("x", "y"):
            shape: Shape = getattr(found[name], "shape", None) or ()
            size = _size(name, shape)
            return size if len(size) in (2, 3) else None
    return None


def _size(name: str, shape: Shape) -> Shape:
    """Return the size of the result that has a map of a shape: (H, W), or (turns, H, W)."""
    size = shape[:-1] if name in _VECTORS else shape
    return size[-2:] if name == _MOVED else size


def map_shape(result: Result) -> tuple[int, ...]:
    """Return the size of a result's maps: (H, W), or (turns, H, W)."""
    return next((_size(name, values.shape) for name, values in result.maps().items()), (0, 0))


def select_turn(result: Result, turn: int | None) -> Result:
    """Return the maps of one turn, or those of a result that has no turns.

    Parameters
    ----------
    result : Result
    turn : int or None
        Number of the turn, from 0; None of a result whose maps are of all turns together.

    Returns
    -------
    Result
        With maps (H, W); its components are numbered from 0, and its process has the turn.

    Raises
    ------
    InputError
        The result has turns and none is chosen, or it does not have that one.

    Examples
    --------
    >>> turns = Result(zenith=np.zeros((3, 4, 5), np.float32))
    >>> select_turn(turns, 1).zenith.shape
    (4, 5)
    """
    maps, size = result.maps(), map_shape(result)
    if len(size) == 2:
        if turn is not None:
            raise InputError("the maps of this result are not of single turns: leave --turn out")
        return result
    if turn is None or not 0 <= turn < size[0]:
        wrong = "" if turn is None else f", and none of turn {turn}"
        count, most = ("1 turn", "") if size[0] == 1 else (f"{size[0]} turns", f" to {size[0] - 1}")
        raise InputError(f"this result has maps of {count}{wrong}: choose one with --turn 0{most}")
    chosen: dict[str, Any] = {name: values[turn] for name, values in maps.items()}
    if result.component is not None:
        chosen |= _renumbered(result.component[turn], result.offset_unknown)
    return with_fields(result, chosen | {"process": {**result.process, "turn": turn}})


def _renumbered(
    component: NDArray[np.int32], offset_unknown: NDArray[np.uint8] | None
) -> dict[str, NDArray[Any]]:
    """Give the components that one turn has numbers from 0 on."""
    own = np.unique(component[component >= 0])
    numbered = np.where(component >= 0, np.searchsorted(own, component), -1).astype(np.int32)
    if offset_unknown is None:
        return {"component": numbered}
    return {"component": numbered, "offset_unknown": offset_unknown[own]}
