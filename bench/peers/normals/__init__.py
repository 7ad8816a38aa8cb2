"""Peers for the normals of one turn."""

from __future__ import annotations

from mirrorskin.bench.peers import load_peers
from mirrorskin.bench.peers.normals.peer import Normals, Peer, Turn

__all__ = ["Normals", "Peer", "Turn", "find_peers"]

_NAMES = ("numpy_", "torch_", "numba_")


def find_peers() -> tuple[list[Peer], dict[str, str]]:
    """Return the peers whose libraries are installed, and why the others are missing, by library."""
    return load_peers("normals", _NAMES)
