"""Reading of HDF5 files from any source, with checked links and sizes; and datasets to write."""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias, TypeGuard

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.content import UnknownContentError, identified
from mirrorskin.io.base.samples import ATTRIBUTES, Packing, packing_of
from mirrorskin.io.base.system import MAX_UNPACKED_BYTES, is_flagged, translate_os_errors
from mirrorskin.io.base.types import Closing, InputError, ProcessValue
from mirrorskin.io.base.units import conversion_factor
from mirrorskin.io.storage.chunks import Chunks, find_codecs

Node: TypeAlias = "h5py.Group | h5py.Dataset | h5py.Datatype"
Shape = tuple[int, ...]

VALUES_LIMIT = MAX_UNPACKED_BYTES
"""Limit of the memory for everything but the frames of one file, unpacked, in bytes.

It applies to maps, texts, attributes and process values of HDF5 together. A larger file may take as many
bytes as its own size, and ``memory_limit`` raises the limit.
"""

_LINKS_DEEP = 16
_MOST_AXES = 6  # of a stack of frames, with those of length 1
_MOST_STEPS = 100_000  # maximum number of links, and of sources of virtual datasets, to follow
_GROUPS_DEEP = 64
_SCALES = b"DIMENSION_LIST"  # attribute with references to the scales of each axis
_LEAST_FILE = 512  # minimum size of an HDF5 file with a dataset, bytes
_MOST_OBJECTS = 20_000  # groups and datasets in a file
_MOST_NAMES = 10_000  # members of a group that is read as a whole


class Spacing(NamedTuple):
    """Evenly spaced coordinates of an axis: the unit, the step, and the first one."""

    unit: str
    step: float
    first: float


