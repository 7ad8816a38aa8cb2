"""What a process costs before it is warm: import, opening the device, compiling, first and second calls."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.bench.harness import Case, Cases, DisagreementError, Measured, Row, Timing, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.scaling import run_process
from mirrorskin.kernels.device import Device

_PRESS, _SMALL = (32, 480, 640), (8, 24, 32)
_COLD, _WARM = 3, 5  # processes with empty caches, and with those of one before
_CACHES = "XDG_CACHE_HOME", "POCL_CACHE_DIR", "CUDA_CACHE_PATH"
_FRAMES = {"press": 32, "turn": 8, "surface": 0}


def run_cold(device: Device, quick: bool) -> Case:
    """Time the steps of processes that start with empty caches of kernels, and with full ones."""
    shape = _SMALL if quick else _PRESS
    works = ("turn",) if quick else tuple(_FRAMES)
    cold, warm = [], []
    for _ in range(1 if quick else _COLD):
        with tempfile.TemporaryDirectory() as folder:
            cold.append(_start(device, shape, works, folder))
            if len(cold) == 1:
                warm = [_start(device, shape, works, folder) for _ in range(1 if quick else _WARM)]
    if len({found["answers"] for found in (*cold, *warm)}) > 1:
        raise DisagreementError("processes with cold and with warm caches do not find the same maps")
    limits = Limits(device, int(np.prod(shape)))
    measured = take_turns(limits.works(), 1 if quick else 5, device.profile)
    rows = [limits.rows(measured)[0], *_rows("cold", cold, shape), *_rows("warm", warm, shape)]
    size = " x ".join(map(str, shape))
    title = (
        f"processes with empty and with full caches of kernels; a press of {size} uint8, a turn, a surface"
    )
    return Case("cold-start", title, rows, {}, (_compiling(cold, "cold"), _compiling(warm, "warm")))


CASES: Cases = {"cold-start": run_cold}


def _start(
    device: Device, shape: tuple[int, int, int], works: tuple[str, ...], caches: str
) -> Mapping[str, Any]:
    """Return what a process measures whose caches lie in a folder, with its time from start to end."""
    folders = {name: str(Path(caches) / name.lower()) for name in _CACHES}
    for folder in folders.values():
        Path(folder).mkdir(exist_ok=True)
    script = str(Path(__file__).with_name("start.py"))
    begun = time.perf_counter()
    found = run_process([sys.executable, "-P", script, device.info.title, *map(str, shape), *works], folders)
    found["seconds"]["from start to end"] = time.perf_counter() - begun
    return found


def _rows(which: str, found: Sequence[Mapping[str, Any]], shape: tuple[int, int, int]) -> list[Row]:
    """Return a row for each step; calls have the bytes of their frames, or of slopes and heights."""
    rows, pixels = [], shape[1] * shape[2]
    for step in found[0]["seconds"]:
        seconds = [one["seconds"][step] for one in found]
        compiling = float(np.median([one["compile"].get(step, 0.0) for one in found]))
        work = step.rpartition(" ")[2]
        frames = min(_FRAMES.get(work, 0), shape[0])
        size = frames * pixels or (12 * pixels if work == "surface" else 0)
        measured = Measured(Timing.of(seconds), {}, {}, {}, seconds[0], compiling)
        rows.append(Row(f"{which}, {step}", measured, size, frames))
    return rows


def _compiling(found: Sequence[Mapping[str, Any]], which: str) -> str:
    """Say how much of the first calls went into building kernels."""
    seconds = np.median([sum(one["compile"].values()) for one in found])
    first = np.median([sum(v for k, v in one["seconds"].items() if k.startswith("first")) for one in found])
    return f"{which}: {seconds:.2f} s of {first:.2f} s of first calls went into building OpenCL kernels"
