"""HDF5 files of some groups and datasets each, written as a whole."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import MAKE_ROOM, hdf5_in, new_file
from mirrorskin.io.os_errors import as_input_error, legible
from mirrorskin.io.types import ProcessValue

_LARGE = 4096  # bytes of a dataset that is not kept in memory with a file's structure
_MOST_LAYOUTS = 16  # that are remembered

_TEXT, _ONE = h5py.string_dtype(), h5py.h5s.create(h5py.h5s.SCALAR)
_STORED_TEXT = h5py.h5t.py_create(_TEXT, logical=True)
_UNDATED, _WITH_GROUPS = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5p.create(h5py.h5p.LINK_CREATE)
_UNDATED.set_obj_track_times(False)
_WITH_GROUPS.set_create_intermediate_group(True)
_WITH_GROUPS.set_char_encoding(h5py.h5t.CSET_UTF8)


class Item(NamedTuple):
    """Something to write: its full name; the values of a dataset, None of a group; its attributes.

    A dataset's attributes are texts. Text instead of values is where a soft link leads.
    """

    name: str
    values: NDArray[Any] | str | None
    attributes: Mapping[str, Any]


def write_item(root: h5py.Group, item: Item) -> int | None:
    """Write it; return where a dataset's values lie in the file, in one piece as they are in memory.

    A dataset takes a fifth of the time of h5py's own way where it is small.
    """
    if item.values is None:
        root.require_group(item.name).attrs.update(item.attributes)
        return None
    if isinstance(item.values, str):
        root[item.name] = h5py.SoftLink(item.values)
        return None
    values = np.asarray(item.values, order="C")
    kind, space = h5py.h5t.py_create(values.dtype, logical=True), h5py.h5s.create_simple(values.shape)
    node = h5py.h5d.create(root.id, item.name.encode(), kind, space, _UNDATED, _WITH_GROUPS)
    if values.size:
        node.write(h5py.h5s.ALL, h5py.h5s.ALL, values, kind)
    for name, text in item.attributes.items():
        h5py.h5a.create(node, name.encode(), _STORED_TEXT, _ONE).write(np.array(text, _TEXT))
    place: int | None = node.get_offset()
    return place


def write_file(path: Path, items: Iterable[Item]) -> None:
    """Write a file of these items, which exists whole or not at all.

    HDF5 says once where things lie in a file of certain names, shapes, types and attributes. The next file
    that differs in values alone is the same bytes, but for these: it takes a tenth of the time.
    """
    items = list(items)
    arrays = [np.asarray(item.values, order="C") for item in items if isinstance(item.values, np.ndarray)]
    likeness = repr([(name, _likeness(values), attributes) for name, values, attributes in items])
    layout = _layouts.get(likeness)
    with new_file(path) as descriptor, as_input_error(f"{path} could not be written", MAKE_ROOM, OSError):
        if layout is not None:
            layout.write(descriptor, arrays)
            return
        with hdf5_in(path, descriptor) as new:
            places = [write_item(new.root, item) for item in items]
        own = [
            place for place, item in zip(places, items, strict=True) if isinstance(item.values, np.ndarray)
        ]
        if len(_layouts) >= _MOST_LAYOUTS:
            _layouts.clear()
        _layouts[likeness] = _Layout.of(descriptor, own, arrays)


def fixed_text(text: str | Sequence[str]) -> NDArray[Any]:
    """Return a text, or a list of texts, as UTF-8 of a fixed length: texts of variable length lie in heaps.

    HDF5 reads a heap that is damaged for ever.
    """
    if isinstance(text, str):
        encoded = legible(text).encode() or b"\0"
        return np.array(encoded, h5py.string_dtype("utf-8", len(encoded)))
    texts = [legible(one).encode() for one in text]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=0) or 1))


def process_items(place: str, process: Mapping[str, ProcessValue]) -> Iterator[Item]:
    """Yield what says how something came about."""
    for name, value in process.items():
        values = fixed_text(value) if isinstance(value, str) else np.asarray(value)
        yield Item(f"{place}/{name}", values, {})


def _likeness(values: NDArray[Any] | str | None) -> object:
    return (values.shape, values.dtype.str) if isinstance(values, np.ndarray) else values


class _Layout(NamedTuple):
    """How a file is laid out: its bytes but those of large datasets, and where its datasets begin."""

    pieces: list[tuple[int, bytes]]
    places: list[int | None]

    @classmethod
    def of(cls, descriptor: int, places: list[int | None], arrays: Sequence[NDArray[Any]]) -> _Layout:
        """Read how a file is laid out whose datasets begin at certain bytes."""
        known = [(at, at + one.nbytes) for at, one in zip(places, arrays, strict=True) if at is not None]
        large = sorted((start, end) for start, end in known if end - start >= _LARGE)
        starts, ends = [0, *(end for _, end in large)], [start for start, _ in large]
        gaps = zip(starts, [*ends, os.fstat(descriptor).st_size], strict=True)
        return cls([(start, os.pread(descriptor, end - start, start)) for start, end in gaps], places)

    def write(self, descriptor: int, arrays: Sequence[NDArray[Any]]) -> None:
        """Write a file of other values."""
        for start, piece in self.pieces:
            _write(descriptor, memoryview(piece), start)
        for at, values in zip(self.places, arrays, strict=True):
            if at is not None:
                _write(descriptor, values.reshape(-1).view(np.uint8).data, at)


_layouts: dict[str, _Layout] = {}


def _write(descriptor: int, data: memoryview, place: int) -> None:
    while data:
        count = os.pwrite(descriptor, data, place)
        data, place = data[count:], place + count
