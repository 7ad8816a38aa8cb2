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


class DatasetSpec(NamedTuple):
    """A dataset: its name, what it holds, and its attributes."""

    name: str
    values: NDArray[Any]
    attributes: Mapping[str, str]


def write_dataset(root: h5py.Group, spec: DatasetSpec) -> None:
    """Write one in a piece, so that it lies there as it is in memory."""
    root.create_dataset(spec.name, data=spec.values).attrs.update(spec.attributes)


def fixed_text(text: str) -> NDArray[Any]:
    """Return a text as UTF-8 of a fixed length, so that it lies in the file in one piece."""
    encoded = legible(text).encode() or b"\0"
    return np.array(encoded, h5py.string_dtype("utf-8", len(encoded)))


def process_specs(place: str, process: Mapping[str, ProcessValue]) -> Iterator[DatasetSpec]:
    """Yield what says how something came about."""
    for name, value in process.items():
        values = fixed_text(value) if isinstance(value, str) else np.asarray(value)
        yield DatasetSpec(f"{place}/{name}", values, {})


def read_process(file: Hdf5File, place: str, names: Iterable[str] | None = None) -> dict[str, ProcessValue]:
    """Read how something came about, or only some of that; what is not there is missing."""
    group = file.find(place)
    wanted = file.names(place) if names is None else names
    found = {} if group is None else {name: file.walk(group, name) for name in wanted}
    return {name: file.value(node) for name, node in found.items() if node is not None}
