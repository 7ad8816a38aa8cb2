"""Zarr metadata, versions 2 and 3, with the list of codecs that are allowed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Coroutine, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.io.base.types import InputError

METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs", ".zmetadata"
"""The names of metadata documents in both versions of Zarr."""

_COMPRESSORS = {"blosc": "Blosc", "gzip": "GZip", "lz4": "LZ4", "zlib": "Zlib", "zstd": "Zstd"}
_SHARDS = "sharding_indexed"
_COMPRESSORS_2, _FILTERS_2 = set(_COMPRESSORS), {"shuffle", "vlen-utf8"}
_CODECS_3 = {"blosc", "bytes", "crc32c", "gzip", "transpose", "vlen-utf8", "zstd", _SHARDS}
_INDEX_CODECS = {"bytes", "crc32c"}
_NUMBERS = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64)")
_NUMBERS_2 = re.compile(r"[<>|]([iu][1248]|f[248]|b1)")
_DEEP = 8  # maximum number of nested groups; a folder may contain a link to itself
_AT_ONCE = 16  # number of concurrent requests; others wait, and do not time out


@dataclass(frozen=True)
class ArrayMetadata:
    """An array as described by its metadata.

    ``dtype`` is None if the array contains neither numbers nor texts, and is not read. ``path`` is its path
    in the store, and ``chunks`` is the shape of its objects in the store: of its shards, if it has any.
    """

    path: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: Any
    attributes: dict[str, Any]
    document: dict[str, Any]

    @property
    def is_text(self) -> bool:
        """Whether it contains texts."""
        return isinstance(self.dtype, np.dtypes.StringDType)

    @property
    def nbytes(self) -> int:
        """Size in memory in bytes; for texts, the size of their pointers."""
        return math.prod(self.shape) * (0 if self.dtype is None else int(self.dtype.itemsize))


@dataclass(frozen=True)
class Nodes:
    """The groups of a store with their attributes, and its arrays, by name; "" is the root."""

    groups: dict[str, dict[str, Any]]
    arrays: dict[str, ArrayMetadata]


async def read_nodes(store: Any, path: Path) -> Nodes:
    """Read the structure of a store; FileNotFoundError if it is neither a group nor an array."""
    root = await _read_document(store, "", 3) or await _read_document(store, "", 2)
    if root is None:
        raise FileNotFoundError(str(path))
    version = _version(root)
    documents = {"": root}
    if not _is_array(root):
        listed = await _consolidated(store, root, version)
        documents |= await _members(store, version) if listed is None else listed
    groups = {name: _attributes(document) for name, document in documents.items() if not _is_array(document)}
    arrays = {
        name: _array(name, document, version) for name, document in documents.items() if _is_array(document)
    }
    return Nodes(groups, arrays)


async def names_in(store: Any, folder: str) -> list[str]:
    """Return the names in a folder that are valid for groups and arrays."""
    names = {name.strip("/") async for name in store.list_dir(folder)}
    return sorted(name for name in names if _is_name(name) and name not in METADATA)


async def _members(store: Any, version: int) -> dict[str, dict[str, Any]]:
    """Return the documents of the members of all groups, read concurrently."""
    documents: dict[str, dict[str, Any]] = {}
    groups = [""]
    for _ in range(_DEEP + 1):
        names = await _all_of(names_in(store, group) for group in groups)
        places = [
            f"{group}/{name}".lstrip("/")
            for group, members in zip(groups, names, strict=True)
            for name in members
        ]
        contents = await _all_of(_read_document(store, place, version) for place in places)
        present = {
            place: document for place, document in zip(places, contents, strict=True) if document is not None
        }
        documents |= present
        groups = [place for place, document in present.items() if not _is_array(document)]
    return documents


async def _all_of(works: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """Run all, some at once; if one fails, cancel the others and raise its error."""
    import asyncio  # slow to import, and unneeded for files

    gate = asyncio.Semaphore(_AT_ONCE)

    async def run(work: Coroutine[Any, Any, Any]) -> Any:
        async with gate:
            return await work

    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(run(work)) for work in works]
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    return [task.result() for task in tasks]


async def _read_document(store: Any, place: str, version: int) -> dict[str, Any] | None:
    """Read the document of a group or an array; attributes of version 2 are added as in version 3."""
    if version == 3:
        return await _read_json(store, place, "zarr.json")
    array, group, attributes = await _all_of(
        _read_json(store, place, name) for name in (".zarray", ".zgroup", ".zattrs")
    )
    node = group if array is None else array
    return None if node is None else node | {"attributes": attributes or {}}


async def _read_json(store: Any, place: str, name: str) -> dict[str, Any] | None:
    from zarr.core.buffer import default_buffer_prototype

    key = f"{place}/{name}".lstrip("/")
    content = await store.get(key, default_buffer_prototype())
    return None if content is None else _mapping(json.loads(content.to_bytes()), key)


async def _consolidated(store: Any, root: dict[str, Any], version: int) -> dict[str, dict[str, Any]] | None:
    """Return the documents of all members if the root contains copies of them, else None."""
    if version == 3:
        copies = root.get("consolidated_metadata")
        if copies is None:
            return None
        members = _mapping(_mapping(copies, "consolidated_metadata").get("metadata"), "metadata")
        return {
            _checked_name(name): _mapping(member, name)
            for name, member in members.items()
            if name.count("/") <= _DEEP
        }
    copies = await _read_json(store, "", ".zmetadata")
    if copies is None:
        return None
    documents: dict[str, dict[str, Any]] = {}
    for key, value in _mapping(copies.get("metadata"), ".zmetadata").items():
        name, _, kind = key.rpartition("/")
        if name and name.count("/") <= _DEEP:
            document_of_node = documents.setdefault(_checked_name(name), {"zarr_format": 2, "attributes": {}})
            document = _mapping(value, key)
            document_of_node |= {"attributes": document} if kind == ".zattrs" else document
    return documents


def _checked_name(name: str) -> str:
    if not all(map(_is_name, name.split("/"))):
        raise ValueError(f"the name {name[:80]!r}")
    return name


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what[:80]} is not a JSON object")
    return value


def _version(document: Mapping[str, Any]) -> int:
    version = document.get("zarr_format")
    if version not in (2, 3) or isinstance(version, bool | float):
        raise ValueError(f"zarr_format {str(version)[:20]} where 2 or 3 is needed")
    return int(version)


def _is_array(document: Mapping[str, Any]) -> bool:
    kind = document.get("node_type", "array" if "shape" in document else "group")
    if kind not in ("array", "group"):
        raise ValueError(f"node_type {str(kind)[:20]!r} where array or group is needed")
    return bool(kind == "array")


def _attributes(document: Mapping[str, Any]) -> dict[str, Any]:
    return _mapping(document.get("attributes") or {}, "attributes")


def _array(path: str, document: dict[str, Any], version: int) -> ArrayMetadata:
    if _version(document) != version:
        raise ValueError(f"{path} is of another version of Zarr than its group")
    grid = document
    if version == 3:
        grid = _mapping(document.get("chunk_grid"), f"the chunk grid of {path}")
        if grid.get("name") != "regular":
            raise ValueError(f"the chunk grid of {path} is {str(grid.get('name'))[:40]!r}")
        grid = _mapping(grid.get("configuration"), f"the chunk grid of {path}")
    shape = _sizes(document.get("shape"), 0, f"the shape of {path}")
    chunks = _sizes(grid.get("chunks" if version == 2 else "chunk_shape"), 1, f"the chunks of {path}")
    if len(chunks) != len(shape):
        raise ValueError(f"{path} has {len(shape)} dimensions, and its chunks {len(chunks)}")
    kind = document.get("dtype" if version == 2 else "data_type")
    return ArrayMetadata(path, shape, chunks, _dtype(kind, version), _attributes(document), document)


def _sizes(value: Any, lowest: int, what: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(size) is int and size >= lowest for size in value):
        raise ValueError(f"{what} is {str(value)[:80]}")
    return tuple(value)


def _dtype(kind: Any, version: int) -> Any:
    """Return the type of values: a NumPy type, StringDType for texts, or None for others."""
    if not isinstance(kind, str):
        return None
    if kind == ("|O" if version == 2 else "string"):
        return np.dtypes.StringDType()
    return np.dtype(kind) if (_NUMBERS_2 if version == 2 else _NUMBERS).fullmatch(kind) else None


def check_codecs(array: ArrayMetadata, where: str) -> None:
    """Raise InputError for a codec that is not in the list, because some codecs run code from the store.

    Texts with any codec but the one for texts, and numbers with that codec, are refused as well.
    """
    version = _version(array.document)
    if version == 2:
        compressor, filters = array.document.get("compressor"), array.document.get("filters") or []
        names = [_identifier(entry, "id", _FILTERS_2, where) for entry in _sequence(filters, where)]
        if compressor is not None:
            _identifier(compressor, "id", _COMPRESSORS_2, where)
        good = names == ["vlen-utf8"] if array.is_text else "vlen-utf8" not in names
    else:
        if array.document.get("storage_transformers"):
            raise InputError(
                f"{where} has storage transformers, which are not supported: write it without them"
            )
        names = list(_codec_names(array.document.get("codecs"), _CODECS_3, where))
        good = ("vlen-utf8" in names) == array.is_text
    if array.dtype is None or not good:
        kind = str(array.document.get("dtype", array.document.get("data_type")))[:40]
        raise InputError(
            f"{where} is of type {kind!r} in codecs {names}: numbers or texts are needed; write it again"
        )


def _codec_names(codecs: Any, allowed: set[str], where: str) -> Iterator[str]:
    """Yield the names of codecs, including those inside shards, if all are allowed."""
    for codec in _sequence(codecs, where):
        name = _identifier(codec, "name", allowed, where)
        yield name
        if name == _SHARDS:
            inside = _mapping(_mapping(codec, where).get("configuration"), f"the shards of {where}")
            yield from _codec_names(inside.get("codecs"), allowed, where)
            list(_codec_names(inside.get("index_codecs", []), _INDEX_CODECS, where))


def _sequence(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{where} has codecs that are not a list: it is damaged: copy it again")
    return value


def _identifier(codec: Any, key: str, allowed: set[str], where: str) -> str:
    """Return the name of a codec if it is allowed; version 3 also accepts a name instead of an object."""
    name = codec.get(key) if isinstance(codec, dict) else codec
    if not isinstance(name, str) or name not in allowed or not (isinstance(codec, dict) or key == "name"):
        raise InputError(
            f"{where} needs the codec {str(name)[:40]!r}; only {', '.join(sorted(allowed))} are read. "
            "Write the array again with one of them"
        )
    return name


def compressors_of(array: ArrayMetadata) -> str:
    """Return a description of how the chunks of an array are compressed."""
    if _version(array.document) == 2:
        names = [(array.document.get("compressor") or {}).get("id")]
    else:
        names = list(_codec_names(array.document.get("codecs"), _CODECS_3, array.path))
    return ", ".join(_COMPRESSORS[name] for name in names if name in _COMPRESSORS) or "raw"


def _is_name(name: str) -> bool:
    """Return whether a group or an array can have a name; other names could lead out of the store."""
    return name not in ("", ".", "..") and not any(letter in name for letter in "/\\\0")


class MissingChunkError(Exception):
    """A chunk is missing; Zarr would replace it by its fill value."""
