"""How near a device's answers are to known truths: cases of targets, all of which must be met."""

from __future__ import annotations

from collections.abc import Callable

from mirrorskin.bench.accuracy.aims import InaccurateError
from mirrorskin.bench.accuracy.press import run_press
from mirrorskin.bench.accuracy.rotation import run_correlation, run_edges, run_normals
from mirrorskin.bench.accuracy.surfaces import run_fusion, run_surfaces
from mirrorskin.bench.accuracy.twin import run_twin
from mirrorskin.bench.results import Case
from mirrorskin.kernels.device import Device

CASES: dict[str, Callable[[Device, bool], Case]] = {
    "accuracy-press": run_press,
    "accuracy-normals": run_normals,
    "accuracy-correlation": run_correlation,
    "accuracy-edges": run_edges,
    "accuracy-surfaces": run_surfaces,
    "accuracy-fusion": run_fusion,
    "accuracy-twin": run_twin,
}
"""What runs each case, by its name: device, and whether it should be quick."""

__all__ = ["CASES", "InaccurateError"]
