"""How time goes with frames, pixels and cores, and what a process costs before it is warm."""

from __future__ import annotations

from collections.abc import Callable

from mirrorskin.bench.results import Case
from mirrorskin.bench.scaling.cold import run_cold
from mirrorskin.bench.scaling.cores import run_cores
from mirrorskin.bench.scaling.sizes import run_frames, run_pixels
from mirrorskin.kernels.device import Device

CASES: dict[str, Callable[[Device, bool], Case]] = {
    "scaling-frames": run_frames,
    "scaling-pixels": run_pixels,
    "scaling-cores": run_cores,
    "cold-start": run_cold,
}
"""What runs each case, by its name: device, and whether it should be quick."""

__all__ = ["CASES"]
