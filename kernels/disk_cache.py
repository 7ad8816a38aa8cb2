"""Results about this machine, and programs built for it, in the user's cache folder."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
from pathlib import Path

import platformdirs

_log = logging.getLogger("mirrorskin.kernels")
_DIGEST = hashlib.sha256().digest_size


def recall(topic: str, circumstances: object) -> bytes | None:
    """Return the cached value of a topic under these circumstances, which are identified by their ``repr``.

    None if there is none, or if it is damaged.
    """
    try:
        kept = _record(topic, circumstances).read_bytes()
    except OSError:
        return None
    answer = kept[_DIGEST:]
    return answer if hashlib.sha256(answer).digest() == kept[:_DIGEST] else None


def keep(topic: str, circumstances: object, answer: bytes) -> None:
    """Cache a value atomically; if the folder is not writable, the value is computed again next time."""
    record = _record(topic, circumstances)
    partial = record.with_suffix(f".{os.getpid()}-{threading.get_native_id()}")
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(hashlib.sha256(answer).digest() + answer)
        partial.replace(record)
    except OSError as error:
        _log.info("%s will be computed again next time: %s", topic, error)


def digest(circumstances: object) -> str:
    """Return 16 hexadecimal digits that depend on the ``repr`` of circumstances."""
    return hashlib.sha256(repr(circumstances).encode()).hexdigest()[:16]


def _record(topic: str, circumstances: object) -> Path:
    return platformdirs.user_cache_path("mirrorskin") / f"{topic}-{digest(circumstances)}"
