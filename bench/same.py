"""Whether two ways to compute the same maps agree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers import Heights
from mirrorskin.engine import Onset


class DisagreementError(Exception):
    """Two works that should return the same maps do not; the message names both, the map and a pixel."""

    exit_code = 1


def check_frames(name: str, ours: Onset, theirs: NDArray[np.int32]) -> None:
    """Raise DisagreementError unless a peer found each pixel's onset in the same frame."""
    # A pixel with invalid input has no onset either.
    _require(name, "frame", ours.frame, theirs, ours.frame == np.maximum(theirs, -1))


def check_heights(name: str, ours: Onset, theirs: Heights) -> None:
    """Raise DisagreementError unless a peer found the same maps.

    Status must be equal, heights within one float32 unit, standard deviations within 1e-5 of themselves.
    """
    _require(name, "status", ours.status, theirs.status, ours.status == theirs.status)
    unit = np.spacing(np.abs(theirs.height))
    for word, mine, other, tolerance in (
        ("height", ours.height, theirs.height, unit),
        ("sigma", ours.sigma, theirs.sigma, 1e-5 * np.abs(theirs.sigma)),
    ):
        same = (np.abs(mine - other) <= tolerance) | (np.isnan(mine) & np.isnan(other))
        _require(name, word, mine, other, same)


def _require(name: str, word: str, ours: NDArray[Any], theirs: NDArray[Any], same: NDArray[np.bool_]) -> None:
    if same.all():
        return
    row, column = np.argwhere(~same)[0]
    raise DisagreementError(
        f"{name} differs from mirrorskin in the {word} of {np.count_nonzero(~same)} of {same.size} pixels, "
        f"first in row {row}, column {column}: {theirs[row, column]}, not {ours[row, column]}; "
        "nothing was timed"
    )
