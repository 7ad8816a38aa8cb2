"""Which mirrorskin this is."""

from __future__ import annotations

import functools
from datetime import UTC, datetime
from importlib.metadata import version


@functools.cache
def program_version() -> str:
    """Return the version of the installed package; to look it up takes a millisecond, so only once."""
    return version("mirrorskin")


def signature() -> dict[str, str]:
    """Return what everything that is made says of its maker: program, version and date."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"program": "mirrorskin", "version": program_version(), "date": date}
