"""How fast the digital twin renders: it has to drive the live loop."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.cli.bench.limits import time_works
from mirrorskin.cli.bench.records import Case
from mirrorskin.cli.bench.timing import OURS, Work
from mirrorskin.hw.twin import Axial, Camera, Movement, Twin, Vertical
from mirrorskin.kernels.device import Device
from suite.harness import Cases, DisagreementError

_SHAPE, _QUICK = (128, 480, 640), (12, 48, 64)
_NOISE, _ELECTRONS = 1.5, 40.0
_FIELD = 12.0  # width of the picture, mm
_PRESS, _PEER = f"{OURS}, vertical", "NumPy, vertical"


def run_twin(device: Device, quick: bool) -> Case:
    """Time presses and rotations on the sphere, `conform` and `ideal`, and a step of elastic contact.

    NumPy adds noise of the same statistics to the frames of the same press without noise.
    """
    shape = _QUICK if quick else _SHAPE
    travel = np.linspace(0.05, 3.0, shape[0])
    press = _make(shape, Vertical(travel), device)
    turn = _make(shape, Axial(np.arange(shape[0]) * 2 * np.pi / 8, np.radians(2.5), 1.0), device)
    frames, others, theirs = np.empty((3, *shape), np.uint8)
    clean = np.empty(shape, np.float32)
    _make(shape, Vertical(travel), device, camera=Camera(np.dtype(np.float32), noise=0.0)).read(clean)
    side = min(512, max(shape[1:]))
    steps = np.linspace(1.0, 3.0, 21)  # mm, each time 0.1 mm deeper
    elastic = _make((len(steps), side, side), Vertical(steps), device, contact="elastic")
    step = itertools.cycle(range(len(steps)))
    size, count = frames.nbytes, shape[0]
    works = {
        _PRESS: Work(partial(_render, press, frames), size, count),
        f"{OURS}, rotation": Work(partial(_render, turn, others), size, count),
        _PEER: Work(partial(_render_with_numpy, clean, theirs), size, count),
        f"{OURS}, elastic {side} x {side}": Work(lambda: elastic.sheet(next(step)), side * side, 1),
    }

    def check(results: dict[str, Any]) -> None:
        for name in (_PRESS, _PEER):
            _check(name, results[name], clean)

    rows = time_works(works, size, device, quick, check)
    return Case("twin", f"rendering {' x '.join(map(str, shape))} uint8, the sphere", list(rows.values()))


CASES: Cases = {"twin": run_twin}


def _make(shape: tuple[int, int, int], movement: Movement, device: Device, **changes: Any) -> Twin:
    options: dict[str, Any] = {"shape": shape[1:], "pixel_size": _FIELD / shape[2]}
    options["camera"] = Camera(noise=_NOISE, electrons=_ELECTRONS)
    return Twin(object="sphere", movement=movement, device=device, **(options | changes))


def _render(twin: Twin, out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    twin.rewind()
    twin.read(out)
    return out


def _render_with_numpy(clean: NDArray[np.float32], out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Add noise and round in single precision and in place, a frame at a time."""
    generator = np.random.default_rng(0)
    noise = np.empty(clean.shape[1:], np.float32)
    dark = np.float32(Camera().dark)
    for light, frame in zip(clean, out, strict=True):
        generator.standard_normal(dtype=np.float32, out=noise)
        noise *= np.sqrt(np.float32(_NOISE**2) + (light - dark) / np.float32(_ELECTRONS))
        noise += light
        np.rint(noise, out=noise)
        np.clip(noise, 0, 255, out=noise)
        frame[...] = noise
    return out


def _check(name: str, frames: NDArray[np.uint8], clean: NDArray[np.float32]) -> None:
    """Compare mean and standard deviation of the noise of each frame with those of the camera."""
    z = (frames - clean) / np.sqrt(_NOISE**2 + (clean - Camera().dark) / _ELECTRONS + 1 / 12)
    error = 6 / np.sqrt(clean[0].size)
    mean, spread = z.mean(axis=(1, 2)), z.std(axis=(1, 2))
    off = np.maximum(np.abs(mean) / error, np.abs(spread - 1) / (0.01 + error))
    if off.max() > 1:
        frame = int(off.argmax())
        raise DisagreementError(
            f"{name}: the noise of frame {frame} has a mean of {mean[frame]:.4f} and a standard deviation of"
            f" {spread[frame]:.4f} of that of the camera; nothing was timed"
        )
