"""Metadata of OME-Zarr: the resolutions of a picture, with the names, units and spacing of their axes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from mirrorskin.io.storage.hdf5 import Spacing

_OLDEST_AXES = ("t", "c", "z", "y", "x")  # of versions before 0.3, which do not name them


class Level(NamedTuple):
    """An array of a picture: its resolution, 0 the highest, the names of its axes, and their spacing."""

    number: int
    axes: tuple[str, ...]
    spacing: Mapping[str, Spacing]


def levels_of(groups: Mapping[str, Mapping[str, Any]]) -> dict[str, Level]:
    """Return the arrays that ``multiscales`` of groups describe, by their names; what is damaged is left out.

    See the specifications 0.1 to 0.5 of OME-Zarr (https://ngff.openmicroscopy.org).
    """
    return {
        f"{group.rstrip('/')}/{path}": level
        for group, attributes in groups.items()
        for picture in _entries(_entry(attributes, "ome") or attributes, "multiscales")
        for path, level in _levels(picture)
    }


def _levels(picture: Mapping[str, Any]) -> Iterator[tuple[str, Level]]:
    axes = picture.get("axes", [{"name": name} for name in _OLDEST_AXES])
    named = (
        [axis if isinstance(axis, dict) else {"name": axis} for axis in axes]
        if isinstance(axes, list)
        else []
    )
    names = tuple(str(axis.get("name", "")) for axis in named)
    units = [axis.get("unit", "") for axis in named]
    for number, dataset in enumerate(_entries(picture, "datasets")):
        steps, firsts = [1.0] * len(names), [0.0] * len(names)
        for transformation in (
            *_entries(dataset, "coordinateTransformations"),
            *_entries(picture, "coordinateTransformations"),
        ):
            scale = _numbers(transformation.get("scale"), len(names), 1.0)
            shift = _numbers(transformation.get("translation"), len(names), 0.0)
            steps = [step * factor for step, factor in zip(steps, scale, strict=True)]
            firsts = [first * factor + by for first, factor, by in zip(firsts, scale, shift, strict=True)]
        spacing = {
            name: Spacing(unit if isinstance(unit, str) else "", step, first)
            for name, unit, step, first in zip(names, units, steps, firsts, strict=True)
        }
        path = dataset.get("path")
        if isinstance(path, str):
            yield path.strip("/"), Level(number, names, spacing)


def _entry(attributes: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    entry = attributes.get(name)
    return entry if isinstance(entry, dict) else {}


def _entries(attributes: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    entries = attributes.get(name)
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def _numbers(values: Any, count: int, default: float) -> list[float]:
    good = (
        isinstance(values, list)
        and len(values) == count
        and all(isinstance(value, int | float) and math.isfinite(value) for value in values)
    )
    return [float(value) for value in values] if good else [default] * count
