"""Result files: the maps of a reconstruction, their declarations, and their provenance."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.arguments import check_flag, check_kind, check_path, checked
from mirrorskin.io.base.system import read_regular, translate_os_errors
from mirrorskin.io.base.types import InputError, ProcessValue
from mirrorskin.io.base.url import ZARR_SUFFIX, is_zarr, path_of
from mirrorskin.io.formats.registry import Format, export_format, format_of_surface, missing_package
from mirrorskin.io.model.fitted import Fitted
from mirrorskin.io.model.maps import (
    SIGMA,
    TABLE,
    TWIST,
    UNDECLARED,
    FocusStatus,
    Map,
    PoseStatus,
    PressStatus,
    ReleaseStatus,
    SlipStatus,
    check_declarations,
    declaration_of,
    is_builtin,
    may_name_a_map,
    status_of,
)
from mirrorskin.io.model.result import Result, map_shape, size_of_maps
from mirrorskin.io.storage.atomic import (
    Item,
    check_hdf5_name,
    check_output,
    fixed_text,
    process_items,
    write_file,
)
from mirrorskin.io.storage.calibration_file import (
    CARRIED,
    calibration_items,
    carried_by,
    read_record,
    record_items,
)
from mirrorskin.io.storage.existing import Replaces
from mirrorskin.io.storage.hdf5 import Hdf5File, Node, Shape, read_process
from mirrorskin.io.storage.layout import RESULT_MARK
from mirrorskin.io.storage.zarr import open_file

ZARR = Format(
    name="Zarr",
    suffixes=(".zarr",),
    content="everything in the file",
    encoder="save_result",
    needs_heights=False,
    writes_itself=True,
    exported=(
        (
            "`.zarr`",
            "[everything in the result's file](#zarr); a folder, or an address",
            "`units`",
            "NaN, and the codes above",
            "`filled`",
            "zarr-python",
        ),
    ),
)
_RESULT, _PROCESS, _FITTED, _OWN = "/entry/result", "/entry/process", "/entry/fitted", "own_maps"
_DECLARATION = "declaration"  # attribute of a map that is not declared in the table
_REMEDY = "reconstruct it again"
_AXES = dict.fromkeys("xy", Map(unit="mm", dtype="float64"))
_LAYOUT = 2  # version of the layout; in layout 1 maps were not declared, and some had other names


@checked(result=check_kind(Result), path=check_path, overwrite=check_flag)
def save_result(result: Result, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a result; the file appears complete or not at all.

    Parameters
    ----------
    result : Result
    path : str or Path
        HDF5, or ``NAME.zarr``, also at an address such as ``s3://bucket/NAME.zarr``.
    overwrite : bool, optional
        Replace an existing result, or another file that can be computed again. A Zarr store is never
        replaced.

    Raises
    ------
    InputError
        The file exists, or cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import io
    >>> io.save_result(io.Result(height=np.zeros((2, 3), np.float32)), "flat.h5")  # doctest: +SKIP
    """
    target = path_of(path)
    if not is_zarr(target):
        write_file(target, _items(result), replaced_by_result(overwrite))
        return
    from mirrorskin.io.files.zarr_export import save_zarr

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        write_file(Path(folder, "result.h5"), _items(result))
        save_zarr(Path(folder, "result.h5"), target)


def _items(result: Result) -> Iterator[Item]:
    yield Item("/", None, {"NX_class": "NXroot", "default": "entry"})
    yield Item("/entry", None, {"NX_class": "NXentry", "default": "result", RESULT_MARK: _LAYOUT})
    yield Item(_RESULT, None, {"NX_class": "NXdata", **_plot(result)})
    yield Item(_PROCESS, None, {"NX_class": "NXprocess"})
    yield from _map_items(result)
    yield from process_items(_PROCESS, result.process)
    yield from record_items(result.fitted, _FITTED)
    if result.calibration is not None:
        yield from calibration_items(result.calibration, CARRIED)
    if result.height_sigma is not None:  # viewers use a dataset of this name for error bars
        yield Item(f"{_RESULT}/height_errors", f"{_RESULT}/{result.name_of(f'height{SIGMA}')}", {})


def _map_items(result: Result) -> Iterator[Item]:
    """Yield the maps, and the axes of a plot: the turns, and the positions of the pixels."""
    for name, values in result.items():
        declared = result.declaration(name)
        attributes = declared.attributes()
        if declared.axes == "pixels" and not declared.components:
            attributes["interpretation"] = "image"
        if name in result.declarations:
            attributes[_DECLARATION] = fixed_text(declared.encode())
        yield Item(f"{_RESULT}/{name}", np.asarray(values), attributes)
    names = [name for name in result if not is_builtin(name)]
    if names:
        yield Item(f"{_RESULT}/{_OWN}", fixed_text(names), {})
    for name, positions in _axes(result).items():
        yield Item(f"{_RESULT}/{name}", positions, {"units": "mm"} if name in _AXES else {})


def _axes(result: Result) -> dict[str, NDArray[Any]]:
    size = map_shape(result)
    axes: dict[str, NDArray[Any]] = {}
    if len(size) == 3:
        axes["turn"] = np.arange(size[0], dtype=np.int32)
    if result.x is not None and result.y is not None:
        axes |= {"y": result.y, "x": result.x}
    return axes


