"""Datasets as they are listed before they are written: of results, and of calibrations wherever those lie."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.hdf5 import Hdf5File
from mirrorskin.io.os_errors import legible
from mirrorskin.io.types import ProcessValue


class Part(NamedTuple):
    """A dataset: its name, what it holds, and how that is to be read."""

    name: str
    values: NDArray[Any]
    attributes: Mapping[str, str]


def write_part(root: h5py.Group, part: Part) -> None:
    """Write one in a piece, so that it lies there as it is in memory."""
    root.create_dataset(part.name, data=part.values).attrs.update(part.attributes)


def text_of(text: str) -> NDArray[Any]:
    """Return a text as bytes, whose number is known."""
    told = legible(text).encode() or b"\0"
    return np.array(told, h5py.string_dtype("utf-8", len(told)))


def parts_of_process(place: str, process: Mapping[str, ProcessValue]) -> Iterator[Part]:
    """Yield what tells how something came about."""
    for name, value in process.items():
        values = text_of(value) if isinstance(value, str) else np.asarray(value)
        yield Part(f"{place}/{name}", values, {})


def read_process(file: Hdf5File, place: str, names: Iterable[str] | None = None) -> dict[str, ProcessValue]:
    """Read how something came about, or only some of that; what is not told is missing."""
    group = file.find(place)
    wanted = file.names(place) if names is None else names
    found = {} if group is None else {name: file.walk(group, name) for name in wanted}
    return {name: file.value(node) for name, node in found.items() if node is not None}
