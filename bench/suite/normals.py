"""Normals of one turn of an axial rotation: the engine and the limits."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from mirrorskin.bench.suite.harness import Cases, check_memory, time_call
from mirrorskin.cli.commands.bench.records import Case
from mirrorskin.engine import estimate_normals
from mirrorskin.evaluation.scenes.inputs import SCALES, STEPS, TILT, fill_turns, phases, turn_noise
from mirrorskin.kernels.device import Device

_QUICK = (48, 64)
_MAPS = 3 * 4 + 4 + 1 + 4  # bytes per pixel: normal, sigma, contact and mean
_WORKING = 160  # bytes per pixel of working memory of all works


def run_normals(name: str, kind: str, shape: tuple[int, int], device: Device, quick: bool) -> Case:
    """Time the exact method on one turn; the bytes of frames and maps are counted once."""
    shape, dtype = _QUICK if quick else shape, np.dtype(kind)
    moved = math.prod(shape) * (STEPS * dtype.itemsize + _MAPS)
    check_memory(name, 2 * moved + _WORKING * math.prod(shape))
    frames = np.empty((STEPS, *shape), dtype)
    fill_turns(frames)
    offset, gain, _ = SCALES[kind]
    call = partial(
        estimate_normals,
        frames,
        phases(STEPS),
        tilt=TILT,
        zenith_gain=gain,
        zenith_offset=offset,
        noise=turn_noise(dtype),
        device=device,
    )
    title = f"exact method to normals, sigma, contact and mean; {STEPS} x {shape[0]} x {shape[1]} {kind}"
    return time_call(name, title, call, moved, device, quick, frames=STEPS, first="triad")


CASES: Cases = {
    **{
        f"normals-{kind}": partial(run_normals, f"normals-{kind}", kind, (1080, 1920))
        for kind in ("uint8", "uint16", "float32")
    },
    "normals-4k": partial(run_normals, "normals-4k", "uint8", (2160, 3840)),
}
