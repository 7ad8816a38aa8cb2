"""Addresses of stacks in object stores, as paths that keep their double slash."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path, PosixPath

ZARR_SUFFIX = ".zarr"
_ROOTS = ("zarr.json", ".zgroup", ".zarray")
_SCHEME = re.compile("([a-z][a-z0-9+.-]+):/+")


class Url(PosixPath):
    """An address, such as ``s3://bucket/press.zarr``, that can be used like a path.

    Names and suffixes work as for paths. It is not a local file, so ``exists`` is false.

    Examples
    --------
    >>> str(Url("s3://bucket/monday/press.zarr")), Url("s3://bucket/press.zarr").stem
    ('s3://bucket/monday/press.zarr', 'press')
    """

    def __str__(self) -> str:
        return _SCHEME.sub(r"\1://", super().__str__(), count=1)

    def absolute(self) -> Url:
        """Return itself."""
        return self

    def resolve(self, strict: bool = False) -> Url:
        """Return itself."""
        return self


def path_of(text: str | os.PathLike[str]) -> Path:
    """Return an address as a ``Url``, and anything else as a plain path.

    Examples
    --------
    >>> type(path_of("memory://press.zarr")).__name__, str(path_of("file:///data/press.zarr"))
    ('Url', '/data/press.zarr')
    """
    address = os.fspath(text)
    match = _SCHEME.match(address)
    if match is None:
        return Path(address)
    return Path("/", address[match.end() :]) if match[1] == "file" else Url(address)


def is_zarr(path: str | Path) -> bool:
    """Return whether a path is a Zarr store: an address, ``NAME.zarr``, or a zipped ``NAME.zarr.zip``.

    A folder of another name is one if it contains the document of a group or an array.
    """
    local = path_of(path)
    if isinstance(local, Url) or local.name.lower().endswith((ZARR_SUFFIX, f"{ZARR_SUFFIX}.zip")):
        return True
    with suppress(OSError):  # reported when it is opened
        for name in _ROOTS:
            if (local / name).is_file():
                return True
    return False
