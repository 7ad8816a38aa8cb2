"""Common parts of cases: timing with limits and peers, comparison of maps, targets, free memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.cli.commands.bench.limits import call_works, time_works
from mirrorskin.cli.commands.bench.records import Case, Row, Target
from mirrorskin.cli.commands.bench.timing import FIRST, OURS, Work
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device

Run = Callable[[Device, bool], Case]
Cases = dict[str, Run]
"""Functions that run cases, by name; arguments are the device, and whether the case is small and quick."""

# Limits of calls: the time of the kernels times a factor, plus seconds.
_SECOND_CALL, _FIRST_CALL, _OTHER = 1.3, 1.6, 3e-3
_PEERS = {"NumPy": 10.0}  # target speed relative to peers; 1 for the others
_MEMINFO = Path("/proc/meminfo")


class DisagreementError(Exception):
    """Two works returned different maps; the message names both, the map and a pixel."""

    exit_code = 1


def time_call(
    name: str,
    title: str,
    call: Callable[[], object],
    moved: int,
    device: Device,
    quick: bool,
    *,
    frames: int = 0,
    peers: Mapping[str, Callable[[], object]] | None = None,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
    first: str = "read",
    absent: Mapping[str, str] | None = None,
) -> Case:
    """Time a public function, arrays in and maps out, with the limits and its peers; see `call_targets`."""
    works = call_works(call, moved, frames)
    works |= {peer: Work(work, moved, frames) for peer, work in (peers or {}).items()}
    rows = time_works(works, moved, device, quick, check, first=first)
    targets = () if quick else call_targets(rows)
    return Case(name, title, list(rows.values()), dict(absent or {}), targets=targets)


def ratio_target(what: str, bound: float, ours: Row, theirs: Row, than: str, *, faster: bool) -> Target:
    """Return the target that a work is `bound` times as fast as another, or takes `bound` times as long."""
    mine, other = (1e3 * row.wall.median for row in (ours, theirs))
    ratio = other / mine if faster else mine / other
    met = ratio >= bound if faster else ratio <= bound
    limit = f"at least {bound:g} times as fast as {than}" if faster else f"at most {bound:g} times {than}"
    value = f"{ratio:.{1 if faster else 2}f} times ({mine:.0f} against {other:.0f} ms)"
    return Target(what, limit, value, met)


def call_targets(rows: Mapping[str, Row], faster: Mapping[str, float] | None = None) -> tuple[Target, ...]:
    """Return the targets of a whole call: little overhead beyond its kernels, and faster than each peer.

    `faster` specifies the target speed relative to peers, or to single works of peers.
    """
    goals = {**_PEERS, **(faster or {})}
    targets = []
    for name, factor in ((OURS, _SECOND_CALL), (FIRST, _FIRST_CALL)):
        limit, took = factor * rows[OURS].kernel + _OTHER, rows[name].wall.median
        bound = f"at most {factor} times the kernels and {1e3 * _OTHER:.0f} ms: {1e3 * limit:.1f} ms"
        targets.append(Target(name, bound, f"{1e3 * took:.1f} ms", took <= limit))
    for peer in rows.values():
        name, comma, part = peer.name.partition(", ")
        if name != OURS and not peer.is_limit:
            mine, goal = rows[OURS + comma + part], goals.get(peer.name, goals.get(name, 1.0))
            targets.append(ratio_target(mine.name, goal, mine, peer, peer.name, faster=True))
    return tuple(targets)


def agree(
    name: str,
    maps: Mapping[str, NDArray[Any]],
    expected: Mapping[str, NDArray[Any]],
    tolerance: Mapping[str, Any] | None = None,
    whose: str = OURS,
) -> None:
    """Raise DisagreementError unless maps equal the expected ones within a tolerance, with the same NaN."""
    for word, right in expected.items():
        if word not in maps:
            raise DisagreementError(f"{name}: there is no {word}; nothing was timed")
        mine = np.asarray(maps[word])
        with np.errstate(invalid="ignore"):
            near = np.abs(mine.astype(np.float64) - right) <= (tolerance or {}).get(word, 0.0)
        same = near | (mine == right) | (np.isnan(mine) & np.isnan(right))
        same = same if same.ndim < 3 else same.all(axis=-1)
        if not same.all():
            place = tuple(int(number) for number in np.argwhere(~same)[0])
            raise DisagreementError(
                f"{name} differs from {whose} in the {word} of {np.count_nonzero(~same)} of {same.size} "
                f"pixels, first at {place}: {mine[place]}, not {right[place]}; nothing was timed"
            )


def check_memory(name: str, needed: int) -> None:
    """Raise InputError if the system reports less free memory than a case needs, bytes."""
    free = free_memory()
    if free is not None and free < needed:
        raise InputError(
            f"case {name}: {needed / 1e9:.1f} GB of memory are needed and {free / 1e9:.1f} GB are free."
            " Close other programs, or name other cases"
        )


def free_memory() -> int | None:
    """Return the bytes available to a new program; None if the system does not report them."""
    try:
        lines = _MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))


def missing(*libraries: str) -> dict[str, str]:
    """Return the libraries that are not installed, as in `Case.absent`."""
    from importlib.util import find_spec

    # An idle thread of GNU OpenMP spins for milliseconds on a core that the next work needs. The variable is
    # read once, when the library is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    return {library: "not installed" for library in libraries if find_spec(library) is None}
