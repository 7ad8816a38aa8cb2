"""Display of results: as text, in a notebook, and as an xarray dataset."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.arguments import as_array, unknown_argument
from mirrorskin.io.base.findings import warnings_in
from mirrorskin.io.base.opencv import encode
from mirrorskin.io.base.types import InputError
from mirrorskin.io.model.fitted import Fitted, taken_from
from mirrorskin.io.model.maps import FILLED_SHADES, Map, declaration_of, may_name_a_map

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from mirrorskin.io.files.recording import Recording
    from mirrorskin.io.model.result import MapContainer, Result

_PICTURE = 480  # maximum length of the longer side of a picture, pixels


def as_text(result: MapContainer) -> str:
    """Return the maps of a result with shape, unit and range, one per line."""
    lines = [f"{name:<14}{shape:<16}{values}" for name, shape, values in _rows(result)]
    lines += [f"warning: {text}" for text in warnings_in(getattr(result, "process", {}))]
    return "\n".join([f"{type(result).__name__}{_origin(result)}", *(f"  {line}" for line in lines)])


def as_html(result: MapContainer) -> str:
    """Return a table of the maps, and a picture of the height, or of the first other map."""
    rows = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in _rows(result)
    )
    shown = _first(result)
    unit = "" if shown is None else _unit(shown, result)
    filled = None if shown is None else _filled(result, shown)
    picture = "" if shown is None else _picture(shown, result.maps()[shown], unit, filled)
    title = f"<p><b>{type(result).__name__}</b>{escape(_origin(result))}</p>"
    title += "".join(
        f"<p><b>Warning:</b> {escape(text)}</p>" for text in warnings_in(getattr(result, "process", {}))
    )
    return f"{title}<div style='display:flex;gap:2em'>{picture}<table>{rows}</table></div>"


def recording_as_text(recording: Recording) -> str:
    """Return a description of a recording in one line."""
    count, rows, columns = recording.shape
    size = recording.header.pixel_size
    parts = [f"{count} frames of {columns} x {rows} {recording.dtype}", f"{recording.motion} motion"]
    parts += [] if size is None else [f"pixels of {size[0]:.4g} x {size[1]:.4g} mm"]
    return f"Recording {recording.name}: {', '.join([*parts, recording.state])}"


def recording_as_html(recording: Recording) -> str:
    """Return a description of a recording, and its last frame."""
    picture = _picture("last frame", recording.frame(recording.shape[0] - 1), "counts")
    return f"<p>{escape(recording_as_text(recording))}</p>{picture}"


def plot(result: MapContainer, name: str | None, axes: Axes | None) -> Axes:
    """Draw a map; see `MapContainer.plot`."""
    import matplotlib.pyplot as plt

    maps = result.maps()
    chosen = _first(result) if name is None else name
    if chosen not in maps or maps[chosen].ndim != 2:
        pictures = [map_name for map_name, values in maps.items() if values.ndim == 2]
        raise InputError(unknown_argument("the result", str(chosen), pictures, "picture"))
    x, y = (getattr(result, axis, None) for axis in "xy")
    extent = None
    if x is not None and y is not None:
        a, b = ((axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5 for axis in (x, y))
        extent = (x[0] - a, x[-1] + a, y[-1] + b, y[0] - b)
    axes = plt.subplots()[1] if axes is None else axes
    image = axes.imshow(maps[chosen], extent=extent, interpolation="nearest")
    filled = _filled(result, chosen)
    if filled is not None:
        from matplotlib.colors import LinearSegmentedColormap

        shades = LinearSegmentedColormap.from_list("filled", FILLED_SHADES)
        marked = np.ma.masked_where(~filled, maps[chosen])
        axes.imshow(marked, shades, extent=extent, interpolation="nearest", clim=image.get_clim())
        axes.set_title(_filled_note(filled), fontsize="medium")
    places = ("column", "row") if extent is None else ("x [mm]", "y [mm]")
    axes.set(xlabel=places[0], ylabel=places[1])
    label = f"{chosen} {_unit(chosen, result)}".strip()
    axes.figure.colorbar(image, ax=axes).set_label(label, parse_math=False)  # a name may have a "$"
    return axes


_DECLARATION = "declaration"  # attribute of a variable that is not declared in the table
_FITTED = "fitted"  # attribute of a dataset of ours


def as_xarray(result: Result, shape: tuple[int, ...]) -> xarray.Dataset:
    """Return the maps as an `xarray.Dataset`; see `Result.to_xarray`."""
    import xarray

    data: dict[str, Any] = {}
    coordinates: dict[str, Any] = {
        name: (name, values, {"units": "mm"})
        for name, values in (("x", result.x), ("y", result.y))
        if values is not None
    }
    lead = ("turn",) if len(shape) == 3 else ()
    for name, values in result.items():
        declared = result.declaration(name)
        dimensions, components = _dimensions(declared, np.ndim(values), lead)
        attributes = declared.attributes()
        if name in result.declarations:
            attributes[_DECLARATION] = declared.encode()
        data[name] = (dimensions, values, attributes)
        coordinates |= components
    extra = {_FITTED: result.fitted.encode()} if result.fitted.values() else {}
    return xarray.Dataset(data, coordinates, attrs={**result.process, **extra})


def _dimensions(
    declared: Map, count: int, lead: tuple[str, ...]
) -> tuple[tuple[str, ...], dict[str, list[str]]]:
    """Return the dimensions of a variable, and the coordinate that names the components of a vector."""
    if declared.axes != "pixels":
        return {"frames": ("frame",), "pieces": ("components",), "none": ()}[declared.axes], {}
    vector = bool(declared.components)
    frames = ("frame",) if declared.per_frame and count - len(lead) == 3 + vector else ()
    if not vector:
        return (*frames, *lead, "y", "x"), {}
    name = {("x", "y", "z"): "vector", ("x", "y"): "direction"}.get(declared.components)
    name = name or "_".join(declared.components)
    return (*frames, *lead, "y", "x", name), {name: [*declared.components]}


def from_xarray(dataset: xarray.Dataset) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return maps and more of a result from a dataset of `as_xarray`, or another with coordinates and units.

    Rows are sorted as in a picture: y decreases. Values are converted to the declared units.
    """
    dataset = _as_picture(dataset)
    maps: dict[str, Any] = {}
    declarations: dict[str, Map] = {}
    for name, variable in dataset.data_vars.items():
        if not may_name_a_map(str(name)):
            raise InputError(f"the dataset's variable {name!r} cannot name a map. Rename it")
        if _DECLARATION in variable.attrs:
            text = str(variable.attrs[_DECLARATION])
            declarations[str(name)] = Map.decode(text, f"variable {name} of the dataset")
        declared = declaration_of(str(name), declarations)
        where = f"variable {name} of the dataset"
        values = as_array(where, variable, declared.unit, bool(declared.components))
        maps[str(name)] = values if values.ndim else values.item()
    axes = {
        name: as_array(f"variable {name} of the dataset", dataset[name], "mm")
        for name in ("x", "y")
        if name in dataset.variables
    }
    process = {str(name): value for name, value in dataset.attrs.items()}
    stored = process.pop(_FITTED, None)
    try:
        fitted = taken_from(process) if stored is None else Fitted.decode(str(stored))
    except ValueError as error:
        raise InputError(f"the dataset's attribute {_FITTED} is no JSON text. Remove it") from error
    places: dict[str, Any] = {name: axes.get(name) for name in "xy"}
    return maps, places | {"process": process, "fitted": fitted, "declarations": declarations}