def _plot(result: Result) -> dict[str, Any]:
    """Return the attributes that viewers use to plot the maps; vectors cannot be plotted."""
    plotted = [name for name in result.maps() if not result.declaration(name).components]
    axes = list(_axes(result))
    plot: dict[str, Any] = {"signal": plotted[0], "auxiliary_signals": plotted[1:]} if plotted else {}
    if axes:
        plot["axes"] = [*axes, *["."] * ((result[plotted[0]].ndim if plotted else 0) - len(axes))]
    return plot


@checked(path=check_path)
def open_result(path: str | Path) -> Result:
    """Read a result, or the heights in a surface of another program, such as X3P, SUR or GSF.

    The heights of another program are relative: the sheet at rest is not known. Positions are those of the
    file if it states any, otherwise they are from the picture's centre.

    Raises
    ------
    InputError
        The file does not exist, is neither a result nor a surface, or is damaged.

    Examples
    --------
    >>> open_result("press-result.h5").height.shape  # doctest: +SKIP
    (480, 640)
    """
    form = format_of_surface(path_of(path))
    if form is not None:
        return _surface(path_of(path), form)
    with _opened(path_of(path)) as file:
        stored, declarations = _find_maps(file)
        maps: dict[str, Any] = {}
        _check_frames(path, stored, declarations)
        for name, (node, shape) in stored.items():
            declared = _AXES.get(name) or declaration_of(name, declarations)
            if declared.axes == "pieces" and "component" in stored:
                shape = (int(maps["component"].max(initial=-1)) + 1,)
            values = file.read(node, shape, unit=declared.unit or None, remedy=_REMEDY)
            dtype = values.dtype if declared is UNDECLARED else declared.dtype
            maps[name] = values.astype(dtype, copy=False) if declared.axes != "none" else float(values)
            if name == "component" and maps[name].min(initial=-1) < -1:
                raise InputError(f"{file.where(node)} has numbers below -1: {_REMEDY}")
        for name, direction in (("x", 1), ("y", -1)):
            if name in maps and not np.all(direction * np.diff(maps[name]) > 0):
                raise InputError(f"{path}: {_RESULT}/{name} is not in the order of the pixels: {_REMEDY}")
        process = read_process(file, _PROCESS)
        if _layout(file) < _LAYOUT and "status" in maps:
            declarations |= _status_of_layout_1(maps, process)
        others: dict[str, Any] = {name: maps.pop(name, None) for name in _AXES}
        others |= {"process": process, "fitted": read_record(file, _FITTED, Fitted, _REMEDY)}
        return Result(maps, **others, calibration=carried_by(file), declarations=declarations)


