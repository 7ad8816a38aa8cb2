"""Zarr stores with limits on the size and time of reading, and without access to anything outside."""

from __future__ import annotations

import asyncio
import contextvars
import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zarr.abc.store import OffsetByteRequest, RangeByteRequest, SuffixByteRequest
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore, WrapperStore, ZipStore

from mirrorskin.io.hdf5 import VALUES_LIMIT
from mirrorskin.io.types import InputError
from mirrorskin.io.url import Url
from mirrorskin.io.zarr_errors import MissingChunkError
from mirrorskin.io.zarr_metadata import METADATA, MOST_NODES, is_name, too_many

SILENCE = 30.0
"""Time in seconds for a server to accept a connection, send more bytes, or send a metadata document."""

TRANSFER = 300.0
"""Time in seconds for one chunk to arrive."""

LARGEST_DOCUMENT, ALL_DOCUMENTS = 8 << 20, 64 << 20
"""Limits in bytes: of a metadata document or the listing of a folder, and of all documents of a store."""

SCHEMES = ("http", "https", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "hdfs", "webhdfs", "memory")
"""Schemes of addresses: the schemes of fsspec for stores, without views of other files."""

_SLACK = 1 << 20  # additional bytes of a compressed chunk
_most_bytes = contextvars.ContextVar("bytes that an answer may have", default=LARGEST_DOCUMENT)


@contextmanager
def opened_store(path: Path, read_only: bool = True) -> Iterator[Any]:
    """Open a Zarr store; on exit its connections are closed, which fsspec does not do itself."""
    if isinstance(path, Url):
        if path.parts[0].rstrip(":") not in SCHEMES or "::" in str(path):
            known = ", ".join(SCHEMES)
            raise InputError(f"{path} cannot be opened: addresses of stores begin with one of {known}")
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
    scheme = address.parts[0]
    if scheme in ("s3:", "s3a:"):
        # An object is fetched in one request, without a preceding request for its size.
        return {"skip_instance_cache": True, "max_concurrency": 1}
    if scheme not in ("http:", "https:"):
        return {"skip_instance_cache": True}
    from aiohttp import ClientTimeout
    from fsspec.config import conf

    given = conf.get("http", {}).get("client_kwargs", {})
    settings = given | {
        "timeout": ClientTimeout(total=TRANSFER, sock_connect=SILENCE, sock_read=SILENCE),
        "response_class": _limited_response(),
        # aiohttp does not decompress answers, because a small answer could then fill the memory.
        "auto_decompress": False,
        "headers": given.get("headers", {}) | {"Accept-Encoding": "identity"},
    }
    return {"skip_instance_cache": True, "client_kwargs": settings}


def _limited_response() -> Any:
    """Return a subclass of aiohttp's response class that reads at most `_most_bytes`."""
    from aiohttp import ClientResponse

    class LimitedResponse(ClientResponse):
        async def read(self) -> bytes:
            if self._body is None:
                try:
                    self._body = await _read_within(self.content, str(self.url), _most_bytes.get())
                except BaseException:
                    self.close()
                    raise
            return self._body

    return LimitedResponse


async def _read_within(content: Any, what: str, most: int) -> bytes:
    body = bytearray()
    async for part in content.iter_any():
        body += part
        if len(body) > most:
            raise _too_large(what, most)
    return bytes(body)


def _too_large(what: str, most: int) -> InputError:
    return InputError(
        f"{what} has more than {most / 1e6:.3g} MB, the most that is read: copy the store again"
    )


