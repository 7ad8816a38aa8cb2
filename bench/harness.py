"""Fair timing on a shared machine: the works of a case take turns in one process, and must agree first."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.profile import Kind, Profile, Record

Work = Callable[[], object]

OURS = "mirrorskin"
FIRST = f"{OURS}, first call"
"""A whole call, and the same with no memory kept from calls before it."""
ROUNDS = 15
THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

_PAUSE = 0.005  # seconds before a turn, in which the threads of the work before it go to sleep
_PATIENCE = 10.0  # seconds that a work may take in all; it is timed _LEAST times however slow it is
_LEAST = 3
_SECOND_CALL, _FIRST_CALL, _OTHER = 1.3, 1.6, 3e-3  # kernels' times that calls may take, and seconds more
_PEERS = {"NumPy": 10.0}  # times as fast as which we want to be; 1 for the others
_MEMINFO = Path("/proc/meminfo")


class DisagreementError(Exception):
    """Two works that should return the same maps do not; the message names both, the map and a pixel."""

    exit_code = 1


class InaccurateError(Exception):
    """A device's answers are further from the truth than they may be; the message names the number."""

    exit_code = 1


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of one work over its turns: the median, and the quartiles as its spread."""

    median: float
    lower: float
    upper: float
    rounds: int

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        """Return median and quartiles of some seconds."""
        lower, median, upper = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), float(lower), float(upper), len(seconds))


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured of one work.

    Attributes
    ----------
    wall : Timing
        By the host's clock, from the call to its return.
    device : dict of Timing
        The device's own account of a turn by kind: upload, kernel, download; only what there was.
    kernels : dict of float
        Median seconds of a turn in each kernel.
    moved : dict of float
        Bytes that each kernel says that it moves in a turn.
    first, compile : float
        Seconds of the very first call, which is the warm-up, and of building kernels for it.
    """

    wall: Timing
    device: dict[Kind, Timing]
    kernels: dict[str, float]
    moved: dict[str, float]
    first: float
    compile: float

    @property
    def kernel(self) -> float:
        """Median seconds of a turn in kernels, by the device's account; NaN where none ran."""
        return self.device["kernel"].median if "kernel" in self.device else float("nan")


@dataclass(frozen=True, slots=True)
class Row:
    """One work of a case: what a turn moves (in and out, each once), its frames and multiply-adds, or 0.

    Its bandwidth is a share of that of `limit`, or of the first row of its case.
    """

    name: str
    measured: Measured
    bytes: int = 0
    frames: int = 0
    operations: int = 0
    limit: Row | None = None

    @property
    def bandwidth(self) -> float:
        """Bytes per second by the host's clock."""
        return self.bytes / self.measured.wall.median

    @property
    def kernel_bandwidth(self) -> float:
        """Bytes per second by the device's account of its kernels; NaN where none ran."""
        return self.bytes / (self.measured.kernel or float("nan"))


@dataclass(frozen=True, slots=True)
class Target:
    """One aim of a case: what is measured, its bound and value with their units, whether it was reached."""

    what: str
    bound: str
    measured: str
    met: bool


@dataclass(frozen=True, slots=True)
class Case:
    """All works on one input.

    Attributes
    ----------
    name, title : str
    rows : list of Row
        First the limit of which the others are a share, if any. Empty where there are only `targets`.
    absent : dict of str
        Peers that were not run, and why.
    notes : tuple of str
        What else was found.
    targets : tuple of Target
    """

    name: str
    title: str
    rows: list[Row]
    absent: dict[str, str]
    notes: tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()

    def share(self, row: Row) -> float:
        """Return a work's bandwidth as a share of its limit's, by the host's clock; NaN without one."""
        limit = self._limit_of(row)
        return row.bandwidth / limit.bandwidth if limit and limit.bytes else float("nan")

    def kernel_share(self, row: Row) -> float:
        """Return the same share by the device's account of its kernels; NaN where none ran."""
        limit = self._limit_of(row)
        return row.kernel_bandwidth / limit.kernel_bandwidth if limit and limit.bytes else float("nan")

    def _limit_of(self, row: Row) -> Row | None:
        return row.limit or (self.rows[0] if "limit" in self.rows[0].name else None)


Cases = dict[str, Callable[[Device, bool], Case]]
"""What runs each case, by its name: device, and whether it is to be small and quick."""


@dataclass(frozen=True, slots=True)
class _Turn:
    wall: float
    records: list[Record]
    result: object = None

    def seconds(self, kind: Kind, name: str | None = None) -> float:
        return sum(one.seconds for one in self.records if one.kind == kind and name in (None, one.name))


