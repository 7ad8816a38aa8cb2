"""How much memory is free, before a case takes it."""

from __future__ import annotations

from pathlib import Path

from mirrorskin.io import InputError

_MEMINFO = Path("/proc/meminfo")


def check_memory(name: str, needed: int) -> None:
    """Raise InputError where the system tells how much memory is free, and a case needs more.

    Parameters
    ----------
    name : str
        Of the case.
    needed : int
        Bytes.
    """
    free = free_memory()
    if free is not None and free < needed:
        raise InputError(
            f"case {name} needs {needed / 1e9:.1f} GB of memory and {free / 1e9:.1f} GB are free: "
            "close other programs, or name other cases with --case"
        )


def free_memory() -> int | None:
    """Return the bytes that a new program can have; None where the system does not tell."""
    try:
        lines = _MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