def _surface(path: Path, form: Format) -> Result:
    """Return the surface in a file of another program."""
    content = read_regular(path)
    if missing := missing_package(form):
        raise InputError(f"{path} needs {missing}")
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # heights that are not finite are none
            surface: Result = form.load(form.decoder)(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return surface.assign(process={"format": form.name, **surface.process})


def open_process(path: str | Path, *names: str) -> dict[str, ProcessValue]:
    """Read the provenance of a result, or some values of it; its maps are checked, but not read.

    Missing values are left out. See ``open_result``.
    """
    if format_of_surface(path_of(path)) is not None:
        process = open_result(path).process
        return {name: process[name] for name in names or process if name in process}
    with _opened(path_of(path)) as file:
        for node, shape in _find_maps(file)[0].values():
            if getattr(node, "shape", None) != shape:
                raise InputError(f"{file.where(node)} is not of shape {shape}: {_REMEDY}")
        return read_process(file, _PROCESS, names or None)


@contextmanager
def _opened(path: Path) -> Iterator[Hdf5File]:
    with open_file(path) as file:
        if not file.marked(RESULT_MARK):
            raise InputError(
                f"{path} is not a result: 'mirrorskin reconstruct' computes one from a recording"
            )
        file.check_layout(RESULT_MARK, _LAYOUT)
        yield file


def _layout(file: Hdf5File) -> int:
    layout = file.attribute("/entry", RESULT_MARK)
    return layout if isinstance(layout, int) else 1


Found = dict[str, tuple[Node, Shape]]


def _find_maps(file: Hdf5File) -> tuple[Found, dict[str, Map]]:
    """Find the maps and axes in a file, with their required shapes and their declarations."""
    group = file.find(_RESULT)
    listed = file.find(f"{_RESULT}/{_OWN}")
    listed_names = () if listed is None else filter(may_name_a_map, file.texts(listed, _REMEDY))
    builtin = (builtin_name for name in TABLE for builtin_name in (name, f"{name}{SIGMA}"))
    names = {name: name for name in dict.fromkeys((*builtin, *listed_names, *_AXES))}
    declarations: dict[str, Map] = {}
    if _layout(file) < _LAYOUT:
        motion = file.find(f"{_PROCESS}/motion")
        twist = motion is not None and file.value(motion) == "twist"
        names |= {"normal_sigma": "normals_sigma", "way": "twist_angle" if twist else "slide_distance"}
        declarations |= TWIST if twist else {}
    nodes: dict[str, Node] = {}
    for stored, name in names.items():
        node = None if group is None else file.walk(group, stored)
        if node is not None:
            nodes[name] = node
            text = file.attribute(f"{_RESULT}/{stored}", _DECLARATION)
            if text is not None:
                declarations[name] = Map.decode(str(text), file.where(node))
    try:
        check_declarations(declarations)
    except InputError as error:
        raise InputError(f"{file.path}: {error}") from None
    return _shaped(file, nodes, declarations), declarations


def _shaped(file: Hdf5File, nodes: Mapping[str, Node], declarations: Mapping[str, Map]) -> Found:
    """Return the maps with their required shapes, which follow from the shape of the first one."""
    shapes: dict[str, Shape] = {name: getattr(node, "shape", None) or () for name, node in nodes.items()}
    declared = {name: declaration_of(name, declarations) for name in nodes if name not in _AXES}
    size = next(
        (
            size_of_maps(declaration, shapes[name])
            for name, declaration in declared.items()
            if declaration.axes == "pixels"
        ),
        (),
    )
    if len(size) not in (2, 3):
        raise InputError(f"{file.path}: {_RESULT} contains no maps: {_REMEDY}")
    needed: dict[str, Shape] = {"x": size[-1:], "y": size[-2:-1]}
    for name, declaration in declared.items():
        if declaration.axes == "pixels":
            needed[name] = (*size, len(declaration.components)) if declaration.components else size
            if declaration.per_frame and len(shapes[name]) > len(needed[name]):
                needed[name] = (shapes[name][0], *needed[name])
        else:
            needed[name] = () if declaration.axes == "none" else shapes[name][:1] or (0,)
    return {name: (node, needed[name]) for name, node in nodes.items()}


def _check_frames(path: str | Path, nodes: Found, declarations: Mapping[str, Map]) -> None:
    """Refuse series with different numbers of frames."""
    counts = {}
    for name, (_node, shape) in nodes.items():
        declared = _AXES.get(name) or declaration_of(name, declarations)
        if declared.axes == "frames" or (declared.per_frame and len(shape) == 4):
            counts[name] = shape[0] if shape else 0
    if len(set(counts.values())) > 1:
        each = ", ".join(f"{name} of {count}" for name, count in counts.items())
        raise InputError(f"{path}: {_RESULT} has values of different numbers of frames ({each}): {_REMEDY}")


def _status_of_layout_1(maps: Mapping[str, Any], process: Mapping[str, ProcessValue]) -> dict[str, Map]:
    """Return the declaration of ``status`` in a file of layout 1, derived from its other contents."""
    if "sharpness" in maps:
        return {"status": status_of(FocusStatus)}
    if "estimator" in process:  # a user's own estimator
        return {}
    if "slip_onset" in maps:
        return {"status": status_of(SlipStatus)}
    if "zenith" in maps and "height" not in maps:
        return {"status": status_of(PoseStatus)}
    if "event" in process or "vertical_event" in process:
        released = "release" in (process.get("event"), process.get("vertical_event"))
        return {"status": status_of(ReleaseStatus if released else PressStatus)}
    return {}


_OTHER_FORMATS = {  # suffixes that a result cannot have, with the command that makes one from it
    **dict.fromkeys(("pdf", "svg"), "view"),
    "html": "report",
    **dict.fromkeys(("jpg", "jpeg", "npy", "avi", "mp4", "json", "toml"), ""),
}


def check_result_output(path: Path, *keep: Path | None, overwrite: bool = False) -> None:
    """Raise InputError for a result, HDF5 or Zarr, that could not be written, before any work is done.

    Parameters
    ----------
    path : Path
        File to write, or Zarr store, which must not exist.
    *keep : Path or None
        Inputs; see `check_output`.
    overwrite : bool
        Whether an existing file that can be computed again may be replaced.

    Raises
    ------
    InputError
        See `check_output`; or the suffix belongs to another format.

    Examples
    --------
    >>> check_result_output(Path("result.h5"), Path("press.h5"))  # doctest: +SKIP
    """
    if is_zarr(path) and path.suffix.lower() == ZARR_SUFFIX:
        from mirrorskin.io.files.zarr_export import check_store

        with translate_os_errors(f"{path} cannot be written", "choose another place with -o"):
            check_store(path)
        return
    _check_format(path)
    check_output(path, *keep, replaces=replaced_by_result(overwrite))


def replaced_by_result(overwrite: bool) -> Replaces:
    """Return which existing files a new result may replace."""
    return "derived" if overwrite else "unused"


def _check_format(path: Path) -> None:
    """Raise InputError if the suffix of a result belongs to another format."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix in _OTHER_FORMATS or export_format(path.suffix.lower()) is not None:
        command = _OTHER_FORMATS.get(suffix, "export")
        then = f", then 'mirrorskin {command}' makes .{suffix} of it" if command else ""
        raise InputError(f"{path}: a result is HDF5 (.h5) or Zarr (.zarr): write it so{then}")
    check_hdf5_name(path)
