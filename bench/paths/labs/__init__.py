"""What a lab would write today: from a file with frames to a file with heights."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from mirrorskin.bench.peers.onset.peer import Floats

Lab = Callable[[Path, str, Floats, Floats, Path], Floats]
"""``(file, dataset, dark, bright, target)`` to heights by equation 4, (H, W), mm, which it saves as well."""

_NUMPY = "h5py and NumPy argmax"
_NUMBA = "h5py and Numba", "h5py and Numba in tiles"


def find_labs() -> tuple[dict[str, Lab], dict[str, str]]:
    """Return what can be run, by name, and why the others cannot."""
    labs: dict[str, Lab] = {_NUMPY: import_module(f"{__name__}.numpy_").reconstruct}
    try:
        numba = import_module(f"{__name__}.numba_")
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        return labs, dict.fromkeys(_NUMBA, "Numba is not installed")
    return {**labs, **dict(zip(_NUMBA, (numba.reconstruct, numba.reconstruct_in_tiles), strict=True))}, {}
