"""Recordings and results in Zarr: groups and arrays of the names that they have in HDF5.

All but the frames is held as HDF5 in memory, so that it is read and checked as if it came from such a file.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import math
import secrets
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import MAKE_ROOM, fixed_text
from mirrorskin.io.fingerprint import State, state_of
from mirrorskin.io.hdf5 import Hdf5File, Node, Shape
from mirrorskin.io.layout import CHECKSUM, STACK
from mirrorskin.io.os_errors import reason
from mirrorskin.io.selection import Place, Region, Span
from mirrorskin.io.types import Closing, InputError
from mirrorskin.io.url import Url, is_zarr, path_of

if TYPE_CHECKING:
    import zarr

Array: TypeAlias = "zarr.Array[Any]"

_DEEP, _MOST_NODES, _MOST_FRAMES = 8, 10_000, 1 << 26
_LARGEST = 1 << 30  # bytes of an array that is no stack of frames
AT_ONCE = 16  # requests
_SAMPLE = 16  # frames that a fingerprint takes where there are no checksums
_METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs", ".zmetadata"
_REFUSED = {"PermissionError", "NoCredentialsError", "CredentialRetrievalError"}
_UNREACHABLE = {"ConnectionError", "TimeoutError", "ClientError", "BotoCoreError", "FSTimeoutError"}


def open_file(path: str | Path, memory_limit: int | None = None) -> Hdf5File:
    """Open a file of HDF5, or what is the same in Zarr."""
    known = path_of(path)
    return (ZarrFile if is_zarr(known) else Hdf5File)(known, memory_limit)


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Turn what Zarr and the libraries of stores say, in errors of many kinds, into a line with a remedy."""
    try:
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
    said = " ".join(str(error).split())[:200] or type(error).__name__
    if isinstance(error, _MissingChunkError):
        return said
    if isinstance(error, ImportError):
        return f"a package is missing ({said}): pip install 'mirrorskin[zarr]', of S3 'mirrorskin[s3]'"
    if "rotocol not known" in said:
        return f"{said}: check the address"
    if isinstance(error, FileNotFoundError):
        return "there is no Zarr array or group, or no such bucket: check the address"
    if kinds & _REFUSED or getattr(error, "status", None) in (401, 403):
        return f"access is refused ({said}): give the store's credentials, of S3 in AWS_PROFILE or the like"
    if kinds & _UNREACHABLE:
        return f"the store does not answer ({said}): check the address and the network, and start again"
    return f"it is damaged ({said}): copy it again"


class _MissingChunkError(Exception):
    pass


@functools.cache
def _whole() -> Callable[[Any], Any]:
    """Return what makes a store that refuses chunks that are missing: Zarr would make them up."""
    from zarr.storage import WrapperStore

    class Whole(WrapperStore[Any]):  # type: ignore[misc]  # where it is not installed
        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            found = await super().get(key, prototype, byte_range)
            if found is None and not key.endswith(_METADATA):
                raise _MissingChunkError(
                    f"its chunk {key} is missing: copy it again, or write empty ones, too"
                )
            return found

    return Whole


@contextmanager
def opened_store(path: Path, read_only: bool = True) -> Iterator[Any]:
    """Open a store of Zarr; leaving it closes its connections, which fsspec leaves to whoever has them."""
    from zarr.core.sync import sync
    from zarr.storage import FsspecStore, LocalStore, ZipStore

    if isinstance(path, Url):
        # An object is fetched in one request, not after another for its size.
        single = {"max_concurrency": 1} if path.parts[0] in ("s3:", "s3a:") else {}
        store = FsspecStore.from_url(str(path), {"skip_instance_cache": True, **single}, read_only)
    elif read_only and not path.exists():
        raise InputError(f"{path}: no such file")
    else:
        store = ZipStore(path, mode="r") if path.is_file() else LocalStore(path, read_only=read_only)
    try:
        yield store
    finally:
        store.close()
        for name in ("_s3", "_session"):
            client = getattr(getattr(store, "fs", None), name, None)
            if client is not None:
                sync(client.close())


