"""Errors of Zarr and of store libraries, converted to one line with a remedy."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from mirrorskin.io.atomic import MAKE_ROOM
from mirrorskin.io.system import reason
from mirrorskin.io.text import one_line
from mirrorskin.io.types import InputError

_REFUSED = {"PermissionError", "NoCredentialsError", "CredentialRetrievalError"}
_UNREACHABLE = {"ConnectionError", "TimeoutError", "ClientError", "BotoCoreError", "FSTimeoutError"}


class MissingChunkError(Exception):
    """A chunk is missing; Zarr would replace it by its fill value."""


@contextmanager
def naming(what: str) -> Iterator[None]:
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
