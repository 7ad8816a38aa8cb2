"""Recordings and results in Zarr: groups and arrays with the same names as in HDF5.

Groups, attributes and the shapes of arrays are copied to an HDF5 file in memory, so that a store is checked
in the same way. Values are read from the store when they are needed.
"""

from __future__ import annotations

import base64
import bisect
import errno
import hashlib
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.selection import FrameLabel, Span
from mirrorskin.io.base.system import reason
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import Closing, InputError
from mirrorskin.io.base.url import Url, is_zarr, path_of
from mirrorskin.io.storage.atomic import MAKE_ROOM, fixed_text
from mirrorskin.io.storage.fingerprint import State, state_of
from mirrorskin.io.storage.hdf5 import VALUES_LIMIT, Hdf5File, Shape, Spacing
from mirrorskin.io.storage.layout import CHECKSUM, STACK
from mirrorskin.io.storage.ome_zarr import levels_of
from mirrorskin.io.storage.zarr_metadata import (
    METADATA,
    ArrayMetadata,
    MissingChunkError,
    compressors_of,
    read_nodes,
)

if TYPE_CHECKING:
    import zarr

Array: TypeAlias = "zarr.Array[Any]"

_SMALL = 1 << 16  # maximum size of arrays that are read on opening, bytes
AT_ONCE = 16  # number of concurrent requests
_SAMPLE = 16  # frames hashed for a fingerprint if there are no checksums
_REFUSED = {"PermissionError", "NoCredentialsError", "CredentialRetrievalError"}
_UNREACHABLE = {"ConnectionError", "TimeoutError", "ClientError", "BotoCoreError", "FSTimeoutError"}


@contextmanager
def errors_named(what: str) -> Iterator[None]:
    """Convert errors of Zarr and of store libraries, of many classes, to one line with a remedy."""
    try:
        # Zarr adds the offsets of a damaged shard without checking for overflow.
        with np.errstate(over="ignore"):
            yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{what}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"{reason(error)}: {MAKE_ROOM}"
    if isinstance(error, PermissionError) and error.errno:
        return f"{reason(error)}: check the permissions"
    kinds = {kind.__name__ for kind in type(error).__mro__}
    text = one_line(error)[:200] or type(error).__name__
    if isinstance(error, MissingChunkError):
        return text
    if isinstance(error, ImportError):
        return f"a package is missing ({text}): pip install 'mirrorskin[zarr]', of S3 'mirrorskin[s3]'"
    if "rotocol not known" in text:
        return f"{text}: check the address"
    if isinstance(error, FileNotFoundError):
        return "there is no Zarr array or group, or no such bucket: check the address"
    if kinds & _REFUSED or getattr(error, "status", None) in (401, 403):
        return f"access is refused ({text}): give the store's credentials, of S3 in AWS_PROFILE or the like"
    if kinds & _UNREACHABLE:
        return f"the store does not answer ({text}): check the address and the network, and start again"
    return f"it is damaged ({text}): copy it again"


def open_file(path: str | Path, memory_limit: int | None = None) -> Hdf5File:
    """Open an HDF5 file or a Zarr store."""
    local = path_of(path)
    return (ZarrFile if is_zarr(local) else Hdf5File)(local, memory_limit)


def find_stores(pattern: Url) -> list[Path]:
    """Return the addresses that match a pattern such as ``s3://bucket/*.zarr``."""
    with errors_named(str(pattern)):
        from fsspec.core import url_to_fs

        from mirrorskin.io.storage.zarr_store import options_of

        system, place = url_to_fs(str(pattern), **options_of(pattern))
        stores = [path_of(system.unstrip_protocol(store)) for store in sorted(system.glob(place))]
    if not stores:
        raise InputError(f"{pattern}: no store matches: name recordings")
    return stores


