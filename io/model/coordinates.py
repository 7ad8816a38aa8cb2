"""Coordinates of the axes of other programs' stacks, identified by units: times, positions, pixel size."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import one_line, shortened
from mirrorskin.io.base.types import Floats, Motion
from mirrorskin.io.base.units import Kind, in_base

if TYPE_CHECKING:
    from mirrorskin.io.base.samples import Decoding
    from mirrorskin.io.storage.hdf5 import Hdf5File, Spacing

_SERIES: dict[Kind, str] = {"time": "time", "length": "travel", "angle": "phase"}
_MOTIONS: dict[str, Motion] = {"travel": "vertical", "phase": "axial"}
_SINCE = re.compile(r"(\w+) since .*", re.DOTALL)  # a time of the CF conventions
_EVEN = 1e-3  # largest deviation of evenly spaced pixels from their positions, pixels
_FIJI = "element_size_um"  # attribute that Fiji and ilastik write: the size of a voxel, (z, y, x)


@dataclass
class Coordinates:
    """The information in the axes of a stack.

    Attributes
    ----------
    series : dict of ndarray, (T,), float64
        ``time``, s, ``travel``, mm, or ``phase``, rad, of the frames.
    motion : str or None
        The motion, if the axis of the frames is called travel or phase.
    pixel_size : (float, float) or None
        Millimetres along x and y.
    findings : list of Finding
    """

    series: dict[str, Floats] = field(default_factory=dict)
    motion: Motion | None = None
    pixel_size: tuple[float, float] | None = None
    findings: list[Finding] = field(default_factory=list)


def read_coordinates(file: Hdf5File, stack: h5py.Dataset, decoding: Decoding) -> Coordinates:
    """Read the coordinates of a stack of another program; coordinates without units are ignored."""
    coordinates = Coordinates()
    if decoding.names:
        group = str(stack.name).rpartition("/")[0]
        shape = decoding.shape(stack.shape)
        names = [decoding.names[axis] for axis in decoding.order]
        spacing = file.spacing(stack)
        axes = [
            _evenly_spaced(spacing[name], count) if name in spacing else _axis(file, f"{group}/{name}", count)
            for name, count in zip(names, shape, strict=True)
        ]
        if axes[0] is not None:
            _take_series(coordinates, names[0], *axes[0], decoding.where)
        steps = [
            _stated_step(coordinates, name, spacing[name], decoding.where)
            if name in spacing
            else _step(coordinates, name, direction, axis, decoding.where)
            for name, direction, axis in zip(names[1:], (-1, 1), axes[1:], strict=True)
        ]
        if steps[0] and steps[1]:
            coordinates.pixel_size = steps[1], steps[0]
            _note(coordinates, decoding.where, "the pixel size", f"{names[2]} and {names[1]}")
    size = file.attribute_values(stack, _FIJI)
    if (
        coordinates.pixel_size is None
        and size is not None
        and size.shape == (3,)
        and size.dtype.kind in "iuf"
    ):
        coordinates.pixel_size = float(size[2]) / 1000, float(size[1]) / 1000
        _note(coordinates, decoding.where, "the pixel size", _FIJI)
    return coordinates


def _axis(file: Hdf5File, name: str, count: int) -> tuple[Kind, Floats] | None:
    """Return the kind of a coordinate and its values in the base unit; None if there is none with a unit."""
    node = None if name.endswith("/") else file.find(name)
    if not isinstance(node, h5py.Dataset) or node.shape != (count,) or node.dtype.kind not in "iuf":
        return None
    unit = str(file.attribute(name, "units") or "")
    since = _SINCE.fullmatch(unit)
    known = _kind_of(since[1] if since else unit)
    if known is None:
        return None
    values = file.read(node, (count,)).astype(np.float64) * known[1]
    return known[0], values - values[0] if since else values


def _evenly_spaced(spacing: Spacing, count: int) -> tuple[Kind, Floats] | None:
    """Return the kind of evenly spaced coordinates and their values in the base unit, if they have one."""
    known = _kind_of(spacing.unit)
    if known is None or not spacing.step:
        return None
    values = spacing.first + spacing.step * np.arange(count, dtype=np.float64)
    return known[0], values * known[1]


def _stated_step(coordinates: Coordinates, name: str, spacing: Spacing, where: str) -> float | None:
    """Return the stated distance of rows or columns, mm; a note if its unit is no length."""
    known = _kind_of(spacing.unit)
    if known is not None and known[0] == "length":
        return abs(spacing.step) * known[1]
    if spacing.step != 1:
        unit = f"the unit {shortened(one_line(spacing.unit))!r}" if spacing.unit else "no unit"
        text = f"{where}: the spacing of {name}, {spacing.step:g} with {unit}, is not used: give --pixel-size"
        coordinates.findings.append(Finding("pixel size", text, warning=False))
    return None


def _kind_of(unit: str) -> tuple[Kind, float] | None:
    """Return the kind of coordinates with a unit, and the factor to the base unit; None if it is unknown."""
    for kind in _SERIES:
        try:
            factor = in_base(unit, kind) if unit else 0.0
        except ValueError:
            continue
        if factor:
            return kind, factor
    return None


def _take_series(coordinates: Coordinates, name: str, kind: Kind, values: Floats, where: str) -> None:
    series = _SERIES[kind]
    coordinates.series[series] = values
    coordinates.motion = _MOTIONS.get(series) if name.lower() == series else None
    _note(coordinates, where, f"the {series} of each frame", name)


def _step(
    coordinates: Coordinates, name: str, direction: int, axis: tuple[Kind, NDArray[Any]] | None, where: str
) -> float | None:
    """Return the distance of rows or columns, mm, if they are evenly spaced along a length."""
    if axis is None or axis[0] != "length" or len(axis[1]) < 2:
        return None
    places = axis[1]
    step = float(places[-1] - places[0]) / (len(places) - 1)
    even = np.abs(places - places[0] - step * np.arange(len(places)))
    if not step or not np.all(even <= _EVEN * abs(step)):
        text = f"{where}: its coordinate {name} is not evenly spaced, and states no pixel size"
        coordinates.findings.append(Finding("uneven pixels", text))
        return None
    if step * direction < 0:
        change, first = ("rises with the row", "top") if direction < 0 else ("falls with the column", "left")
        text = (
            f"{where}: its coordinate {name} {change}, and the first one is taken as the {first} of the "
            "picture; reverse the axis if that is wrong"
        )
        coordinates.findings.append(Finding("mirrored picture", text))
    return abs(step)


def _note(coordinates: Coordinates, where: str, what: str, source: str) -> None:
    coordinates.findings.append(Finding("coordinates", f"{where}: {what} is read from {source}", False))
