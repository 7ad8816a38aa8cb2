"""Whether two ways to compute the same maps agree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin import engine
from mirrorskin.bench.peers import correlation, normals
from mirrorskin.bench.peers.normals.odd import answer
from mirrorskin.bench.peers.onset import Heights
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


def check_normals(
    name: str, ours: engine.Normals, theirs: normals.Normals, frames: NDArray[Any], turn: normals.Turn
) -> None:
    """Raise DisagreementError unless a peer found the same maps of one turn.

    Normals must agree within a hundredth of their standard error, out of contact within 1e-3; standard
    errors within 1e-3 of themselves, means within 1e-5. Contact may differ where limits that are one per cent
    wider or narrower would change it. One pixel in 100 000 is spared: where a normal meets the axis, rounding
    decides which way a sample pulls.
    """
    touching = ours.contact == theirs.contact
    if not touching.all():
        doubtful = np.flatnonzero(~touching)
        wide, narrow = (answer(frames, turn, doubtful, slack).contact for slack in (1.01, 0.99))
        touching.flat[doubtful] = wide != narrow
    spared = touching.size // 100_000
    _require(name, "contact", ours.contact, theirs.contact, touching, spared)
    near = np.where(ours.contact == 1, 0.01 * ours.sigma, 1e-3)
    for word, mine, other, tolerance in (
        ("vectors", ours.vectors, theirs.vectors, near[..., np.newaxis]),
        ("sigma", ours.sigma, theirs.sigma, 1e-3 * ours.sigma),
        ("mean", ours.mean, theirs.mean, 1e-5 * np.abs(ours.mean)),
    ):
        same = (np.abs(mine - other) <= tolerance) | (np.isnan(mine) & np.isnan(other))
        _require(name, word, mine, other, same if same.ndim == 2 else same.all(axis=-1), spared)


def check_correlation(name: str, ours: engine.Correlation, theirs: correlation.Wave) -> None:
    """Raise DisagreementError unless a peer found the same wave, within 1e-5 of the mean."""
    tolerance = 1e-5 * np.abs(ours.mean)
    for word, other in zip(theirs._fields, theirs, strict=True):
        mine = getattr(ours, word)
        same = (np.abs(mine - other) <= tolerance) | (np.isnan(mine) & np.isnan(other))
        _require(name, word, mine, other, same)


def check_surface(name: str, exact: NDArray[Any], found: NDArray[Any], share: float) -> None:
    """Raise DisagreementError unless heights are those of a direct solution, within a share of its range."""
    tolerance = share * (np.nanmax(exact) - np.nanmin(exact))
    same = (np.abs(found - exact) <= tolerance) | (np.isnan(found) & np.isnan(exact))
    _require(name, "height", exact, found, same, whom="a direct solution")


def _require(
    name: str,
    word: str,
    ours: NDArray[Any],
    theirs: NDArray[Any],
    same: NDArray[np.bool_],
    spared: int = 0,
    whom: str = "mirrorskin",
) -> None:
    if np.count_nonzero(~same) <= spared:
        return
    row, column = np.argwhere(~same)[0]
    raise DisagreementError(
        f"{name} differs from {whom} in the {word} of {np.count_nonzero(~same)} of {same.size} pixels, "
        f"first in row {row}, column {column}: {theirs[row, column]}, not {ours[row, column]}; "
        "nothing was timed"
    )
