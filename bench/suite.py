"""All cases, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from difflib import get_close_matches
from fnmatch import fnmatchcase

import numpy as np

from mirrorskin.bench import accuracy, live, paths, scaling, sweep
from mirrorskin.bench.accuracy import InaccurateError
from mirrorskin.bench.correlation import CorrelationCase, run_correlation, run_sliding
from mirrorskin.bench.integration import IntegrationCase, run_frames, run_mask, run_rectangle
from mirrorskin.bench.live import run_live
from mirrorskin.bench.normals import NormalsCase, run_normals
from mirrorskin.bench.onset import OnsetCase, run_onset
from mirrorskin.bench.results import Case
from mirrorskin.bench.stacks import StackName
from mirrorskin.bench.twin import run_twin
from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device

_HD, _MEMORY, _LIVE = (64, 1080, 1920), (240, 2160, 3840), (256, 480, 640)
_RENDERED, _WINDOW = (128, 480, 640), (64, 480, 640)
_MPIXEL = (1024, 1024)
_QUICK = (12, 48, 64)
_TURNS = 16  # frames of a quick correlation, whole turns
_ROUNDS = 15

_Run = Callable[[Device, bool], Case]


def _case(
    name: str,
    shape: tuple[int, int, int] = _HD,
    dtype: str = "uint8",
    stack: StackName = "random",
    full: bool = False,
    hold: int = 1,
) -> OnsetCase:
    return OnsetCase(name, shape, np.dtype(dtype), full, hold, stack)


def _pushed(name: str, stack: StackName) -> dict[str, OnsetCase]:
    return {
        "mirrorskin, equation 4": _case(name, _LIVE, stack=stack),
        "mirrorskin, full default": _case(name, _LIVE, stack=stack, full=True),
    }


_ONSET = [
    _case("equation4-uint8"),
    _case("equation4-uint16", dtype="uint16"),
    _case("equation4-float32", dtype="float32"),
    _case("equation4-memory", _MEMORY),
    _case("hold2-uint8", hold=2),
    _case("full-uint8", full=True, stack="press"),
    _case("full-uint16", dtype="uint16", full=True, stack="press"),
    _case("full-float32", dtype="float32", full=True, stack="press"),
    _case("full-memory", _MEMORY, full=True, stack="press"),
    _case("full-random", full=True),
]
_PUSHED = {
    "live": _pushed("live", "press"),
    "live-random": _pushed("live-random", "random"),
}
_NORMALS = [
    NormalsCase("normals-uint8", _HD[1:], np.dtype(np.uint8)),
    NormalsCase("normals-uint16", _HD[1:], np.dtype(np.uint16)),
    NormalsCase("normals-float32", _HD[1:], np.dtype(np.float32)),
]
_CORRELATE = CorrelationCase("correlate-uint8", _HD)
_INTEGRATION = {
    IntegrationCase("integrate-rectangle", _MPIXEL): run_rectangle,
    IntegrationCase("integrate-rectangle-4mp", (2048, 2048)): run_rectangle,
    IntegrationCase("integrate-mask", _MPIXEL): run_mask,
    IntegrationCase("integrate-cuts", _MPIXEL, cuts=50): run_mask,
    IntegrationCase("integrate-live", _LIVE[1:]): run_frames,
}
_SLIDING = CorrelationCase("sliding", _WINDOW)


def _onset(case: OnsetCase) -> _Run:
    return lambda device, quick: run_onset(_sized(case, quick), device, _rounds(quick))


def _live(cases: dict[str, OnsetCase]) -> _Run:
    return lambda device, quick: run_live(
        {row: _sized(case, quick) for row, case in cases.items()}, device, _rounds(quick)
    )


def _sized(case: OnsetCase, quick: bool) -> OnsetCase:
    return replace(case, shape=_QUICK) if quick else case


def _twin(device: Device, quick: bool) -> Case:
    return run_twin(_QUICK if quick else _RENDERED, device, _rounds(quick))


def _normals(case: NormalsCase) -> _Run:
    return lambda device, quick: run_normals(
        replace(case, shape=_QUICK[1:]) if quick else case, device, _rounds(quick)
    )


def _correlation(case: CorrelationCase, run: Callable[[CorrelationCase, Device, int], Case]) -> _Run:
    return lambda device, quick: run(
        replace(case, shape=(_TURNS, *_QUICK[1:])) if quick else case, device, _rounds(quick)
    )


def _integration(case: IntegrationCase, run: Callable[[IntegrationCase, Device, int], Case]) -> _Run:
    return lambda device, quick: run(
        replace(case, shape=_QUICK[1:]) if quick else case, device, _rounds(quick)
    )


def _rounds(quick: bool) -> int:
    return 1 if quick else _ROUNDS


_RUNS: dict[str, _Run] = {
    **{case.name: _onset(case) for case in _ONSET},
    **{name: _live(cases) for name, cases in _PUSHED.items()},
    "twin": _twin,
    **{case.name: _normals(case) for case in _NORMALS},
    _CORRELATE.name: _correlation(_CORRELATE, run_correlation),
    _SLIDING.name: _correlation(_SLIDING, run_sliding),
    **{case.name: _integration(case, run) for case, run in _INTEGRATION.items()},
    **sweep.CASES,
    **paths.CASES,
    **live.CASES,
    **scaling.CASES,
    **accuracy.CASES,
}
NAMES = tuple(_RUNS)
_ACCURACY = frozenset(accuracy.CASES)


def choose(patterns: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the cases that any of some patterns fits, in the order of `NAMES`.

    Parameters
    ----------
    patterns : iterable of str
        Names, or what stands for several: ``full-*``.

    Raises
    ------
    InputError
        A pattern fits no case.
    """
    wanted: set[str] = set()
    for pattern in patterns:
        fitting = [name for name in NAMES if fnmatchcase(name, pattern)]
        if not fitting:
            near = ", ".join(get_close_matches(pattern, NAMES, cutoff=0))
            raise InputError(f"case {pattern!r}: no such case; the nearest are {near}; --list tells all")
        wanted.update(fitting)
    return tuple(name for name in NAMES if name in wanted)


def run_suite(
    device: Device,
    names: Iterable[str] = NAMES,
    quick: bool = False,
    done: Callable[[Case], None] = lambda case: None,
) -> list[Case]:
    """Run cases in their order.

    Parameters
    ----------
    device : Device
    names : iterable of str
        Names or patterns; see `choose`.
    quick : bool
        Small stacks and one round: that all works agree is checked, the times mean nothing.
    done : callable
        Is given each case as soon as it is done.

    Raises
    ------
    InputError
        No case has such a name, or there is not enough memory for one.
    DisagreementError
        Works that should return the same maps do not.
    """
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
