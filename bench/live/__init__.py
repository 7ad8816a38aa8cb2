"""Live work: frames pushed one by one, and whole runs of frames that do not wait."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from mirrorskin.bench.live.pushed import run_live
from mirrorskin.bench.live.runs import LiveCase, run_press, run_rotation
from mirrorskin.bench.results import Case
from mirrorskin.kernels.device import Device

__all__ = ["CASES", "run_live"]

_QUICK, _SHORT = (48, 64), 0.3

_PRESSES = (
    LiveCase("live-vertical-vga", (480, 640), 1000.0, 60.0, least=1000.0),
    LiveCase("live-vertical-1920x1200", (1200, 1920), 165.0, 30.0, least=150.0),
)
_ROTATION = LiveCase("live-axial-vga", (480, 640), 66.0, 60.0)


def _run(case: LiveCase, run: Callable[[LiveCase, Device, bool], Case]) -> Callable[[Device, bool], Case]:
    short = replace(case, shape=_QUICK, rate=100.0, seconds=_SHORT)
    return lambda device, quick: run(short if quick else case, device, quick)


CASES: dict[str, Callable[[Device, bool], Case]] = {
    **{case.name: _run(case, run_press) for case in _PRESSES},
    _ROTATION.name: _run(_ROTATION, run_rotation),
}
"""What is run, by name: it is given the device, and whether the case is to be small."""
