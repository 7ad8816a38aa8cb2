"""What was found out about this machine once, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path

import platformdirs

_log = logging.getLogger("mirrorskin.kernels")


def recall(topic: str, circumstances: object) -> str | None:
    """Return what was kept of a topic under these circumstances, which their ``repr`` distinguishes."""
    try:
        return _record(topic, circumstances).read_text(encoding="utf-8")
    except (OSError, ValueError):  # none, or damaged
        return None


def keep(topic: str, circumstances: object, answer: str) -> None:
    """Keep an answer, whole or not at all; without a writable folder it will be found out again."""
    record = _record(topic, circumstances)
    partial = record.with_suffix(f".{os.getpid()}")
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(answer, encoding="utf-8")
        partial.replace(record)
    except OSError as error:
        _log.info("%s will be found out again next time: %s", topic, error)


def _record(topic: str, circumstances: object) -> Path:
    key = hashlib.sha256(repr(circumstances).encode()).hexdigest()
    return platformdirs.user_cache_path("mirrorskin") / f"{topic}-{key[:16]}"