def _as_picture(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return a dataset whose rows are along y, from the top, and columns along x, from the left."""
    for name, sign in (("x", 1), ("y", -1)):
        places = dataset[name].to_numpy() if name in dataset.coords else np.empty(0)
        if places.ndim == 1 and len(places) > 1 and np.all(sign * np.diff(places) < 0):
            dataset = dataset.isel({name: slice(None, None, -1)})
    swapped = {"x": "y", "y": "x"}
    for label, variable in dataset.data_vars.items():
        names = [str(dim) for dim in variable.dims]
        if {"x", "y"} <= {*names} and names.index("x") < names.index("y"):
            dataset = dataset.assign({label: variable.transpose(*(swapped.get(dim, dim) for dim in names))})
    return dataset


def _first(result: MapContainer) -> str | None:
    """Return the most informative map."""
    pictures = [name for name, values in result.maps().items() if values.ndim == 2 or values.shape[-1] > 3]
    summarised = [name for name in pictures if result.declaration(name).summary]
    return next(iter([*summarised, *pictures]), None)


def _unit(name: str, result: MapContainer) -> str:
    return result.declaration(name).unit


def _rows(result: MapContainer) -> list[tuple[str, str, str]]:
    """Return name, shape, and unit with range of each map."""
    rows = []
    for name, values in result.maps().items():
        shape = " x ".join(map(str, values.shape))
        declared = result.declaration(name)
        defined = values.ravel() if declared.codes else values[declared.has_answer(values)]
        span = f"{defined.min():.4g} to {defined.max():.4g}" if defined.size else "nothing known"
        notes = f", {defined.size / values.size:.0%} known" if 0 < defined.size < values.size else ""
        filled = _filled(result, name)
        notes += "" if filled is None else f", {np.mean(filled):.2g} filled"
        unit = f" {declared.unit}".rstrip() if defined.size else ""
        rows.append((name, shape, f"{span}{unit}{notes}"))
    numbers = result.numbers().items()
    return rows + [(name, "", f"{value:.4g} {_unit(name, result)}".rstrip()) for name, value in numbers]


def _filled(result: MapContainer, name: str) -> NDArray[np.bool_] | None:
    """Return which heights of a map were filled, (H, W); None if none were, or for other maps."""
    filled = result.maps().get("filled")
    name_of = getattr(result, "name_of", None)
    if filled is None or name_of is None or name != name_of("height") or not np.any(filled > 0):
        return None
    return np.asarray(filled > 0)


def _filled_note(filled: NDArray[np.bool_]) -> str:
    return f"orange: filled, not measured ({np.mean(filled):.2g} of the pixels)"


def _origin(result: MapContainer) -> str:
    source = getattr(result, "process", {}).get("source")
    return f" of {source}" if source else ""


def _picture(name: str, values: NDArray[Any], unit: str, filled: NDArray[np.bool_] | None = None) -> str:
    """Return a map, or its last turn, in colours from dark (low) to light (high); NaN is transparent.

    Filled heights are in shades of orange.
    """
    import cv2

    flat = values.reshape(-1, *values.shape[-2:])[-1].astype(np.float64)
    step = max(1, -(-max(flat.shape) // _PICTURE))
    flat = flat[::step, ::step]
    finite = np.isfinite(flat)
    if not finite.any():
        return ""
    low, high = np.percentile(flat[finite], (1, 99))
    grey = np.clip((np.where(finite, flat, low) - low) / (high - low or 1.0), 0, 1)
    colours = cv2.applyColorMap((255 * grey).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    note = ""
    if filled is not None:
        marks = filled.reshape(-1, *filled.shape[-2:])[-1][::step, ::step]
        ends = np.array([[int(shade[at : at + 2], 16) for at in (5, 3, 1)] for shade in FILLED_SHADES])
        shades = ends[0] + grey[..., np.newaxis] * (ends[1] - ends[0])  # blue, green, red
        colours = np.where(marks[..., np.newaxis], shades, colours).astype(np.uint8)
        note = f"; {_filled_note(filled)}"
    picture = np.dstack([colours, 255 * finite.astype(np.uint8)])
    data = base64.b64encode(encode(".png", picture)).decode()
    caption = escape(f"{name}, {low:.4g} to {high:.4g} {unit}".rstrip() + note)
    image = f"<img alt='{caption}' src='data:image/png;base64,{data}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
