"""Surfaces whose heights are known: from their slopes, and from a press and a turn together."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.accuracy.aims import at_most, tell, within
from mirrorskin.bench.accuracy.rotation import SENSORS, TILT, expose, phases, toward
from mirrorskin.bench.results import Case, Target
from mirrorskin.engine import Surface, estimate_normals, fuse, integrate
from mirrorskin.kernels.device import Device

_PIXEL = 0.05  # mm
_RADIUS = 5.0  # of the ball, mm
_STEP = 0.1  # of the press, mm
_LIT = np.radians([11.8, 45.0])  # zenith of what turns light
_DEEP = np.radians(57.0)  # as far as the sheet lies on the ball
_NOISE = 0.02  # of a slope

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Known(NamedTuple):
    """Heights, mm, and slopes along x and y, y up."""

    height: Doubles
    dz_dx: Doubles
    dz_dy: Doubles


def run_surfaces(device: Device, quick: bool) -> Case:
    """Hold heights from exact slopes against the surfaces they are of: whole pictures, masks and noise."""
    shape = (45, 60) if quick else (600, 801)
    targets = []
    for name, (make, bound) in _SURFACES.items():
        known = make(*_grid(shape))
        whole = integrate(known.dz_dx, known.dz_dy, _PIXEL, sigma=False, device=device)
        targets.append(
            at_most(f"{name}, whole picture: RMS error, of the range", _error(whole, known), bound)
        )
        mask = _ring(shape)
        part = integrate(known.dz_dx, known.dz_dy, _PIXEL, mask=mask, sigma=False, device=device)
        targets.append(at_most(f"{name}, a ring: RMS error, of the range", _error(part, known), bound + 2e-5))
    targets += _noisy(device, quick)
    return tell(
        "accuracy-surfaces", f"heights of {shape[0]} x {shape[1]} slopes of analytic surfaces", targets
    )


def _plane(x: Doubles, y: Doubles) -> Known:
    return Known(0.3 * x - 0.2 * y, np.full_like(x, 0.3), np.full_like(x, -0.2))


def _cubic(x: Doubles, y: Doubles) -> Known:
    """Return a polynomial of third degree, for which the rule of four pixels is exact."""
    u, v = x / np.ptp(x), y / np.ptp(x)
    height = np.ptp(x) * (0.3 * u**3 - 0.2 * u**2 + 0.4 * v**3 + 0.1 * u)
    return Known(height, 0.9 * u**2 - 0.4 * u + 0.1, 1.2 * v**2)


def _bump(x: Doubles, y: Doubles) -> Known:
    """Return a bump of a standard deviation of 3 pixels."""
    wide = 3 * _PIXEL
    height = wide * np.exp(-(x**2 + y**2) / (2 * wide**2))
    return Known(height, -x / wide**2 * height, -y / wide**2 * height)


def _waves(x: Doubles, y: Doubles) -> Known:
    """Return waves 40 pixels long, across each other."""
    k = 2 * np.pi / (40 * _PIXEL)
    return Known(
        0.3 / k * np.sin(k * x) * np.cos(k * y),
        0.3 * np.cos(k * x) * np.cos(k * y),
        -0.3 * np.sin(k * x) * np.sin(k * y),
    )


_SURFACES: dict[str, tuple[Callable[[Doubles, Doubles], Known], float]] = {
    "plane": (_plane, 1e-6),
    "cubic": (_cubic, 3e-6),
    "bump of 3 pixels": (_bump, 3e-4),
    "waves of 40 pixels": (_waves, 1e-4),
}


def _noisy(device: Device, quick: bool) -> list[Target]:
    """Return targets of noisy slopes: that sigma is what errors are."""
    shape, draws = ((24, 30), 3) if quick else ((60, 80), 20)
    known = _waves(*_grid(shape))
    generator, square = np.random.default_rng(9), []
    for _ in range(draws):
        noise = generator.normal(0, _NOISE, (2, *shape))
        given = known.dz_dx + noise[0], known.dz_dy + noise[1]
        found = integrate(*given, _PIXEL, slope_weights=1 / _NOISE**2, device=device)
        error = found.height - known.height
        square.append(np.mean(((error - error.mean()) / found.sigma) ** 2))
    return [
        within(
            "noisy slopes: chi-square", float(np.mean(square)), 0.5 if quick else 0.75, 1.5 if quick else 1.25
        )
    ]


def run_fusion(device: Device, quick: bool) -> Case:
    """Hold the fused surface of a ball against it: a press in steps, and a turn of equation 10 with noise."""
    size = 101 if quick else 201
    x, y = _grid((size, size))
    x, y = 201 / size * x, 201 / size * y
    away = np.hypot(x, y)
    zenith = np.arcsin(np.minimum(away / _RADIUS, 0.999))
    there = zenith <= _DEEP
    truth = np.where(there, np.sqrt(np.maximum(_RADIUS**2 - away**2, 0)) - _RADIUS, np.nan)
    lit = (zenith >= _LIT[0]) & (zenith <= _LIT[1])
    middle = (np.floor(np.nan_to_num(truth) / _STEP) + 0.5) * _STEP
    press = _Press(
        np.where(lit, middle, np.nan).astype(np.float32),
        np.where(lit, _STEP / np.sqrt(12), np.nan).astype(np.float32),
    )
    sensor = SENSORS[1]
    normals = toward(np.where(there, zenith, 0.0), np.arctan2(y, x))
    frames = expose(normals, sensor, 10)
    known = {"tilt": TILT, "gain": sensor.gain, "offset": sensor.offset, "noise": sensor.spread}
    told = estimate_normals(frames, phases(), **known, device=device)
    turn = _Turn(told.vectors, told.sigma, (told.contact * there).astype(np.uint8))
    found = fuse(press, turn, _PIXEL * 201 / size, mask=there, device=device)
    inner = zenith <= _LIT[1]
    error = (found.height - truth)[inner]
    top = (found.height - truth)[zenith <= np.radians(5)]
    answered = float(np.isfinite(error).mean())
    targets = [
        within("pixels with a height", answered, 1.0, 1.0),
        at_most("RMS error up to 45 degrees, mm", _rms(error), 0.003),
        at_most("RMS error of the apex, which stays dark in a press, mm", _rms(top), 0.003),
    ]
    return tell(
        "accuracy-fusion", f"a ball of 10 mm on {size} x {size} pixels, pressed in steps of 0.1 mm", targets
    )


class _Press(NamedTuple):
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]


class _Turn(NamedTuple):
    vectors: NDArray[np.float32]
    sigma: NDArray[np.float32]
    contact: NDArray[np.uint8]


def _grid(shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """Return x and y of the pixels, mm, from the picture's centre; y runs up."""
    x = _PIXEL * (np.arange(shape[1]) - (shape[1] - 1) / 2)
    y = -_PIXEL * (np.arange(shape[0]) - (shape[0] - 1) / 2)
    wide, high = np.meshgrid(x, y)
    return wide, high


def _ring(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a mask with a hole, 1 inside."""
    x, y = _grid(shape)
    away = np.hypot(x, y) / (_PIXEL * min(shape) / 2)
    return ((away < 0.95) & (away > 0.02)).astype(np.uint8)


def _error(found: Surface, known: Known) -> float:
    """Return the root mean square error about its mean, in ranges of the heights."""
    error = (found.height - known.height)[np.isfinite(found.height)]
    return float(np.std(error) / np.ptp(known.height[np.isfinite(found.height)]))


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))
