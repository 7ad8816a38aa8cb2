"""Peers for the onset of the light state."""

from __future__ import annotations

from mirrorskin.bench.peers import load_peers
from mirrorskin.bench.peers.onset.peer import Heights, Peer, References

__all__ = ["Heights", "Peer", "References", "find_peers"]

_NAMES = ("argmax", "numpy_", "opencv", "torch_", "numba_")


def find_peers() -> tuple[list[Peer], dict[str, str]]:
    """Return the peers whose libraries are installed, and why the others are missing, by library."""
    return load_peers("onset", _NAMES)
