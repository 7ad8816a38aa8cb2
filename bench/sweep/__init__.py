"""Sweeps over sizes and types, a case for each kernel file; see `mirrorskin.bench.sweep.sweep`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from mirrorskin.bench.results import Case
from mirrorskin.bench.sweep import graph, press, rotation, solvers, twin
from mirrorskin.bench.sweep.sweep import run_sweep
from mirrorskin.kernels.device import Device

FAMILIES = (
    press.ONSET,
    press.KNOWN,
    press.UNKNOWN,
    rotation.CORRELATION,
    rotation.NORMALS,
    rotation.EDGES,
    rotation.SLOPES,
    rotation.REGISTRATION,
    graph.LINKS,
    graph.COMPONENTS,
    graph.BILATERAL,
    solvers.RECTANGLE,
    solvers.MULTIGRID,
    twin.WALL,
    twin.EXPOSURE,
)

CASES: dict[str, Callable[[Device, bool], Case]] = {
    family.name: partial(run_sweep, family) for family in FAMILIES
}
"""What runs each case, by its name: device, and whether it should be quick."""

__all__ = ["CASES", "FAMILIES"]
