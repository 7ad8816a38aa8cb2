"""Speed of the digital twin, which must be fast enough for the live loop."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.suite.harness import Cases
from mirrorskin.cli.commands.bench.limits import time_works
from mirrorskin.cli.commands.bench.records import Case
from mirrorskin.cli.commands.bench.timing import OURS, Work
from mirrorskin.kernels.device import Device
from mirrorskin.twin import Axial, Camera, Movement, Twin, Vertical

_SHAPE, _QUICK = (128, 480, 640), (12, 48, 64)
_FIELD = 12.0  # width of the picture, mm


def run_twin(device: Device, quick: bool) -> Case:
    """Time presses and rotations on the sphere, `conform` and `ideal`, and a step of elastic contact."""
    shape = _QUICK if quick else _SHAPE
    press = _make(shape, Vertical(np.linspace(0.05, 3.0, shape[0])), device)
    turn = _make(shape, Axial(np.arange(shape[0]) * 2 * np.pi / 8, np.radians(2.5), 1.0), device)
    frames = np.empty(shape, np.uint8)
    side = min(512, max(shape[1:]))
    steps = np.linspace(1.0, 3.0, 21)  # mm, in steps of 0.1 mm
    elastic = _make((len(steps), side, side), Vertical(steps), device, contact="elastic")
    step = itertools.cycle(range(len(steps)))
    works = {
        f"{OURS}, vertical": Work(partial(_render, press, frames), frames.nbytes, shape[0]),
        f"{OURS}, rotation": Work(partial(_render, turn, frames), frames.nbytes, shape[0]),
        f"{OURS}, elastic {side} x {side}": Work(lambda: elastic.sheet(next(step)), side * side, 1),
    }
    rows = time_works(works, frames.nbytes, device, quick)
    return Case("twin", f"rendering {' x '.join(map(str, shape))} uint8, the sphere", list(rows.values()))


CASES: Cases = {"twin": run_twin}


def _make(shape: tuple[int, int, int], movement: Movement, device: Device, **options: Any) -> Twin:
    return Twin(
        object="sphere",
        shape=shape[1:],
        pixel_size=_FIELD / shape[2],
        movement=movement,
        camera=Camera(noise=1.5, electrons=40.0),
        device=device,
        **options,
    )


def _render(twin: Twin, out: NDArray[np.uint8]) -> None:
    twin.rewind()
    twin.read(out)
