"""The same answers by other means: each library as one who knows it well would use it for speed."""

from __future__ import annotations

import os
from importlib import import_module

from mirrorskin.bench.peers.peer import THREADS, Heights, Peer, References

__all__ = ["LIBRARIES", "THREADS", "Heights", "Peer", "References", "find_peers"]

# Module of the peer: the library that it needs, which may not be installed.
LIBRARIES = {"argmax": "numpy", "numpy_": "numpy", "opencv": "cv2", "torch_": "torch", "numba_": "numba"}


def find_peers() -> tuple[list[Peer], dict[str, str]]:
    """Return the peers whose libraries are installed, and why the others are missing, by library."""
    # An idle thread of GNU OpenMP spins for milliseconds, on a core that another work may need by then. The
    # variable is read once, when the library is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    peers, absent = [], {}
    for name, library in LIBRARIES.items():
        try:
            import_module(library)
        except ModuleNotFoundError as error:
            if error.name != library:
                raise
            absent[library] = "not installed"
        else:
            peers.append(import_module(f"mirrorskin.bench.peers.{name}").PEER)
    return peers, absent
