"""Light whose noise is known: mean, spread and skewness of what the twin's camera counts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.accuracy.aims import at_most, tell, within
from mirrorskin.bench.results import Case, Target
from mirrorskin.hw import Twin
from mirrorskin.hw.twin import Camera, Vertical
from mirrorskin.kernels.device import Device

_NOISE, _ELECTRONS = 2.0, 4.0  # standard deviation, counts; electrons of a count
_LEVELS = 8  # of light, from dark to bright
_WAY = 12.0  # width of the picture, mm


def run_twin(device: Device, quick: bool) -> Case:
    """Hold the moments of a camera's noise against its numbers, from the dark to full light.

    Read noise is normal, shot noise Poisson's: in counts, light L above the dark has the variance r^2 + L / e
    and the third moment L / e^2, with e electrons a count.
    """
    shape, count = ((60, 80), 12) if quick else ((240, 320), 30)
    travel = np.linspace(0.05, 3.0, count)
    clean = _render(shape, travel, Camera(np.dtype(np.float32), noise=0.0), device)
    noisy = _render(shape, travel, Camera(np.dtype(np.float32), noise=_NOISE, electrons=_ELECTRONS), device)
    whole = _render(shape, travel, Camera(noise=_NOISE, electrons=_ELECTRONS), device)
    targets = []
    for number, part in enumerate(_cut(clean)):
        if np.count_nonzero(part) > 2000:
            targets += _moments(f"light {number + 1} of {_LEVELS}", clean[part], noisy[part])
    rounded = np.rint(np.clip(noisy, 0, 255))
    targets.append(
        at_most("8 bits: counts that are not the rounded ones", float(np.mean(whole != rounded)), 1e-4)
    )
    return tell(
        "accuracy-twin", f"noise of {count} x {shape[0]} x {shape[1]} samples of the twin's camera", targets
    )


def _render(
    shape: tuple[int, int], travel: NDArray[np.float64], camera: Camera, device: Device
) -> NDArray[np.float64]:
    """Return the frames of a press on the sphere, as float64."""
    size = _WAY / shape[1]
    twin = Twin(
        object="sphere", movement=Vertical(travel), shape=shape, pixel_size=size, camera=camera, device=device
    )
    out = np.empty((len(travel), *shape), camera.dtype)
    twin.read(out)
    return out.astype(np.float64)


def _cut(clean: NDArray[np.float64]) -> list[NDArray[np.bool_]]:
    """Return where samples are of each level of light."""
    ends = np.linspace(clean.min(), clean.max(), _LEVELS + 1)
    ends[-1] += 1
    return [(clean >= low) & (clean < high) for low, high in pairwise(ends)]


def _moments(where: str, clean: NDArray[np.float64], noisy: NDArray[np.float64]) -> list[Target]:
    """Return targets of the first three moments, each with the slack of four of its standard errors."""
    light, count = clean - Camera().dark, clean.size
    variance = _NOISE**2 + np.maximum(light, 0) / _ELECTRONS
    z = (noisy - clean) / np.sqrt(variance)
    third = float(np.mean(np.maximum(light, 0) / _ELECTRONS**2 / variance**1.5))
    slack = 4 / np.sqrt(count)
    return [
        at_most(f"{where}: mean, in standard errors of it", abs(float(z.mean())) * np.sqrt(count), 4.5),
        within(f"{where}: variance of the expected one", float(z.var()), 1 - 1.6 * slack, 1 + 1.6 * slack),
        within(f"{where}: third moment", float(np.mean(z**3)), third - 4 * slack, third + 4 * slack),
    ]
