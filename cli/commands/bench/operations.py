"""The three core operations on standard scenes: onset, correlation and integration."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from mirrorskin import engine
from mirrorskin.cli.commands.bench.limits import call_works, measure_limits, time_works
from mirrorskin.cli.commands.bench.records import Case
from mirrorskin.cli.commands.bench.timing import ROUNDS
from mirrorskin.kernels.device import Device
from mirrorskin.twin import Axial, Camera, Movement, Twin, Vertical

Shape = tuple[int, int, int]

LIMIT_BYTES = 256 << 20
_PRESS, _TURNS, _SURFACE = (64, 1080, 1920), (16, 1080, 1920), (1024, 1024)
_QUICK = 1 / 24  # of the sides
_FIELD = 12.0  # width of a picture, mm
_STEPS = 8  # frames of a turn
_MAPS = 4 * 4  # bytes of a pixel: mean, cosine, sine and residual
_SLOPE, _WAVELENGTH, _NOISE = 0.3, 1.5, 0.02  # amplitude, mm, and standard deviation of a slope


def measure_onset(device: Device, quick: bool) -> Case:
    """Time `find_onset` on a press of a ball, with references of each pixel."""
    shape = _sized(_PRESS, quick)
    twin = _twin(shape, Vertical(np.linspace(0.05, 3.0, shape[0])), device)
    header, frames = twin.header, _frames(twin)
    call = partial(
        engine.find_onset,
        frames,
        np.linspace(0.05, 3.0, shape[0]),
        dark=header.dark,
        bright=header.bright,
        device=device,
    )
    return _time("onset", f"find_onset, {_words(shape)}", call, frames.nbytes, shape[0], device, quick)


def measure_correlation(device: Device, quick: bool) -> Case:
    """Time `correlate` on whole turns of an axial rotation on a ball."""
    shape = _sized(_TURNS, quick)
    phase = np.arange(shape[0]) * (2 * np.pi / _STEPS)
    twin = _twin(shape, Axial(phase, math.radians(2.5), 1.5), device, pattern="linear")
    frames = _frames(twin)
    call = partial(engine.correlate, frames, phase, device=device)
    moved = frames.nbytes + _MAPS * math.prod(shape[1:])
    return _time("correlation", f"correlate, {_words(shape)}", call, moved, shape[0], device, quick)


def measure_integration(device: Device, quick: bool) -> Case:
    """Time `integrate` on noisy slopes of waves across each other, with standard deviations."""
    shape = _sized(_SURFACE, quick)
    pixel = _FIELD / shape[1]
    y, x = (2 * np.pi / _WAVELENGTH * pixel * np.arange(n) for n in shape)
    noise = np.random.default_rng(0).normal(0, _NOISE, (2, *shape))
    dz_dx = (_SLOPE * np.cos(x) * np.cos(y)[:, np.newaxis] + noise[0]).astype(np.float32)
    dz_dy = (_SLOPE * np.sin(x) * np.sin(y)[:, np.newaxis] + noise[1]).astype(np.float32)
    call = partial(engine.integrate, dz_dx, dz_dy, pixel, device=device)
    title = f"integrate, {' x '.join(map(str, shape))} slopes"
    moved = dz_dx.nbytes + dz_dy.nbytes + 4 * math.prod(shape)
    return _time("integration", title, call, moved, 0, device, quick, first="triad")


def measure_device(device: Device, quick: bool) -> Case:
    """Measure the limits of a device."""
    return measure_limits(device, LIMIT_BYTES >> (6 * quick), 1 if quick else ROUNDS)


CASES = {
    "limits": measure_device,
    "onset": measure_onset,
    "correlation": measure_correlation,
    "integration": measure_integration,
}


def _time(
    name: str,
    title: str,
    call: Callable[[], object],
    moved: int,
    frames: int,
    device: Device,
    quick: bool,
    first: str = "read",
) -> Case:
    works = call_works(call, moved, frames)
    return Case(name, title, list(time_works(works, moved, device, quick, first=first).values()))


def _sized(shape: tuple[int, ...], quick: bool) -> Any:
    """Return a shape; if `quick`, with small pictures."""
    return (*shape[:-2], *(round(n * _QUICK) for n in shape[-2:])) if quick else shape


def _words(shape: Shape) -> str:
    return f"{' x '.join(map(str, shape))} uint8"


def _twin(shape: Shape, movement: Movement, device: Device, **sensor: Any) -> Twin:
    pixel_size = _FIELD / shape[2]
    return Twin(
        object="sphere",
        shape=shape[1:],
        pixel_size=pixel_size,
        movement=movement,
        camera=Camera(noise=1.5, electrons=40.0),
        device=device,
        **sensor,
    )


def _frames(twin: Twin) -> Any:
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    return frames
