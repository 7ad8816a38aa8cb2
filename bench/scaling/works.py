"""What is scaled: a press, a turn and a surface, in any size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mirrorskin.bench.harness import Work
from mirrorskin.bench.slopes import PIXEL, noisy_slopes
from mirrorskin.bench.stacks import fill as fill_press
from mirrorskin.bench.stacks import noise_of, references
from mirrorskin.bench.sweep.scene import make_mask
from mirrorskin.bench.turns import SCALES, TILT, phases
from mirrorskin.bench.turns import fill as fill_turn
from mirrorskin.engine import Correlator, Integrator, NormalEstimator, OnsetSearch
from mirrorskin.engine.streaming import push_block
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device

Shape = tuple[int, int]

_FRAME: np.dtype[np.uint8] = np.dtype(np.uint8)
_NORMAL = 21  # bytes of a pixel: normal, sigma, contact and mean
_TOLERANCE = 1e-5  # of the solution of a surface
_SURFACE = 2 * 4 + 1 + 4  # slopes, mask and height


@dataclass(frozen=True, slots=True)
class Scaled:
    """A work in one size: what it does, the bytes that it must move, and its frames."""

    work: Work
    bytes: int
    frames: int = 0


def scale_press(device: Device, shape: Shape, count: int) -> Scaled:
    """Return the onset of a press with references of each pixel, its maps included."""
    dark, bright = references(shape, _FRAME)
    search = OnsetSearch(
        shape,
        _FRAME,
        dark=dark,
        bright=bright,
        noise=noise_of(_FRAME),
        device=device,
        memory_limit=2 * count * shape[0] * shape[1],
    )
    frames = search.room[:count]
    fill_press(frames, "press")
    block = Block(frames, 0, travel=np.arange(count, dtype=np.float64) * 0.05)

    def work() -> object:
        search.reset()
        push_block(search, block)
        return search.result()

    return Scaled(work, frames.nbytes, count)


def scale_correlation(device: Device, shape: Shape, count: int) -> Scaled:
    """Return the correlation of a stack, its maps included."""
    correlator = Correlator(shape, _FRAME, device=device, memory_limit=2 * count * shape[0] * shape[1])
    frames = correlator.room[:count]
    fill_turn(frames)
    block = Block(frames, 0, phase=phases(count))

    def work() -> object:
        correlator.reset()
        push_block(correlator, block)
        return correlator.result()

    return Scaled(work, frames.nbytes + 16 * frames[0].size, count)


def scale_turn(device: Device, shape: Shape, count: int) -> Scaled:
    """Return the normals of turns of 8 frames, their maps included."""
    scale = SCALES[_FRAME.name]
    estimator = NormalEstimator(
        shape,
        _FRAME,
        tilt=TILT,
        gain=scale.gain,
        offset=scale.offset,
        noise=noise_of(_FRAME),
        device=device,
        memory_limit=2 * (count + 1) * shape[0] * shape[1],
    )
    frames = estimator.room[:count]
    fill_turn(frames)
    block = Block(frames, 0, phase=phases(count))

    def work() -> object:
        estimator.reset()
        push_block(estimator, block)
        return estimator.result()

    return Scaled(work, frames.nbytes + _NORMAL * frames[0].size, count)


def scale_surface(device: Device, shape: Shape) -> Scaled:
    """Return the heights of noisy slopes within a mask, from nothing each time."""
    dz_dx, dz_dy = noisy_slopes(shape)
    mask, integrator = make_mask(shape), Integrator(shape, PIXEL, device=device)

    def work() -> object:
        integrator.reset()
        integrator.push(dz_dx, dz_dy, mask=mask, tolerance=_TOLERANCE)
        return integrator.result()

    return Scaled(work, _SURFACE * mask.size)
