"""All cases, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from difflib import get_close_matches
from fnmatch import fnmatchcase

from mirrorskin.bench import (
    accuracy,
    batch,
    calls,
    correlation,
    integration,
    live,
    normals,
    onset,
    paths,
    pose,
    robust,
    sweep,
    twin,
)
from mirrorskin.bench.harness import Case, Cases, InaccurateError
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device

_RUNS: Cases = {
    **calls.CASES,
    **onset.CASES,
    **normals.CASES,
    **correlation.CASES,
    **integration.CASES,
    **robust.CASES,
    **twin.CASES,
    **sweep.CASES,
    **paths.CASES,
    **batch.CASES,
    **live.CASES,
    **pose.CASES,
    **accuracy.CASES,
}
NAMES = tuple(_RUNS)
_ACCURACY = frozenset(accuracy.CASES)


def choose(patterns: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the cases that any pattern, such as ``full-*``, fits, in the order of `NAMES`.

    Raises InputError where a pattern fits none.
    """
    wanted: set[str] = set()
    for pattern in patterns:
        fitting = [name for name in NAMES if fnmatchcase(name, pattern)]
        if not fitting:
            near = ", ".join(get_close_matches(pattern, NAMES, cutoff=0))
            raise InputError(f"case {pattern!r}: no such case; the nearest are {near}; --list names all")
        wanted.update(fitting)
    return tuple(name for name in NAMES if name in wanted)


def run_suite(
    device: Device,
    names: Iterable[str] = NAMES,
    quick: bool = False,
    done: Callable[[Case], None] = lambda case: None,
) -> list[Case]:
    """Run cases in their order."""
    cases = []
    for name in choose(names):
        cases.append(_RUNS[name](device, quick))
        done(cases[-1])
    return cases


def check_accuracy(cases: Iterable[Case]) -> None:
    """Raise InaccurateError if a bound of accuracy was missed: a device that is quick and wrong fails."""
    missed = [
        f"{case.name}, {target.what}: {target.measured}, must be {target.bound}"
        for case in cases
        if case.name in _ACCURACY
        for target in case.targets
        if not target.met
    ]
    if missed:
        more = f" (and {len(missed) - 1} more)" if len(missed) > 1 else ""
        raise InaccurateError(f"the device is not accurate: {missed[0]}{more}")
