"""How fast the digital twin renders: it has to drive the live loop."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.results import Case, Row
from mirrorskin.bench.same import DisagreementError
from mirrorskin.hw import Twin
from mirrorskin.hw.twin import Axial, Camera, Vertical
from mirrorskin.hw.twin.movement import Movement
from mirrorskin.kernels.device import Device

_NOISE, _ELECTRONS = 1.5, 40.0
_FIELD = 12.0  # width of the picture, mm
_OURS, _PEER = "mirrorskin, vertical", "NumPy, vertical"
_PHASES = 8


def run_twin(shape: tuple[int, int, int], device: Device, rounds: int) -> Case:
    """Time presses and rotations on the sphere, `conform` and `ideal`, and a step of elastic contact.

    A turn is a whole stack, and of elastic contact the sheet of one frame. NumPy renders the same press from
    the same light, with its own generator's noise.

    Parameters
    ----------
    shape : (int, int, int)
        Frames, rows and columns; elastic contact has a square of the longer side, 512 pixels at most.
    device : Device
    rounds : int

    Raises
    ------
    DisagreementError
        The two presses are not two draws of the same noise on the same light.
    """
    travel = np.linspace(0.05, 3.0, shape[0])
    press = _make(shape, Vertical(travel), device)
    turn = _make(shape, Axial(np.arange(shape[0]) * 2 * np.pi / _PHASES, np.radians(2.5), 1.0), device)
    frames, others, theirs = np.empty((3, *shape), np.uint8)
    clean = _clean(shape, travel, device)
    side = min(512, max(shape[1:]))
    limits = Limits(device, np.zeros(shape, np.uint8))
    ours: dict[str, Work] = {
        _OURS: lambda: _render(press, frames),
        "mirrorskin, rotation": lambda: _render(turn, others),
        _PEER: lambda: _render_numpy(clean, theirs),
        f"mirrorskin, elastic {side} x {side}": _elastic(side, device),
    }

    def check(results: dict[str, Any]) -> None:
        _check(results[_OURS], results[_PEER], clean)

    measured = take_turns(limits.works() | ours, rounds, device.profile, check)
    rows = [Row(name, measured[name], frames.nbytes, shape[0]) for name in list(ours)[:-1]]
    rows.append(Row(list(ours)[-1], measured[list(ours)[-1]], side * side, 1))
    title = f"rendering {' x '.join(map(str, shape))} uint8, the sphere"
    return Case("twin", title, limits.rows(measured) + rows, {})


def _make(shape: tuple[int, int, int], movement: Movement, device: Device, **changes: Any) -> Twin:
    camera = Camera(noise=_NOISE, electrons=_ELECTRONS)
    given: dict[str, Any] = {"shape": shape[1:], "pixel_size": _FIELD / shape[2], "camera": camera}
    return Twin(object="sphere", movement=movement, device=device, **(given | changes))


def _render(twin: Twin, out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    twin.rewind()
    twin.read(out)
    return out


def _clean(shape: tuple[int, int, int], travel: NDArray[np.float64], device: Device) -> NDArray[np.float32]:
    """Return what a camera without noise or rounding would see."""
    out = np.empty(shape, np.float32)
    camera = Camera(np.dtype(np.float32), noise=0.0)
    _make(shape, Vertical(travel), device, camera=camera).read(out)
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


def _elastic(side: int, device: Device) -> Work:
    """Return a work that solves for a sheet 0.1 mm deeper each time, from 1 to 3 mm and again."""
    travel = np.linspace(1.0, 3.0, 21)
    twin = _make((len(travel), side, side), Vertical(travel), device, contact="elastic")
    steps = itertools.cycle(range(len(travel)))
    return lambda: twin.sheet(next(steps))


def _check(ours: NDArray[np.uint8], theirs: NDArray[np.uint8], clean: NDArray[np.float32]) -> None:
    """Compare mean and spread of the noise, per frame, with what the camera's numbers say."""
    variance = _NOISE**2 + (clean - Camera().dark) / _ELECTRONS + 1 / 12
    for name, frames in ((_OURS, ours), (_PEER, theirs)):
        z = (frames - clean) / np.sqrt(variance)
        error = 6 / np.sqrt(clean[0].size)
        mean, spread = z.mean(axis=(1, 2)), z.std(axis=(1, 2))
        off = np.maximum(np.abs(mean) / error, np.abs(spread - 1) / (0.01 + error))
        if off.max() > 1:
            frame = int(off.argmax())
            raise DisagreementError(
                f"{name}: in frame {frame} its noise has a mean of {mean[frame]:.4f} and a spread of"
                f" {spread[frame]:.4f} of what the camera's numbers say; nothing was timed"
            )
