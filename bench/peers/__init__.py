"""The same answers by other means: each library as one who knows it well would use it for speed."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

# Module of a peer: the library that it needs, which may not be installed.
LIBRARIES = {"argmax": "numpy", "numpy_": "numpy", "opencv": "cv2", "torch_": "torch", "numba_": "numba"}


def load_peers(package: str, names: tuple[str, ...]) -> tuple[list[Any], dict[str, str]]:
    """Return the peers whose libraries are installed, and why the others are missing, by library.

    Parameters
    ----------
    package : str
        One below this: what the peers compute.
    names : tuple of str
        Its modules, of `LIBRARIES`; each has a ``PEER``.
    """
    # An idle thread of GNU OpenMP spins for milliseconds, on a core that another work may need by then. The
    # variable is read once, when the library is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    peers, absent = [], {}
    for name in names:
        library = LIBRARIES[name]
        try:
            import_module(library)
        except ModuleNotFoundError as error:
            if error.name != library:
                raise
            absent[library] = "not installed"
        else:
            peers.append(import_module(f"{__name__}.{package}.{name}").PEER)
    return peers, absent
