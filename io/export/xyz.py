"""Points as text, for programs that read nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TOGETHER = 1 << 16  # rows


def xyz(
    columns: Mapping[str, NDArray[Any]], units: Mapping[str, str], notes: Mapping[str, str]
) -> list[bytes]:
    """Encode points, one a line, after comments that begin with ``#``; the last names the columns.

    Parameters
    ----------
    columns : mapping of ndarray, (N,), float32 or uint8
        ``x, y, z``, and others.
    units : mapping of str
        Of the columns that have one.
    notes : mapping of str
        Comments, one line each.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    names = [f"{name}[{units[name]}]" if name in units else name for name in columns]
    head = [*(f"{name}: {said}" for name, said in notes.items()), " ".join(names)]
    parts = ["".join(f"# {line}\n" for line in head).encode()]
    line = " ".join("%d" if values.dtype.kind == "u" else "%.6f" for values in columns.values()) + "\n"
    rows = np.stack([values.astype(np.float64) for values in columns.values()], axis=1)
    for start in range(0, len(rows), _TOGETHER):
        some = rows[start : start + _TOGETHER]
        parts.append((line * len(some) % tuple(some.ravel().tolist())).encode())
    return parts