class ZarrFile(Hdf5File):
    """A Zarr group, or a single array as ``/data``."""

    def __init__(self, path: Path, memory_limit: int | None = None) -> None:
        with errors_named(str(path)), ExitStack() as opening:
            from zarr.core.sync import sync

            from mirrorskin.io.storage.zarr_store import CompleteStore, opened_store

            self._store = CompleteStore(opening.enter_context(opened_store(path)))
            nodes = sync(read_nodes(self._store, path))
            groups = {f"/{name}": attributes for name, attributes in nodes.groups.items()}
            self.arrays: dict[str, ArrayMetadata] = {
                f"/{name or 'data'}": array for name, array in nodes.arrays.items()
            }
            self._known: dict[str, Array] = {}
            self._early: dict[str, Future[NDArray[Any]]] = {}
            memory = {"driver": "core", "backing_store": False, "libver": "latest"}
            root = h5py.File(os.urandom(8).hex(), "w", **memory)
            super().__init__(path, memory_limit, opening.enter_context(root))
            self._lay_out(groups)
            self._levels = levels_of(groups)
            self._ours = any(name.startswith("mirrorskin_") for name in groups.get("/entry", {}))
            if self._ours:
                self._read_early()
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Close the file in memory, and all connections."""
        self._opened.close()

    def _lay_out(self, groups: Mapping[str, Mapping[str, Any]]) -> None:
        """Create groups and datasets without values in memory."""
        grows = "/entry/state" in self.arrays
        for name, attributes in groups.items():
            _set_attributes(self.root.require_group(name), attributes)
        for name, array in self.arrays.items():
            if array.dtype is not None:
                maximum = (None, *array.shape[1:]) if grows and array.shape and name != STACK else None
                dtype = "S1" if array.is_text else array.dtype
                node = self.root.create_dataset(name, array.shape, dtype, maxshape=maximum)
                _set_attributes(node, {**array.attributes, **_fill_value(array)})

    def _read_early(self) -> None:
        """Read small arrays concurrently, because each is a request; errors are stored until they matter."""
        small = [
            name
            for name, array in self.arrays.items()
            if array.dtype is not None
            and array.nbytes <= _SMALL
            and array.shape == array.chunks
            and name != STACK
        ]
        with ThreadPoolExecutor(AT_ONCE, "mirrorskin-zarr") as pool:
            self._early = {name: pool.submit(self._decode, name) for name in small}

    def _array(self, name: str) -> Array:
        """Return an array of zarr-python; InputError if a codec is not allowed."""
        if name not in self._known:
            from mirrorskin.io.storage.zarr_store import open_array

            self._known[name] = open_array(self._store, self.arrays[name], f"{self.path}: {name}")
        return self._known[name]

    def _decode(self, name: str, rows: int | None = None) -> NDArray[Any]:
        """Read an array, or its first rows."""
        where = f"{self.path}: {name}"
        with errors_named(where):
            array = self._array(name)
            try:
                return np.asarray(array[...] if rows is None else array[:rows])
            except MemoryError as error:  # a damaged text, for example, states any number of texts
                raise InputError(
                    f"{where} takes more memory than there is: copy it again, or only what is needed"
                ) from error

    def load(self, node: h5py.Dataset, rows: int | None = None) -> NDArray[Any]:
        """Read an array, or its first rows; see `Hdf5File.load`."""
        name = str(node.name)
        early = self._early.get(name)
        values = self._decode(name, rows) if early is None else early.result().copy()
        return values if early is None or rows is None else values[:rows]

    def written(self, stack: h5py.Dataset, axis: int) -> tuple[int, int, Sequence[int]]:
        """Return the length of chunks along an axis, their number, and which of them are in the store.

        Those before the last one that is there are looked at when they are read.
        """
        from zarr.core.sync import sync

        stored, where = self.arrays[str(stack.name)], self.where(stack)
        length, slabs = stored.chunks[axis], -(-stored.shape[axis] // stored.chunks[axis])

        def is_there(slab: int) -> bool:
            return bool(sync(self._store.exists(self._key_of_last(str(stack.name), axis, slab))))

        with errors_named(where):
            if not slabs or is_there(slabs - 1):
                return length, slabs, range(slabs)
            last = bisect.bisect_left(range(slabs), True, key=lambda slab: not is_there(slab))
        return length, slabs, range(last)

    def _key_of_last(self, name: str, axis: int, slab: int) -> str:
        """Return the key of the last chunk of an array whose place along an axis is given."""
        stored, array = self.arrays[name], self._array(name)
        place = [(n - 1) // piece for n, piece in zip(stored.shape, stored.chunks, strict=True)]
        place[axis] = slab
        return f"{stored.path}/{array.metadata.encode_chunk_key(tuple(place))}".lstrip("/")

    def linked_stacks(self) -> dict[str, h5py.Dataset]:
        """Return no datasets: Zarr has no links."""
        return {}

    def check_frames(self, stack: h5py.Dataset, count: int, axis: int = 0) -> None:
        """Raise InputError for missing frames, and for chunks that are too large for memory."""
        name = str(stack.name)
        stored, where = self.arrays[name], self.where(stack)
        with errors_named(where):
            from zarr.core.sync import sync

            array = self._array(name)
            size, frame = (math.prod(n) * array.dtype.itemsize for n in (array.chunks, array.shape[1:]))
            if size > max(self.memory_limit or VALUES_LIMIT, frame):
                raise InputError(
                    f"{where} is in chunks of {size / 1e6:.3g} MB: raise --memory, or write smaller ones"
                )
            key = self._key_of_last(name, axis, (count - 1) // stored.chunks[axis])
            if not sync(self._store.exists(key)):
                raise MissingChunkError(
                    f"its last chunk, {key}, is missing: copy it again, or write empty ones, too"
                )

    def dimensions(self, node: h5py.Dataset) -> tuple[str, ...]:
        """Return the names of the axes of an array, "" for an axis without; empty if there are none."""
        array, level = self.arrays[str(node.name)], self._levels.get(str(node.name))
        if level is not None and len(level.axes) == node.ndim:
            return level.axes
        names = array.document.get("dimension_names", array.attributes.get("_ARRAY_DIMENSIONS"))
        if not isinstance(names, list) or len(names) != node.ndim:
            return ()
        return tuple(name if isinstance(name, str) else "" for name in names)

    def stacks(self) -> dict[str, str]:
        """Return the arrays that may be stacks: of the pictures of OME, those of the highest resolution."""
        first = [name for name, level in self._levels.items() if level.number == 0 and name in self.arrays]
        if not first:
            return super().stacks()
        arrays = {name: self.arrays[name] for name in first}
        return {name: f"{' x '.join(map(str, array.shape))} {array.dtype}" for name, array in arrays.items()}

    def spacing(self, node: h5py.Dataset) -> Mapping[str, Spacing]:
        """Return the spacing along the axes of a picture of OME."""
        level = self._levels.get(str(node.name))
        return {} if level is None or len(level.axes) != node.ndim else level.spacing

    def frames(self, stack: h5py.Dataset) -> ZarrFrames:
        """Return the object that reads the frames."""
        return ZarrFrames(self._array(str(stack.name)), FrameLabel(str(self.path), str(stack.name)))

    def storage(self, stack: h5py.Dataset) -> str:
        """Return a description of how a stack is stored."""
        name = str(stack.name)
        return f"Zarr, chunks {self._array(name).chunks}, {compressors_of(self.arrays[name])}"

    def origins(self) -> dict[Path, State]:
        """Return the files to check for changes: metadata of a folder, or a zip file; none for an address."""
        if isinstance(self.path, Url):
            return {}
        files = [self.path] if self.path.is_file() else [self.path / name for name in METADATA]
        files = [file for file in files if file.is_file()]
        return {file: state_of(file.stat()) for file in files}

    def fingerprint(self, stack: h5py.Dataset) -> str:
        """Return a SHA-256 of everything but the frames, and of some frames if they have no checksums."""
        digest = hashlib.sha256()
        for name, member in sorted(self.arrays.items()):
            digest.update(f"{name} {member.shape} {member.dtype} {json.dumps(member.attributes)}".encode())
            if self._ours and name != STACK and member.dtype is not None and not member.is_text:
                digest.update(self._decode(name).tobytes())
        if self.find(CHECKSUM) is None:
            array = self._array(str(stack.name))
            for number in range(0, array.shape[0], -(-array.shape[0] // _SAMPLE)):
                with errors_named(self.where(stack)):
                    digest.update(np.asarray(array[number]).tobytes())
        return digest.hexdigest()


def _set_attributes(node: h5py.Group | h5py.Dataset, attributes: Mapping[str, Any]) -> None:
    """Copy the attributes that HDF5 supports: texts and numbers."""
    for name, value in attributes.items():
        if isinstance(value, str):
            node.attrs.create(name, fixed_text(value))
        elif isinstance(value, bool | int | float):
            node.attrs.create(name, value)
        elif isinstance(value, list) and all(isinstance(item, str) for item in value):
            node.attrs.create(name, fixed_text(value))
        elif isinstance(value, list) and all(isinstance(item, int | float) for item in value):
            node.attrs.create(name, np.array(value, np.float64))


def _fill_value(array: ArrayMetadata) -> dict[str, float]:
    """Return the attribute ``_FillValue`` as a number, as xarray writes it.

    In version 2 it is the fill value of the array; in version 3 floats are stored as base64 of their bytes.
    """
    value = array.attributes.get("_FillValue")
    if value is None and "_ARRAY_DIMENSIONS" in array.attributes:
        value = array.document.get("fill_value")
    if isinstance(value, str) and isinstance(array.dtype, np.dtype) and array.dtype.kind == "f":
        with suppress(ValueError, struct.error):
            return {"_FillValue": float(value)}
        with suppress(ValueError, struct.error):
            return {"_FillValue": struct.unpack("<d", base64.b64decode(value, validate=True))[0]}
    return {} if value is None or isinstance(value, str) else {"_FillValue": value}


class ZarrFrames(Closing):
    """A stack in Zarr, whose chunks are fetched and unpacked concurrently."""

    how = "chunks of Zarr, several at once"

    def __init__(self, array: Array, place: FrameLabel) -> None:
        self.chunk: Shape = array.chunks
        self.length = array.chunks[0]
        self.scratch_bytes = AT_ONCE * math.prod(array.chunks) * array.dtype.itemsize
        self._array, self._place = array, place

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write a part into ``out``, a C-contiguous array."""
        from zarr.core.buffer.cpu import NDBuffer

        with errors_named(self._place.name(*spans[0])):
            self._array.get_basic_selection(tuple(slice(*span) for span in spans), out=NDBuffer(out))