class LimitedStore(WrapperStore[Any]):  # type: ignore[misc]  # where it is not installed
    """A store that refuses objects that are too large, too slow, missing, or outside of it."""

    def __init__(self, store: Any, path: Path) -> None:
        super().__init__(store)
        self._path, self._home = path, os.path.realpath(path)
        self.largest_chunk, self._documents = VALUES_LIMIT, 0
        self._remote = isinstance(store, FsspecStore)
        self._http = self._remote and "http" in store.fs.protocol

    async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
        """Read a document (None if it is missing), or a chunk or a part of one, which must exist."""
        document = key.rpartition("/")[2] in METADATA
        most = LARGEST_DOCUMENT if document else self.largest_chunk + _SLACK
        if isinstance(self._store, ZipStore):
            byte_range = self._range_of_member(key, byte_range)
        if isinstance(byte_range, RangeByteRequest):
            if not 0 <= byte_range.start <= byte_range.end:
                raise InputError(f"{self._path}: {key} states an invalid range of bytes: copy it again")
            if byte_range.end - byte_range.start > most:
                raise self._damaged(key, most)
        if byte_range is None and self._remote and not self._http:
            byte_range = RangeByteRequest(0, most + 1)
        self._check_place(key, most if byte_range is None else None)
        answer = super().get(key, prototype, byte_range)
        found = await self._in_time(answer, SILENCE if document else TRANSFER, most)
        if found is None and not document:
            raise MissingChunkError(f"its chunk {key} is missing: copy it again, or write empty ones, too")
        if found is not None and len(found) > most:
            raise self._damaged(key, most)
        if found is not None and document:
            self._documents += len(found)
            if self._documents > ALL_DOCUMENTS:
                raise _too_large(f"{self._path}: all its metadata", ALL_DOCUMENTS)
        return found

    async def exists(self, key: str) -> bool:
        """Return whether a chunk exists."""
        self._check_place(key, None)
        return bool(await self._in_time(super().exists(key), SILENCE, LARGEST_DOCUMENT))

    async def names(self, folder: str) -> list[str]:
        """Return the names in a folder that are valid for groups and arrays."""
        self._check_place(folder, None)
        return await self._in_time(self._listed(folder), SILENCE, LARGEST_DOCUMENT)  # type: ignore[no-any-return]

    async def _listed(self, folder: str) -> list[str]:
        names: set[str] = set()
        count = 0
        async for name in self._store.list_dir(folder):
            count += 1
            if count > MOST_NODES:
                raise too_many(self._path)
            names.add(name.strip("/"))
        return sorted(name for name in names if is_name(name) and name not in METADATA)

    async def _in_time(self, answer: Any, seconds: float, most: int) -> Any:
        if not self._remote:
            return await answer
        _most_bytes.set(most)
        try:
            async with asyncio.timeout(seconds) as limit:
                return await answer
        except TimeoutError as error:
            if limit.expired():
                raise TimeoutError(f"no whole answer within {seconds:g} s") from error
            raise

    def _range_of_member(self, key: str, byte_range: Any) -> Any:
        """Return the requested bytes of an archive's member.

        Without a number of bytes, Python unpacks the whole member, regardless of its stated size.
        """
        info = self._store._zf.NameToInfo.get(key)
        if info is None:
            return byte_range
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{self._path}: {key} is neither stored nor deflated: pack the store again")
        if isinstance(byte_range, SuffixByteRequest):
            return RangeByteRequest(max(0, info.file_size - byte_range.suffix), info.file_size)
        if isinstance(byte_range, OffsetByteRequest):
            return RangeByteRequest(byte_range.offset, info.file_size)
        return byte_range or RangeByteRequest(0, info.file_size)

    def _check_place(self, key: str, most: int | None) -> None:
        """Raise InputError for a file that is outside the folder, not regular, or too large."""
        if not isinstance(self._store, LocalStore):
            return
        place = Path(os.path.realpath(self._store.root / key))
        if not place.is_relative_to(self._home):
            raise InputError(
                f"{self._path}: {key} leads out of the store, to {place}: copy that into the store"
            )
        try:
            found = place.stat()
        except OSError:
            return
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
            raise InputError(f"{self._path}: {key} is not a regular file: copy the store again")
        if most is not None and found.st_size > most:
            raise self._damaged(key, most)

    def _damaged(self, key: str, most: int) -> InputError:
        return _too_large(f"{self._path}: {key}", most)