def take_turns(
    works: Mapping[str, Work],
    rounds: int,
    profile: Profile,
    check: Callable[[dict[str, Any]], None] = lambda results: None,
    before: Mapping[str, Callable[[], object]] | None = None,
) -> dict[str, Measured]:
    """Time several works, each once a round, after one warm-up that does not count.

    What is to be done `before` a work, by its name, is not timed.
    A work that has taken 10 s in all and had three turns leaves the remaining rounds to the others.
    """
    firsts = {name: _turn(work, profile) for name, work in works.items()}
    check({name: first.result for name, first in firsts.items()})
    known = {name: (first.wall, first.seconds("compile")) for name, first in firsts.items()}
    firsts.clear()  # and the maps that they hold

    turns: dict[str, list[_Turn]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            mine = turns[name]
            if len(mine) < _LEAST or sum(turn.wall for turn in mine) < _PATIENCE:
                (before or {}).get(name, lambda: None)()
                time.sleep(_PAUSE)
                turn = _turn(work, profile)
                mine.append(_Turn(turn.wall, turn.records))
    return {name: _measured(mine, *known[name]) for name, mine in turns.items()}


def pusher(estimator: Any, frames: NDArray[Any], *, maps: bool = False, **positions: Any) -> Work:
    """Return a work that pushes frames, and waits for the device or, with `maps`, for the result."""

    def work() -> object:
        estimator.reset()
        estimator.push(frames, **positions)
        return estimator.result() if maps else estimator.device.finish()

    return work


def _turn(work: Work, profile: Profile) -> _Turn:
    profile.clear()
    start = time.perf_counter()
    result = work()
    wall = time.perf_counter() - start
    return _Turn(wall, profile.records(), result)


def _measured(turns: list[_Turn], first: float, compile_: float) -> Measured:
    kinds: tuple[Kind, ...] = ("upload", "kernel", "download")
    device = {kind: [turn.seconds(kind) for turn in turns] for kind in kinds}
    moved = {one.name: float(one.bytes) for one in turns[-1].records if one.kind == "kernel"}
    return Measured(
        wall=Timing.of([turn.wall for turn in turns]),
        device={kind: Timing.of(seconds) for kind, seconds in device.items() if any(seconds)},
        kernels={
            name: float(np.median([turn.seconds("kernel", name) for turn in turns])) for name in sorted(moved)
        },
        moved=moved,
        first=first,
        compile=compile_,
    )


def at_most(what: str, value: float, bound: float) -> Target:
    """Return a target that a number reaches from below; NaN does not reach it."""
    return Target(what, f"at most {bound:.3g}", f"{value:.3g}", bool(value <= bound))


def within(what: str, value: float, low: float, high: float) -> Target:
    """Return a target that a number reaches between two ends; NaN does not reach it."""
    return Target(what, f"{low:.4g} to {high:.4g}", f"{value:.4g}", bool(low <= value <= high))


def ratio_target(what: str, bound: float, ours: Row, theirs: Row, than: str, *, faster: bool) -> Target:
    """Return the target that a work is so many times as fast as another, or takes so many times as long."""
    mine, other = (1e3 * row.measured.wall.median for row in (ours, theirs))
    ratio = other / mine if faster else mine / other
    met = ratio >= bound if faster else ratio <= bound
    said = f"at least {bound:g} times as fast as {than}" if faster else f"at most {bound:g} times {than}"
    return Target(
        what, said, f"{ratio:.{1 if faster else 2}f} times ({mine:.0f} against {other:.0f} ms)", met
    )


def call_targets(rows: Sequence[Row], faster: Mapping[str, float] | None = None) -> tuple[Target, ...]:
    """Return what a whole call aims at: to take little more than its kernels do, and less than each peer.

    ``faster`` are peers, or single works of theirs, and how many times as fast as these we want to be.
    """
    goals = {**_PEERS, **(faster or {})}
    by_name = {row.name: row for row in rows}
    ours = by_name[OURS]
    targets = []
    for name, factor in ((OURS, _SECOND_CALL), (FIRST, _FIRST_CALL)):
        most, took = factor * ours.measured.kernel + _OTHER, by_name[name].measured.wall.median
        bound = f"at most {factor} times the kernels and {1e3 * _OTHER:.0f} ms: {1e3 * most:.1f} ms"
        targets.append(Target(name, bound, f"{1e3 * took:.1f} ms", took <= most))
    for peer in rows:
        name, comma, part = peer.name.partition(", ")
        if name != OURS and "limit" not in name:
            mine, wanted = by_name[OURS + comma + part], goals.get(peer.name, goals.get(name, 1.0))
            targets.append(ratio_target(mine.name, wanted, mine, peer, peer.name, faster=True))
    return tuple(targets)


def agree(
    name: str,
    found: Mapping[str, NDArray[Any]],
    expected: Mapping[str, NDArray[Any]],
    tolerance: Mapping[str, Any] | None = None,
    spared: int = 0,
    whose: str = OURS,
) -> None:
    """Raise DisagreementError unless maps are the expected ones, NaN where those are NaN."""
    for word, right in expected.items():
        if word not in found:
            raise DisagreementError(f"{name}: there is no {word}; nothing was timed")
        mine = np.asarray(found[word])
        with np.errstate(invalid="ignore"):
            near = np.abs(mine.astype(np.float64) - right) <= (tolerance or {}).get(word, 0.0)
        same = near | (mine == right) | (np.isnan(mine) & np.isnan(right))
        same = same if same.ndim < 3 else same.all(axis=-1)
        if np.count_nonzero(~same) > spared:
            place = tuple(int(number) for number in np.argwhere(~same)[0])
            raise DisagreementError(
                f"{name} differs from {whose} in the {word} of {np.count_nonzero(~same)} of {same.size} "
                f"pixels, first at {place}: {mine[place]}, not {right[place]}; nothing was timed"
            )


def check_memory(name: str, needed: int) -> None:
    """Raise InputError where the system says how much memory is free, and a case needs more bytes."""
    free = free_memory()
    if free is not None and free < needed:
        raise InputError(
            f"case {name} needs {needed / 1e9:.1f} GB of memory and {free / 1e9:.1f} GB are free: "
            "close other programs, or name other cases with --case"
        )


def free_memory() -> int | None:
    """Return the bytes that a new program can have; None where the system does not say."""
    try:
        lines = _MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))


def missing(*libraries: str) -> dict[str, str]:
    """Return which libraries of peers are not installed, as `Case.absent` says it."""
    from importlib.util import find_spec

    # An idle thread of GNU OpenMP spins for milliseconds, on a core that another work may need by then. The
    # variable is read once, when the library is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    return {library: "not installed" for library in libraries if find_spec(library) is None}
