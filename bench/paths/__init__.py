"""Whole paths: from a file with frames to a file with maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from mirrorskin.bench.paths.batch import BatchCase, run_batch
from mirrorskin.bench.paths.budget import BudgetCase, run_budget
from mirrorskin.bench.paths.lab import LabCase, run_lab
from mirrorskin.bench.paths.press import PressCase, run_press
from mirrorskin.bench.paths.turns import TurnsCase, run_turns
from mirrorskin.bench.results import Case
from mirrorskin.kernels.device import Device

__all__ = ["CASES"]

_QUICK, _FEW = (12, 48, 64), 3
_TURNS = 64  # frames of a quick rotation, whole turns

_PRESSES = (
    PressCase("file-press", (1907, 1024, 1024)),
    PressCase("file-press-packed", (1907, 1024, 1024), "bitshuffle"),
)
_ROTATIONS = (
    TurnsCase("file-turns", (16_000, 240, 320), "normals"),
    TurnsCase("file-turns-wave", (16_000, 240, 320), "wave"),
)
_LAB = LabCase("file-lab", (256, 1080, 1920))
_BUDGET = BudgetCase("file-budget", (6_500, 480, 640))
_BATCH = BatchCase("batch-small", 200, (32, 480, 640))


def _press(case: PressCase) -> Callable[[Device, bool], Case]:
    return lambda device, quick: run_press(replace(case, shape=_QUICK) if quick else case, device, quick)


def _turns(case: TurnsCase) -> Callable[[Device, bool], Case]:
    short = replace(case, shape=(_TURNS, *_QUICK[1:]))
    return lambda device, quick: run_turns(short if quick else case, device, quick)


def _lab(device: Device, quick: bool) -> Case:
    return run_lab(replace(_LAB, shape=_QUICK) if quick else _LAB, device, quick)


def _budget(device: Device, quick: bool) -> Case:
    return run_budget(replace(_BUDGET, shape=_QUICK) if quick else _BUDGET, device, quick)


def _batch(device: Device, quick: bool) -> Case:
    return run_batch(replace(_BATCH, count=_FEW, shape=_QUICK) if quick else _BATCH, device, quick)


CASES: dict[str, Callable[[Device, bool], Case]] = {
    **{case.name: _press(case) for case in _PRESSES},
    **{case.name: _turns(case) for case in _ROTATIONS},
    _LAB.name: _lab,
    _BUDGET.name: _budget,
    _BATCH.name: _batch,
}
"""What is run, by name: it is given the device, and whether the case is to be small."""
