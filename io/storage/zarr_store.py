"""Zarr stores in folders, zips and at addresses, in which a missing chunk is an error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import zarr
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore, StorePath, WrapperStore, ZipStore

from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.url import Url
from mirrorskin.io.storage.zarr_metadata import METADATA, ArrayMetadata, MissingChunkError, check_codecs

Array: TypeAlias = "zarr.Array[Any]"

SCHEMES = ("http", "https", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "hdfs", "webhdfs", "memory")
"""Schemes of addresses: the schemes of fsspec for stores, without views of other files."""


@contextmanager
def opened_store(path: Path, read_only: bool = True) -> Iterator[Any]:
    """Open a Zarr store; on exit its connections are closed, which fsspec does not do itself."""
    if isinstance(path, Url):
        if path.parts[0].rstrip(":") not in SCHEMES or "::" in str(path):
            names = ", ".join(SCHEMES)
            raise InputError(f"{path} cannot be opened: addresses of stores begin with one of {names}")
        store = FsspecStore.from_url(str(path), options_of(path), read_only)
    elif read_only and not path.exists():
        raise InputError(f"{path}: no such file")
    elif read_only and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path} is neither a folder nor a regular file: copy the store to a folder")
    else:
        store = ZipStore(path, mode="r") if path.is_file() else LocalStore(path, read_only=read_only)
    sync(store._open())
    try:
        yield store
    finally:
        store.close()
        for name in ("_s3", "_session"):
            client = getattr(getattr(store, "fs", None), name, None)
            if client is not None:
                sync(client.close())


def options_of(address: Url) -> dict[str, Any]:
    """Return the options for opening an address with fsspec."""
    # An object of S3 is fetched in one request, without a preceding request for its size.
    once = {"max_concurrency": 1} if address.parts[0] in ("s3:", "s3a:") else {}
    return {"skip_instance_cache": True} | once


def open_array(store: Any, array: ArrayMetadata, where: str) -> Array:
    """Return an array of zarr-python; InputError if a codec is not allowed, see `check_codecs`."""
    check_codecs(array, where)
    document = array.document
    if document["zarr_format"] == 2:  # zarr-python needs None where there are no filters
        document = document | {"filters": document.get("filters") or None}
    return zarr.Array(zarr.AsyncArray(document, StorePath(store, array.path)))


class CompleteStore(WrapperStore[Any]):  # type: ignore[misc]  # where it is not installed
    """A store whose chunks must exist, and whose files are inside of its folder."""

    async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
        """Read a document (None if it is missing), or a chunk or a part of one, which must exist."""
        if isinstance(self._store, LocalStore):
            self._check_place(key)
        content = await super().get(key, prototype, byte_range)
        if content is None and key.rpartition("/")[2] not in METADATA:
            raise MissingChunkError(f"its chunk {key} is missing: copy it again, or write empty ones, too")
        return content

    def _check_place(self, key: str) -> None:
        """Raise InputError for what is not a regular file inside of the folder."""
        folder = self._store.root
        place = Path(os.path.realpath(folder / key))
        if not place.is_relative_to(os.path.realpath(folder)):
            raise InputError(f"{folder}: {key} leads out of the store, to {place}: copy that into the store")
        if place.exists() and not (place.is_file() or place.is_dir()):
            raise InputError(f"{folder}: {key} is not a regular file: copy the store again")