def find_stores(pattern: Url) -> list[Path]:
    """Return the addresses that answer to a pattern such as ``s3://bucket/*.zarr``."""
    with naming(str(pattern)):
        from fsspec.core import url_to_fs

        system, place = url_to_fs(str(pattern))
        found = [path_of(system.unstrip_protocol(one)) for one in sorted(system.glob(place))]
    if not found:
        raise InputError(f"{pattern}: nothing answers to that: name recordings")
    return found


class ZarrFile(Hdf5File):
    """A Zarr group, or an array alone as ``/data``, of which all but the frames is read at once."""

    def __init__(self, path: Path, memory_limit: int | None = None) -> None:
        with ExitStack() as opening, naming(str(path)):
            import zarr

            store = opening.enter_context(opened_store(path))
            node = zarr.open(_whole()(store), mode="r")
            found = dict(node.members(max_depth=_DEEP)) if isinstance(node, zarr.Group) else {"data": node}
            if len(found) > _MOST_NODES:
                raise InputError(f"{path} holds over {_MOST_NODES} groups and arrays: copy what is wanted")
            groups = {f"/{name}": one for name, one in found.items() if isinstance(one, zarr.Group)}
            self.arrays = {f"/{name}": one for name, one in found.items() if f"/{name}" not in groups}
            root = h5py.File(secrets.token_hex(8), "w", driver="core", backing_store=False)
            super().__init__(path, memory_limit, opening.enter_context(root))
            self._fill(groups)
            _set_attributes(self.root["/"], node.attrs if isinstance(node, zarr.Group) else {})
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Close what is in memory, and all connections."""
        self._opened.close()

    def _fill(self, groups: Mapping[str, Any]) -> None:
        """Copy attributes, and values if the group is one of ours; of others, only shapes and types."""
        entry = groups.get("/entry")
        ours = entry is not None and any(name.startswith("mirrorskin_") for name in entry.attrs)
        wanted = {name: one for name, one in self.arrays.items() if ours and name != STACK}
        for name, one in wanted.items():
            if one.nbytes > _LARGEST:
                raise InputError(
                    f"{self.path}: {name} claims {one.nbytes} bytes: it is damaged: copy it again"
                )
        with ThreadPoolExecutor(AT_ONCE, "mirrorskin-zarr") as pool:
            values = dict(
                zip(wanted, pool.map(lambda one: np.asarray(one[...]), wanted.values()), strict=True)
            )
        grows = any(name == "/entry/state" for name in self.arrays)
        for name, one in groups.items():
            _set_attributes(self.root.require_group(name), one.attrs)
        for name, one in self.arrays.items():
            if name in values:
                value = (
                    values[name] if values[name].dtype.kind in "biuf" else fixed_text(values[name].tolist())
                )
                resizable = {"maxshape": (None, *value.shape[1:])} if grows and value.ndim else {}
                made = self.root.create_dataset(name, data=value, **resizable)
            elif one.dtype.kind in "biuf":
                made = self.root.create_dataset(name, one.shape, one.dtype)
            else:
                continue
            _set_attributes(made, one.attrs)

    def read(
        self,
        node: Node,
        *shapes: Shape,
        unit: str | None = None,
        remedy: str = "",
        rows: int | None = None,
        mapped: bool = False,
    ) -> NDArray[Any]:
        """Read numbers; none of them is in a file that could be mapped."""
        return super().read(node, *shapes, unit=unit, remedy=remedy, rows=rows)

    def check_frames(self, stack: h5py.Dataset, count: int) -> None:
        """Refuse frames that are not there, or in chunks that memory has no room for."""
        array, where = self.arrays[str(stack.name)], self.where(stack)
        size = math.prod(array.chunks) * array.dtype.itemsize
        if size > max(self.memory_limit or _LARGEST, array.dtype.itemsize * math.prod(array.shape[1:])):
            raise InputError(
                f"{where} is in chunks of {size / 1e6:.3g} MB: raise --memory, or write smaller ones"
            )
        if count > _MOST_FRAMES:
            raise InputError(f"{where} claims {count} frames: it is damaged: copy it again")
        with naming(where):
            from zarr.core.sync import sync

            pieces = array.shards or array.chunks
            last = ((n - 1) // piece for n, piece in zip(array.shape, pieces, strict=True))
            key = f"{array.path}/{array.metadata.encode_chunk_key(tuple(last))}".lstrip("/")
            if not sync(array.store.exists(key)):
                raise _MissingChunkError(
                    f"its last chunk, {key}, is missing: copy it again, or write empty ones, too"
                )

    def frames(self, stack: h5py.Dataset) -> ZarrFrames:
        """Return what fetches the frames."""
        return ZarrFrames(self.arrays[str(stack.name)], Place(str(self.path), str(stack.name)))

    def storage(self, stack: h5py.Dataset) -> str:
        """Tell how a stack is stored, for people."""
        array = self.arrays[str(stack.name)]
        names = ", ".join(type(one).__name__.removesuffix("Codec") for one in array.compressors)
        return f"Zarr, chunks {array.chunks}, {names or 'raw'}"

    def origins(self) -> dict[Path, State]:
        """Return what tells of a change: of a folder its metadata, of a zip itself, of an address nothing."""
        if isinstance(self.path, Url):
            return {}
        files = [self.path] if self.path.is_file() else [self.path / name for name in _METADATA]
        files = [file for file in files if file.is_file()]
        return {file: state_of(file.stat()) for file in files}

    def fingerprint(self, stack: h5py.Dataset) -> str:
        """Return a SHA-256 of all but the frames, and of some frames if there are no checksums of them."""
        digest = hashlib.sha256()
        for name, array in sorted(self.arrays.items()):
            digest.update(f"{name} {array.shape} {array.dtype} {json.dumps(array.attrs.asdict())}".encode())
            if array.dtype.kind in "biuf" and self.root[name].id.get_storage_size():
                digest.update(self.root[name][()].tobytes())
        if self.find(CHECKSUM) is None:
            array = self.arrays[str(stack.name)]
            for number in range(0, array.shape[0], -(-array.shape[0] // _SAMPLE)):
                with naming(self.where(stack)):
                    digest.update(np.asarray(array[number]).tobytes())
        return digest.hexdigest()


def _set_attributes(node: h5py.Group | h5py.Dataset, attributes: Mapping[str, Any]) -> None:
    """Copy texts and numbers, which HDF5 has, too."""
    for name, value in attributes.items():
        if isinstance(value, str):
            node.attrs.create(name, fixed_text(value))
        elif isinstance(value, bool | int | float):
            node.attrs.create(name, value)
        elif isinstance(value, list) and all(isinstance(one, str) for one in value):
            node.attrs.create(name, fixed_text(value))


class ZarrFrames(Closing):
    """A stack in Zarr, of which several chunks are fetched and unpacked at once."""

    how = "chunks of Zarr, several at once"

    def __init__(self, array: Array, place: Place) -> None:
        self.length = array.chunks[0]
        self.scratch_bytes = AT_ONCE * math.prod(array.chunks) * array.dtype.itemsize
        self._array, self._place = array, place

    def lend(self, start: int, stop: int) -> None:
        """Lend nothing that was not read."""

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Write a part into ``out``, which is in C order."""
        from zarr.core.buffer.cpu import NDBuffer

        what = f"{self._place.path}: frames {frames[0]} to {frames[1] - 1} of {self._place.dataset}"
        with naming(f"{what} cannot be read"):
            room = NDBuffer.from_numpy_array(out)
            self._array.get_basic_selection((slice(*frames), *region.slices), out=room)
