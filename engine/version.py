"""Which mirrorskin this is."""

from __future__ import annotations

import functools
from importlib.metadata import version


@functools.cache
def program_version() -> str:
    """Return the version of the installed package; to look it up takes a millisecond, so only once."""
    return version("mirrorskin")
