"""Peers for the integration of slopes: cosine transforms for a rectangle, algebraic multigrid else."""

from __future__ import annotations

from importlib.util import find_spec

from mirrorskin.bench.peers.integration import opencv, scipy_
from mirrorskin.bench.peers.integration.rectangle import Peer

__all__ = ["Peer", "find_absent", "find_peers"]


def find_peers() -> list[Peer]:
    """Return the peers for a rectangle; their libraries are always there."""
    return [scipy_.PEER, opencv.PEER]


def find_absent() -> dict[str, str]:
    """Return why there is no peer for a mask; nothing where there is one."""
    return {} if find_spec("pyamg") else {"pyamg": "not installed"}
