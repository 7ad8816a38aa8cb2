"""Fair timing on a shared machine: the works of a case take turns in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from mirrorskin.kernels.profile import Kind, Profile, Record

Work = Callable[[], object]

_PAUSE = 0.005  # seconds before a turn, in which the threads of the work before it go to sleep
_PATIENCE = 10.0  # seconds that a work may take in all; it is timed _LEAST times however slow it is
_LEAST = 3


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of one work over its turns: the median, and the quartiles as its spread."""

    median: float
    lower: float
    upper: float
    rounds: int


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured of one work.

    Attributes
    ----------
    wall : Timing
        By the host's clock, from the call to its return.
    device : dict of Timing
        The device's own account of a turn by kind of work: upload, kernel, download; only what there was.
    kernels : dict of float
        Median seconds of a turn in each kernel.
    first, compile : float
        Seconds of the very first call, which is the warm-up, and of building kernels for it.
    """

    wall: Timing
    device: dict[Kind, Timing]
    kernels: dict[str, float]
    first: float
    compile: float

    @property
    def kernel(self) -> float:
        """Median seconds of a turn in kernels, by the device's account; NaN where none ran."""
        return self.device["kernel"].median if "kernel" in self.device else float("nan")

    @property
    def transfer(self) -> float:
        """Median seconds of a turn in transfers to and from the device."""
        return sum(self.device[kind].median for kind in ("upload", "download") if kind in self.device)


@dataclass(frozen=True, slots=True)
class _Turn:
    wall: float
    records: list[Record]
    result: object = None

    def seconds(self, kind: Kind, name: str | None = None) -> float:
        return sum(r.seconds for r in self.records if r.kind == kind and name in (None, r.name))


def take_turns(
    works: Mapping[str, Work],
    rounds: int,
    profile: Profile,
    check: Callable[[dict[str, object]], None] = lambda results: None,
) -> dict[str, Measured]:
    """Time several works, each once a round, after one warm-up that does not count.

    A work that has taken 10 s in all and had three turns leaves the remaining rounds to the others.

    Parameters
    ----------
    works : mapping of str to callable
        Each does its whole work and waits for it.
    rounds : int
    profile : Profile
        Of the device that the works use; it is cleared.
    check : callable
        Is given what each work returned in the warm-up, and raises where that is wrong; nothing is timed
        before.

    Returns
    -------
    dict of Measured
    """
    firsts = {}
    for name, work in works.items():
        firsts[name] = _turn(work, profile)
    check({name: first.result for name, first in firsts.items()})
    known = {name: (first.wall, first.seconds("compile")) for name, first in firsts.items()}
    firsts.clear()  # and the maps that they hold

    turns: dict[str, list[_Turn]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            mine = turns[name]
            if len(mine) < _LEAST or sum(turn.wall for turn in mine) < _PATIENCE:
                time.sleep(_PAUSE)
                turn = _turn(work, profile)
                mine.append(_Turn(turn.wall, turn.records))
    return {name: _measured(mine, *known[name]) for name, mine in turns.items()}


def _turn(work: Work, profile: Profile) -> _Turn:
    profile.clear()
    start = time.perf_counter()
    result = work()
    wall = time.perf_counter() - start
    return _Turn(wall, profile.records(), result)


def _measured(turns: list[_Turn], first: float, compile_: float) -> Measured:
    kinds: tuple[Kind, ...] = ("upload", "kernel", "download")
    device = {kind: [turn.seconds(kind) for turn in turns] for kind in kinds}
    names = {record.name for turn in turns for record in turn.records if record.kind == "kernel"}
    return Measured(
        wall=_timing([turn.wall for turn in turns]),
        device={kind: _timing(seconds) for kind, seconds in device.items() if any(seconds)},
        kernels={
            name: float(np.median([turn.seconds("kernel", name) for turn in turns])) for name in sorted(names)
        },
        first=first,
        compile=compile_,
    )


def _timing(values: list[float]) -> Timing:
    lower, median, upper = np.percentile(values, [25, 50, 75])
    return Timing(float(median), float(lower), float(upper), len(values))
