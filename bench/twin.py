"""How fast the digital twin renders: it has to drive the live loop."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import OURS, Case, Cases, DisagreementError, Row, Work
from mirrorskin.bench.limits import beside_limits
from mirrorskin.hw.twin import Axial, Camera, Movement, Twin, Vertical
from mirrorskin.kernels.device import Device

_SHAPE, _QUICK = (128, 480, 640), (12, 48, 64)
_NOISE, _ELECTRONS = 1.5, 40.0
_FIELD = 12.0  # width of the picture, mm
_PRESS, _PEER = f"{OURS}, vertical", "NumPy, vertical"


def run_twin(device: Device, quick: bool) -> Case:
    """Time presses and rotations on the sphere, `conform` and `ideal`, and a step of elastic contact.

    A turn is a whole stack, and of elastic contact the sheet of one frame. NumPy renders the same press from
    the same light, with its own generator's noise.
    """
    shape = _QUICK if quick else _SHAPE
    travel = np.linspace(0.05, 3.0, shape[0])
    press = _make(shape, Vertical(travel), device)
    turn = _make(shape, Axial(np.arange(shape[0]) * 2 * np.pi / 8, np.radians(2.5), 1.0), device)
    frames, others, theirs = np.empty((3, *shape), np.uint8)
    clean = np.empty(shape, np.float32)  # what a camera without noise or rounding would see
    _make(shape, Vertical(travel), device, camera=Camera(np.dtype(np.float32), noise=0.0)).read(clean)
    side = min(512, max(shape[1:]))
    steps = np.linspace(1.0, 3.0, 21)  # mm, each time 0.1 mm deeper
    elastic = _make((len(steps), side, side), Vertical(steps), device, contact="elastic")
    step = itertools.cycle(range(len(steps)))
    works: dict[str, Work] = {
        _PRESS: lambda: _render(press, frames),
        f"{OURS}, rotation": lambda: _render(turn, others),
        _PEER: lambda: _render_numpy(clean, theirs),
        f"{OURS}, elastic {side} x {side}": lambda: elastic.sheet(next(step)),
    }

    def check(results: dict[str, Any]) -> None:
        for name in (_PRESS, _PEER):
            _check(name, results[name], clean)

    limits, measured = beside_limits(works, frames.nbytes, device, quick, check)
    *stacks, sheet = works
    rows = [Row(name, measured[name], frames.nbytes, shape[0]) for name in stacks]
    rows.append(Row(sheet, measured[sheet], side * side, 1))
    title = f"rendering {' x '.join(map(str, shape))} uint8, the sphere"
    return Case("twin", title, limits + rows, {})


CASES: Cases = {"twin": run_twin}


def _make(shape: tuple[int, int, int], movement: Movement, device: Device, **changes: Any) -> Twin:
    known: dict[str, Any] = {"shape": shape[1:], "pixel_size": _FIELD / shape[2]}
    known["camera"] = Camera(noise=_NOISE, electrons=_ELECTRONS)
    return Twin(object="sphere", movement=movement, device=device, **(known | changes))


def _render(twin: Twin, out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    twin.rewind()
    twin.read(out)
    return out


def _render_numpy(clean: NDArray[np.float32], out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Add noise and quantise as NumPy does it best: in single precision and in place, a frame at a time."""
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
    """Compare mean and spread of the noise, per frame, with what the camera's numbers say."""
    z = (frames - clean) / np.sqrt(_NOISE**2 + (clean - Camera().dark) / _ELECTRONS + 1 / 12)
    error = 6 / np.sqrt(clean[0].size)
    mean, spread = z.mean(axis=(1, 2)), z.std(axis=(1, 2))
    off = np.maximum(np.abs(mean) / error, np.abs(spread - 1) / (0.01 + error))
    if off.max() > 1:
        frame = int(off.argmax())
        raise DisagreementError(
            f"{name}: in frame {frame} its noise has a mean of {mean[frame]:.4f} and a spread of"
            f" {spread[frame]:.4f} of what the camera's numbers say; nothing was timed"
        )
