"""Peers for the correlation with a rotation's phase."""

from __future__ import annotations

from mirrorskin.bench.peers import load_peers
from mirrorskin.bench.peers.correlation.peer import Peer, Wave

__all__ = ["Peer", "Wave", "find_peers"]

_NAMES = ("numpy_", "torch_", "numba_")


def find_peers() -> tuple[list[Peer], dict[str, str]]:
    """Return the peers whose libraries are installed, and why the others are missing, by library."""
    return load_peers("correlation", _NAMES)
