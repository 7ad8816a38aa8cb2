"""NPZ: all of a result as plain arrays."""

from __future__ import annotations

import json
from io import BytesIO
from typing import Any

import numpy as np

from mirrorskin.io.result import UNITS
from mirrorskin.io.types import Result


def npz(result: Result) -> list[bytes]:
    """Encode the maps, where the pixels are, and as JSON their units and how they came about.

    Nothing in it needs ``allow_pickle``.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    arrays: dict[str, Any] = dict(result.maps())
    more = {"x": result.x, "y": result.y, "offset_unknown": result.offset_unknown}
    arrays |= {name: values for name, values in more.items() if values is not None}
    units = {name: unit for name, unit in {**UNITS, "x": "mm", "y": "mm"}.items() if name in arrays}
    arrays |= {"units": json.dumps(units), "process": json.dumps(dict(result.process))}
    file = BytesIO()
    np.savez(file, **arrays)
    return [file.getvalue()]