class Hdf5File(Closing):
    """An HDF5 file opened for reading, and the files in its folder that it refers to."""

    def __init__(self, path: Path, memory_limit: int | None = None, root: h5py.File | None = None) -> None:
        self.path = path
        self.memory_limit = memory_limit
        real = os.path.realpath(path)
        self._home = Path(real).parent
        with translate_os_errors(str(path)):
            self.root: Any = _open_file(path, real) if root is None else root
        self._files: dict[str, h5py.File] = {real: self.root}
        self._groups: dict[str, Node | None] = {"": self.root}
        self._steps = self._spent = 0
        # Files with checked variable-length texts, and the length of their longest text in bytes.
        self._longest_text: dict[bytes, int] = {}

    def close(self) -> None:
        """Close the file and the files it refers to."""
        for file in self._files.values():
            file.close()

    def where(self, node: Node) -> str:
        """Return the file and the name of an object, for messages."""
        filename = node.file.filename
        return f"{self.path if filename == self.root.filename else filename}: {node.name}"

    def find(self, name: str) -> Node | None:
        """Return an object, or None if it does not exist."""
        if name in self._groups:
            return self._groups[name]
        group, _, last = name.rpartition("/")
        if group not in self._groups:
            self._groups[group] = self.find(group)
        parent = self._groups[group]
        return None if parent is None else self.walk(parent, last)

    def enter(self, group: str) -> None:
        """Take a group for the whole file: names are relative to it from now on."""
        self._groups = {"": self.find(f"/{group}")}

    def follow(self, name: str, remedy: str) -> Node:
        """Return an object; raise InputError with the remedy if it does not exist."""
        node = self.find(name)
        if node is None:
            raise InputError(f"{self.path}: there is no {name}: {remedy}")
        return node

    def names(self, group: str) -> list[str]:
        """Return the names in a group; none if the group does not exist."""
        node = self.find(group)
        with translate_os_errors(f"{self.path}: {group}"):
            if not isinstance(node, h5py.Group):
                return []
            if len(node) > _MOST_NAMES:
                raise InputError(
                    f"{self.where(node)} has {len(node)} members; at most {_MOST_NAMES} are read. "
                    "Copy the members that are needed into a new file"
                )
            return list(node)

    def marked(self, mark: str, group: str = "/entry") -> bool:
        """Return whether the group has the attribute ``mark``, which shows that mirrorskin wrote the file."""
        return self.attribute(group, mark) is not None

    def check_layout(self, mark: str, newest: int = 1) -> None:
        """Raise InputError if the layout of a file is newer than ``newest``, the latest that can be read."""
        layout = self.attribute("/entry", mark)
        if isinstance(layout, int) and layout > newest:
            raise InputError(f"{self.path} is of layout {layout}, where {newest} is read: update the program")

    def attribute(self, name: str, attribute: str) -> Any:
        """Return an attribute of an object, a text or a number; None if it is missing."""
        node = self.find(name)
        return None if node is None else self._attribute_of(node, attribute)

    def _attribute_of(self, node: Node, attribute: str) -> Any:
        values = self.attribute_values(node, attribute)
        with translate_os_errors(lambda: self.where(node)):
            return None if values is None else first_value(values)

    def attribute_values(self, node: Node, attribute: str) -> NDArray[Any] | None:
        """Return all values of an attribute of an object; None if it is missing."""
        with translate_os_errors(lambda: self.where(node)):
            if not h5py.h5a.exists(node.id, attribute.encode()):
                return None
            return self._values(h5py.h5a.open(node.id, attribute.encode()))

    def objects(self) -> Iterator[tuple[str, Node]]:
        """Yield the groups and datasets of the file itself, each with its name, in order of names.

        Each object is yielded once. Soft and external links are not followed.
        """
        with translate_os_errors(str(self.path)):
            yield from walk_objects(self.root, str(self.path))

    def stacks(self) -> dict[str, str]:
        """Return the datasets of the file itself that may be stacks of frames, with their sizes and types."""
        with translate_os_errors(str(self.path)):
            found = {name: node for name, node in self.objects() if _is_stack(node)}
            exact = {name: node for name, node in found.items() if node.ndim == 3}
            return {
                name: f"{' x '.join(map(str, node.shape))} {node.dtype}"
                for name, node in sorted((exact or found).items())
            }

    def linked_stacks(self) -> dict[str, h5py.Dataset]:
        """Return the datasets that may be stacks and that soft or external links lead to, each once."""
        found: dict[str, h5py.Dataset] = {}
        with translate_os_errors(str(self.path)):
            groups = {"": self.root} | {name: node for name, node in self.objects() if _is_group(node)}
            for group, node in groups.items():
                for name in self.names(group or "/"):
                    if self.is_link(group or "/", name):
                        target = self.walk(node, name)
                        if _is_stack(target) and target not in found.values():
                            found[f"{group}/{name}"] = target
        return dict(sorted(found.items()))

    def is_link(self, group: str, name: str) -> bool:
        """Return whether a member of a group is a soft or external link."""
        node = self.find(group)
        with translate_os_errors(f"{self.path}: {group}"):
            encoded = name.encode(errors="surrogateescape")
            if not isinstance(node, h5py.Group) or not node.id.links.exists(encoded):
                return False
            return bool(node.id.links.get_info(encoded).type != h5py.h5l.TYPE_HARD)

    def written(self, stack: h5py.Dataset, axis: int) -> tuple[int, int, Sequence[int]]:
        """Return the length of chunks along an axis, their number, and which of them are there completely."""
        count = int(stack.shape[axis])
        if not stack.chunks or stack.is_virtual:
            return max(1, count), 1, range(1)
        grid = [-(-n // c) for n, c in zip(stack.shape, stack.chunks, strict=True)]
        length, needed = stack.chunks[axis], math.prod(grid) // max(1, grid[axis])
        if stack.id.get_num_chunks() >= math.prod(grid):
            return length, grid[axis], range(grid[axis])
        places = [chunk.chunk_offset[axis] // length for chunk in chunks_of(stack)]
        present, counts = np.unique(np.array(places, np.int64), return_counts=True)
        return length, grid[axis], present[(counts >= needed) & (present < grid[axis])].tolist()

    def check_frames(self, stack: h5py.Dataset, count: int, axis: int = 0) -> None:
        """Raise InputError for frames that HDF5 cannot read, or would replace by fill values."""
        check_storage(self, stack, frames=count, axis=axis)

    def storage(self, stack: h5py.Dataset) -> str:
        """Return a description of how a stack is stored."""
        if stack.is_virtual:
            return "virtual"
        if stack.chunks is None:
            return "in raw files" if stack.external else "in one piece"
        names = [name.split(";")[0].strip() or str(code) for code, name in _filters(stack)]
        return f"chunks {stack.chunks}, {', '.join(names) or 'raw'}"

    def read(
        self,
        node: Node,
        *shapes: Shape,
        unit: str | None = None,
        remedy: str = "",
        rows: int | None = None,
    ) -> NDArray[Any]:
        """Read numbers, unpacked and converted to a unit, after checking that they are stored."""
        remedy = remedy and f": {remedy}"
        with translate_os_errors(lambda: self.where(node)):
            if not isinstance(node, h5py.Dataset) or node.id.dtype.kind not in "iufb":
                raise InputError(f"{self.where(node)} contains no numbers{remedy}")
            shape = node.id.shape
            if rows is not None and shape:
                shape = (min(shape[0], rows), *shape[1:])
        if shape not in shapes:
            needed = " or ".join(map(str, dict.fromkeys(shapes)))
            raise InputError(f"{self.where(node)} has shape {shape} where {needed} is needed{remedy}")
        values = self.load(node, rows)
        packing = self.packing(node)
        if packing is not None:
            values = packing.unpack(values, np.float64)
        stated = None if unit is None else self._attribute_of(node, "units")
        unit_of_file = unit if stated is None else str(stated or unit)
        if unit_of_file is None or unit is None or unit_of_file == unit:
            return values
        return values * conversion_factor(unit_of_file, unit, self.where(node))

    def packing(self, node: h5py.Dataset) -> Packing | None:
        """Return the packing of a dataset from its attributes; None if values are stored unpacked."""
        with translate_os_errors(lambda: self.where(node)):
            present = [name for name in ATTRIBUTES if h5py.h5a.exists(node.id, name.encode())]
        stated = {name: value for name in present if (value := self.attribute_values(node, name)) is not None}
        if "_Unsigned" in stated:
            stated["_Unsigned"] = first_value(stated["_Unsigned"])
        return packing_of(stated, node.id.dtype, self.where(node)) if stated else None

    def dimensions(self, node: h5py.Dataset) -> tuple[str, ...]:
        """Return the names of the axes of a dataset, "" for an axis without; empty if there are none.

        They are read from dimension scales (netCDF), labels, or NeXus attributes.
        """
        with translate_os_errors(lambda: self.where(node)):
            if (scales := self._scales(node)) is not None:
                return scales
        group = str(node.name).rpartition("/")[0]
        for owner, attribute in ((node, "DIMENSION_LABELS"), (self.find(group), "axes")):
            nexus = attribute == "axes" and owner is not None
            if nexus and self._attribute_of(owner, "signal") != str(node.name).rpartition("/")[2]:
                continue
            values = None if owner is None else self.attribute_values(owner, attribute)
            if values is not None and values.shape == (node.ndim,):
                return tuple(str(first_value(value) or "") for value in values)
        return ()

    def _scales(self, node: h5py.Dataset) -> tuple[str, ...] | None:
        """Return the names of the dimension scales of a dataset; None if it has none.

        HDF5's own functions crash if the attribute has another type.
        """
        if not h5py.h5a.exists(node.id, _SCALES):
            return None
        attribute = h5py.h5a.open(node.id, _SCALES)
        kind = attribute.get_type()
        if attribute.shape != (node.ndim,) or not isinstance(kind, h5py.h5t.TypeVlenID):
            return None
        if not kind.get_super().equal(h5py.h5t.STD_REF_OBJ):
            return None
        self._check_heaps_of(attribute)
        lists: NDArray[Any] = np.empty(attribute.shape, attribute.dtype)
        attribute.read(lists)
        references = [entries[0] if len(entries) else None for entries in lists]
        names = [h5py.h5r.get_name(reference, node.id) if reference else None for reference in references]
        return tuple((name or b"").decode(errors="replace").rpartition("/")[2] for name in names)

    def spacing(self, node: h5py.Dataset) -> Mapping[str, Spacing]:
        """Return the spacing along axes that have no coordinates, by their names: none in HDF5."""
        return {}

    def load(self, node: h5py.Dataset, rows: int | None = None) -> NDArray[Any]:
        """Read a dataset, or its first rows, if it is completely stored and within `VALUES_LIMIT`.

        All datasets except frames are read by this method, including single texts.
        """
        check_storage(self, node, frames=rows, values=True)
        with translate_os_errors(lambda: self.where(node)):
            packed = node.id.get_offset() is None and node.id.get_create_plist().get_nfilters()
            return self._unpack(node.id, rows) if packed else self._values(node.id, rows)

    def _unpack(self, node: h5py.h5d.DatasetID, rows: int | None) -> NDArray[Any]:
        """Read a packed dataset, or its first rows, without HDF5's filters, which do not limit memory."""
        codecs, kind = find_codecs(node), node.dtype
        if isinstance(codecs, str) or kind.hasobject:
            packing = codecs if isinstance(codecs, str) else "texts of any length"
            raise _only_frames(self.where(h5py.Dataset(node)), packing)
        shape = node.shape if rows is None else (rows, *node.shape[1:])
        chunks = Chunks(node, codecs, lambda *_: self.where(h5py.Dataset(node)), 1)
        self.spend(math.prod(shape) * kind.itemsize, 0 if shape == chunks.shape else chunks.scratch_bytes)
        values: NDArray[Any] = np.empty(shape, kind)
        chunks.fetch([(0, n) for n in shape], values)
        return values

    def value(self, node: Node) -> Any:
        """Read a single text or number, alone or in an array of one."""
        with translate_os_errors(lambda: self.where(node)):
            if not isinstance(node, h5py.Dataset) or node.id.shape not in ((), (1,)):
                raise InputError(
                    f"{self.where(node)} does not hold one value: write one text or number there"
                )
        return first_value(self.load(node))

    def texts(self, node: Node, remedy: str) -> tuple[str, ...]:
        """Read a list of texts."""
        with translate_os_errors(lambda: self.where(node)):
            if not isinstance(node, h5py.Dataset) or node.ndim != 1 or node.dtype.kind not in "SO":
                raise InputError(f"{self.where(node)} is not a list of texts: {remedy}")
        return tuple(str(first_value(text)) for text in self.load(node))

    def walk(self, node: Node, name: str, depth: int = 0) -> Node | None:
        """Return an object as ``find`` does, but relative to ``node``, after ``depth`` links."""
        if depth > _LINKS_DEEP:
            raise InputError(f"{self.where(node)}: its links form a cycle; name the dataset itself")
        for part in name.split("/"):
            if part not in ("", "."):
                following = self._step(node, part, depth)
                if following is None:
                    return None
                node = following
        return node

    def open_sibling(self, node: Node, filename: str, what: str) -> h5py.File:
        """Open a file that an object refers to."""
        path = self.sibling(node, filename, what)
        real = os.path.realpath(path)
        if real not in self._files:
            with translate_os_errors(str(path)):
                self._files[real] = _open_file(path, real)
        return self._files[real]

    def sibling(self, node: Node, filename: str, what: str) -> Path:
        """Return the file that an object refers to, which must be in the recording's own folder."""
        what = f"{self.path}: {what}"
        with translate_os_errors(what):
            target = Path(os.path.realpath(Path(node.file.filename).parent / filename))
            if not target.is_relative_to(self._home):
                raise InputError(
                    f"{what} leads out of its folder, to {filename}: copy that file into its folder"
                )
            if not target.is_file():
                problem = "is not a regular file" if target.exists() else "does not exist"
                raise InputError(f"{what} leads to {filename}, which {problem}: copy it there")
        return target

    def _values(self, node: h5py.h5d.DatasetID | h5py.h5a.AttrID, rows: int | None = None) -> NDArray[Any]:
        """Read a dataset or an attribute, or its first rows, three times as fast as h5py.

        ValueError if HDF5 would crash, hang, or need too much memory.
        """
        kind, shape = node.dtype, node.shape if rows is None else (rows, *node.shape[1:])
        size = math.prod(shape) * kind.itemsize
        if kind.hasobject or kind.kind == "S":
            size += self._check_text(node, h5py.check_string_dtype(kind), size)
        self.spend(size)
        values: NDArray[Any] = np.empty(shape, kind)
        if isinstance(node, h5py.h5a.AttrID):
            node.read(values)
        elif rows is None:
            node.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        else:
            space = node.get_space()
            space.select_hyperslab((0,) * len(shape), shape)
            node.read(h5py.h5s.create_simple(shape), space, values)
        return values

    def _check_text(self, node: h5py.h5d.DatasetID | h5py.h5a.AttrID, text: Any, size: int) -> int:
        """Return the maximum size of the texts stored outside a dataset or an attribute, in bytes.

        ValueError if they are not text, do not end, or are longer than the file.
        """
        if text is None:
            raise ValueError("neither numbers nor text")
        if text.length is not None:
            if size > _LEAST_FILE and size > h5py.h5i.get_file_id(node).get_filesize():
                raise ValueError("a text longer than its file")
            return 0
        if isinstance(node, h5py.h5d.DatasetID) and node.get_create_plist().get_layout() == h5py.h5d.VIRTUAL:
            # HDF5 would read them from heaps of other files, which are not checked.
            raise ValueError("texts of any length in a virtual dataset")
        # Many texts may refer to the same bytes.
        return int(math.prod(node.shape)) * self._check_heaps_of(node)

    def _check_heaps_of(self, node: h5py.h5d.DatasetID | h5py.h5a.AttrID) -> int:
        """Return the length in bytes of the longest text in the file of an object; see `_check_heaps`."""
        name = h5py.h5f.get_name(node)
        if name not in self._longest_text:
            self._longest_text[name] = _check_heaps(h5py.File(h5py.h5i.get_file_id(node)))
        return self._longest_text[name]

    def spend(self, size: int, scratch: int = 0) -> None:
        """Count bytes to be read; InputError if they and the scratch memory exceed `VALUES_LIMIT`."""
        self._spent += size
        needed = self._spent + scratch
        if needed <= VALUES_LIMIT:  # the usual case
            return
        limit = max(self.memory_limit or 0, self.root.id.get_filesize(), VALUES_LIMIT)
        if needed > limit:
            raise InputError(
                f"{self.path}: values other than frames take at least {needed / 1e6:.4g} MB in memory; "
                f"at most {limit / 1e6:.4g} MB are read. Copy only what is needed, or raise --memory"
            )

    def count_step(self, node: Node) -> None:
        """Count a followed link; InputError if there are too many, as in a cycle."""
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise InputError(
                f"{self.where(node)}: it is reached through too many links; copy the frames into one dataset"
            )

    def _step(self, node: Node, part: str, depth: int) -> Node | None:
        self.count_step(node)
        with translate_os_errors(lambda: f"{self.where(node)}: {part}"):
            name = part.encode(errors="surrogateescape")
            if not isinstance(node, h5py.Group) or not node.id.links.exists(name):
                return None
            if node.id.links.get_info(name).type == h5py.h5l.TYPE_HARD:
                return _open(node, name)
            link = node.get(part, getlink=True)
        start = node
        if isinstance(link, h5py.ExternalLink):
            start = self.open_sibling(node, link.filename, f"the external link {part} in {node.name}")
        elif link.path.startswith("/"):
            start = node.file
        target = self.walk(start, link.path, depth + 1)
        if target is None:
            raise InputError(f"{self.where(node)}: the link {part} leads to {link.path}, which is not there")
        return target


def _only_frames(where: str, packing: str) -> InputError:
    """Return the error for values in a packing that is supported for frames only."""
    return InputError(
        f"{where} is packed with {packing}, which is supported for frames only: use 'h5repack -f GZIP=1'"
    )


def _open(group: h5py.Group, name: bytes) -> Node:
    """Open the target of a hard link, three times as fast as h5py."""
    node = h5py.h5o.open(group.id, name)
    if isinstance(node, h5py.h5g.GroupID):
        return h5py.Group(node)
    if not isinstance(node, h5py.h5d.DatasetID):
        return h5py.Datatype(node)
    if node.get_offset() is None and node.get_create_plist().get_external_count():
        # HDF5 looks for raw files in the working directory, unless the first opening specifies a folder.
        del node
        access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
        access.set_efile_prefix(b"${ORIGIN}")
        node = h5py.h5d.open(group.id, name, access)
    return h5py.Dataset(node)


def first_value(value: Any) -> Any:
    """Return a text or a number, without array, bytes or NumPy type."""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def _open_file(path: Path, real: str) -> h5py.File:
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.is_dir():
        raise InputError(f"{path} is a folder: an HDF5 file is needed")
    if not path.is_file():
        raise InputError(f"{path} is not a regular file: save what it gives in one first")
    try:
        return h5py.File(real, "r")
    except OSError as error:
        with path.open("rb"):
            pass
        if is_flagged(error):
            # It is being written, or its writer was killed; the lock distinguishes them. Read it without a
            # lock.
            with suppress(OSError):
                return h5py.File(real, "r", swmr=True, locking=False)
        if h5py.is_hdf5(path):
            raise
        kind = identified(path)
        if kind:
            raise InputError(f"{path} is {kind}") from None
        raise UnknownContentError(f"{path} is not an HDF5 file") from None


_HEAP = re.compile(rb"GCOL\x01\0\0\0")  # signature, version and reserved bytes of a heap
_HEAD, _OBJECT = struct.Struct("<8sQ"), struct.Struct("<H6xQ")  # headers of a heap, and of its objects
_BULK = 1 << 16  # bytes; larger datasets are not searched for heaps
_SEARCHED_BYTES = 1 << 20  # bytes searched at once; smaller files are searched completely


def _check_heaps(file: h5py.File) -> int:
    """Return the length in bytes of the longest variable-length text in a file.

    ValueError if a heap of such texts does not end, because HDF5 would hang. See "Global Heap" in the HDF5
    file format specification.
    """
    longest, at = 0, 0
    with Path(file.filename).open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        bulk = sorted(_bulk(file)) if size > _SEARCHED_BYTES else ()
        for stop, after in (*bulk, (size, size)):
            while at < stop:
                piece = os.pread(opened.fileno(), min(_SEARCHED_BYTES, stop - at) + _HEAD.size, at)
                for heap in _HEAP.finditer(piece):
                    longest = max(longest, _check_heap(opened, at + heap.start(), size))
                at += _SEARCHED_BYTES
            at = after
    return longest


def _check_heap(file: BinaryIO, at: int, size: int) -> int:
    """Return the size in bytes of the longest object of a heap in a file."""

    def read(head: struct.Struct) -> tuple[Any, ...]:
        file.seek(at)
        return head.unpack(file.read(head.size))

    longest, stop = 0, min(at + read(_HEAD)[1], size)
    at += _HEAD.size
    while at + _HEAD.size <= stop:
        index, length = read(_OBJECT)
        step = length if index == 0 else _HEAD.size + -(-length // 8) * 8
        if not 0 < step <= stop - at:
            raise ValueError("a heap of texts that does not end")
        longest = max(longest, length if index else 0)
        at += step
    return longest


def _bulk(file: h5py.File) -> list[tuple[int, int]]:
    """Return the first byte and the end of large datasets in a file, which contain no heaps."""
    places: list[tuple[int, int]] = []
    for _, node in walk_objects(file, file.filename):
        if not isinstance(node, h5py.Dataset) or node.id.get_storage_size() < _BULK:
            continue
        start = node.id.get_offset()
        if start is not None:
            places.append((start, start + node.id.get_storage_size()))
        elif node.id.get_create_plist().get_layout() == h5py.h5d.CHUNKED:
            node.id.chunk_iter(
                lambda chunk: places.append((chunk.byte_offset, chunk.byte_offset + chunk.size))
            )
    return places


def walk_objects(file: h5py.File, path: str) -> Iterator[tuple[str, Node]]:
    """Yield the groups and datasets of a file in order of names, each once; links are not followed.

    Each object is opened from its group. Opening it from the root, as h5py does, is quadratic in the depth.
    """
    waiting: list[tuple[str, int, h5py.Group, bytes]] = []
    addresses = {_address(file["/"])}

    def put_members(name: str, depth: int, group: h5py.Group) -> None:
        count = len(addresses) + len(waiting) + group.id.get_num_objs()
        if depth >= _GROUPS_DEEP or count > _MOST_OBJECTS:
            problem = (
                f"groups nested more than {_GROUPS_DEEP} deep"
                if depth >= _GROUPS_DEEP
                else (f"more than {_MOST_OBJECTS} groups, datasets and links")
            )
            raise InputError(f"{path} has {problem}. Copy what is needed into a new file")
        members: list[bytes] = []
        group.id.links.iterate(members.append)
        waiting.extend((name, depth, group, member) for member in reversed(members))

    put_members("", 0, file["/"])
    while waiting:
        parent, depth, group, member = waiting.pop()
        if group.id.links.get_info(member).type != h5py.h5l.TYPE_HARD:
            continue
        node, name = _open(group, member), f"{parent}/{member.decode(errors='surrogateescape')}"
        if (address := _address(node)) in addresses:
            continue
        addresses.add(address)
        yield name, node
        if isinstance(node, h5py.Group):
            put_members(name, depth + 1, node)


def _address(node: Node) -> int:
    return int(h5py.h5o.get_info(node.id).addr)


_VIRTUAL_DEEP = 4


def check_storage(
    file: Hdf5File,
    dataset: h5py.Dataset,
    depth: int = 0,
    frames: int | None = None,
    values: bool = False,
    axis: int = 0,
) -> None:
    """Raise InputError for a dataset that HDF5 cannot read, or would replace by fill values.

    Of a stack, only the first ``frames`` along an axis are needed.
    """
    if depth > _VIRTUAL_DEEP:
        where = file.where(dataset)
        raise InputError(f"{where}: virtual datasets are nested too deeply; copy the frames into one dataset")
    with translate_os_errors(lambda: file.where(dataset)):
        shape, offset = dataset.id.shape, dataset.id.get_offset()
        if frames is not None:
            shape = (*shape[:axis], frames, *shape[axis + 1 :])
        claimed, unit = math.prod(shape) * dataset.id.dtype.itemsize, "bytes"
        if offset is not None:
            held = h5py.h5i.get_file_id(dataset.id).get_filesize() - offset
        elif dataset.chunks and not dataset.is_virtual:
            _check_filters(dataset, file.where(dataset), file.memory_limit)
            if values and depth and _filters(dataset):
                raise _only_frames(file.where(dataset), "filters in a virtual dataset")
            claimed = math.prod(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
            held, unit = dataset.id.get_num_chunks(), "chunks"
        else:
            held = _bytes_held(file, dataset, depth, values)
    if held < claimed:
        where = file.where(dataset)
        if not held:
            raise InputError(
                f"{where} claims {claimed} {unit} and its file contains none: it was never written"
            )
        raise InputError(
            f"{where} claims {claimed} {unit} and its file contains {held}: it was cut short; copy it again"
        )


def _is_group(node: Node) -> bool:
    return isinstance(node, h5py.Group)


def _is_stack(node: Node | None) -> TypeGuard[h5py.Dataset]:
    return isinstance(node, h5py.Dataset) and _may_be_stack(node.shape)


def _may_be_stack(shape: Shape | None) -> bool:
    """Return whether an array has three axes, not counting others of length 1."""
    return shape is not None and (
        len(shape) == 3 or (3 < len(shape) <= _MOST_AXES and sum(length != 1 for length in shape) == 3)
    )


def chunks_of(dataset: h5py.Dataset) -> list[h5py.h5d.StoreInfo]:
    """Return the stored chunks of a dataset: the position of each in the stack and in the file."""
    chunks: list[h5py.h5d.StoreInfo] = []
    dataset.id.chunk_iter(chunks.append)
    return chunks


def _filters(dataset: h5py.Dataset) -> list[tuple[int, str]]:
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(i) for i in range(plist.get_nfilters())]
    return [(code, name.decode(errors="replace")) for code, _, _, name in filters]


# Filters of hdf5plugin: Blosc, LZ4, bitshuffle, Zstandard, ZFP, SZ, SZ3, bzip2, Blosc2, FCIDECOMP, SPERR.
_OF_PLUGIN = (32001, 32004, 32008, 32015, 32013, 32017, 32024, 307, 32026, 32018, 32028)


def _check_filters(dataset: h5py.Dataset, where: str, memory_limit: int | None) -> None:
    filters = _filters(dataset)
    if not all(h5py.h5z.filter_avail(code) for code, _ in filters):
        with suppress(ImportError):
            import hdf5plugin  # noqa: F401  # registers bitshuffle, blosc and others with HDF5
    for code, name in filters:
        if not h5py.h5z.filter_avail(code):
            wanted = f"{where} is packed with filter {code} ({name or 'unnamed'}), which is not installed"
            if code in _OF_PLUGIN and find_spec("hdf5plugin") is None:
                raise InputError(f"{wanted}: pip install 'mirrorskin[codecs]'")
            raise InputError(f"{wanted}: install its HDF5 plugin and name its folder in HDF5_PLUGIN_PATH")
    # A single frame must fit into memory in any case.
    several = filters and dataset.ndim > 2 and dataset.chunks[0] > 1
    size = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if several and memory_limit is not None and size > memory_limit:
        raise InputError(
            f"{where} is packed in chunks of {size / 1e6:.3g} MB where memory is limited to "
            f"{memory_limit / 1e6:.3g} MB: raise --memory, or repack it with h5repack in chunks of one frame"
        )


def _bytes_held(file: Hdf5File, dataset: h5py.Dataset, depth: int, values: bool) -> int:
    """Return the stored size of a dataset in other files, in the object header, or not yet allocated."""
    if dataset.is_virtual:
        elements = sum(_mapped(file, dataset, part, depth, values) for part in dataset.virtual_sources())
        return elements * int(dataset.dtype.itemsize)
    if dataset.external:
        what = f"the raw storage of {dataset.name}"
        parts = [(file.sibling(dataset, name, what), offset, size) for name, offset, size in dataset.external]
        return sum(min(size, max(0, path.stat().st_size - offset)) for path, offset, size in parts)
    return int(dataset.id.get_storage_size())


def virtual_source(file: Hdf5File, dataset: h5py.Dataset, part: Any) -> h5py.Dataset:
    """Return the source of a part of a virtual dataset; InputError if it does not exist."""
    what = f"the virtual dataset {dataset.name}"
    file.count_step(dataset)
    if any(pattern in f"{part.file_name} {part.dset_name}" for pattern in ("%b", "%%")):
        # HDF5 replaces these patterns, and would open other files than those checked here.
        raise InputError(
            f"{file.path}: {what} names its sources by a pattern; copy the frames into one dataset"
        )
    origin = dataset.file if part.file_name == "." else file.open_sibling(dataset, part.file_name, what)
    source = file.walk(origin, part.dset_name)
    if not isinstance(source, h5py.Dataset):
        raise InputError(f"{file.where(dataset)} needs {part.dset_name} of {part.file_name}: it is not there")
    return source


def _mapped(file: Hdf5File, dataset: h5py.Dataset, part: Any, depth: int, values: bool) -> int:
    """Return the number of elements of a virtual dataset that one of its sources contains."""
    source = virtual_source(file, dataset, part)
    if source.external:  # HDF5 would look for them in the working directory
        raise InputError(
            f"{file.where(dataset)} has sources in raw files, {source.name}; copy the frames into one dataset"
        )
    check_storage(file, source, depth + 1, values=values)
    selected = part.src_space
    if selected.get_select_type() == h5py.h5s.SEL_ALL:
        return min(int(part.vspace.get_select_npoints()), int(source.size))
    if selected.is_regular_hyperslab() and any(
        h5py.h5s.UNLIMITED in numbers for numbers in selected.get_regular_hyperslab()
    ):
        return int(source.size)
    _, last = selected.get_select_bounds()
    reaches = all(end < count for end, count in zip(last, source.shape, strict=True))
    return int(part.vspace.get_select_npoints()) if reaches else 0


def read_process(file: Hdf5File, place: str, names: Iterable[str] | None = None) -> dict[str, ProcessValue]:
    """Read the process values of a file, or only some of them; missing ones are left out."""
    group = file.find(place)
    selected = file.names(place) if names is None else names
    nodes = {} if group is None else {name: file.walk(group, name) for name in selected}
    return {name: file.value(node) for name, node in nodes.items() if node is not None}
