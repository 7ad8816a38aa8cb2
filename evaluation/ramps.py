"""Noisy ramps with a true half-way crossing, and the errors of its estimates.

``python evaluation/ramps.py`` prints, for each noise, the error of the best fixed threshold and of the
change-point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine import ChangePoint, Onset
from mirrorskin.evaluation.base.sources import run_unchecked
from mirrorskin.evaluation.base.tables import Table
from mirrorskin.io import Result

Doubles = NDArray[np.float64]

FRAMES = 64
WIDTHS = (0, 0.5, 1, 1.5, 2, 2.5, 3, 4, 5.5, 8, 11, 16)  # frames from dark to light
NOISES = (1, 2, 3, 5, 8, 12, 16, 20)
THRESHOLDS = np.arange(4, 17) / 20
HOLDS = (1, 2, 3)  # longer ones were never the best, not even for one width of a ramp


def ramps(
    noise: float,
    pixels: int,
    seed: int,
    dark: float = 20,
    bright: float = 220,
    widths: Sequence[float] = WIDTHS,
) -> tuple[NDArray[np.uint8], Doubles]:
    """Return frames, (T, widths, pixels), and the frame at which each is half-way, (widths, pixels)."""
    generator = np.random.default_rng([seed, int(10 * noise)])
    middle = generator.uniform(FRAMES / 2 - 12, FRAMES / 2 + 12, (len(widths), pixels))
    length = np.maximum(widths, 1e-9)[:, np.newaxis]
    number = np.arange(FRAMES)[:, np.newaxis, np.newaxis]
    light = np.clip((number - middle) / length + 0.5, 0, 1)
    counts = dark + (bright - dark) * light + generator.normal(0, noise, (FRAMES, *middle.shape))
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8), middle


def rms(values: Doubles, axis: int | None = None) -> Any:
    """Return the root mean square."""
    return np.sqrt(np.mean(values**2, axis=axis))


def compare(
    noise: float, pixels: int = 1000, seed: int = 1, dark: float = 20, bright: float = 220, device: Any = None
) -> tuple[Doubles, Doubles, Doubles]:
    """Return the errors, (widths, pixels), of the best threshold, its bias removed, and of the change-point.

    The best threshold is the one whose error over all pixels is the least, of all thresholds and holds; the
    best for each width alone, which nobody could choose beforehand, comes third, as RMS errors, (widths,).
    """
    frames, middle = ramps(noise, pixels, seed, dark, bright)
    options: dict[str, Any] = {
        "dark": dark,
        "bright": bright,
        "noise": float(np.hypot(noise, 1 / np.sqrt(12))),
    }
    thresholds = [
        _errors(Onset(threshold=float(threshold), hold=hold, device=device, **options), frames, middle)
        for threshold in THRESHOLDS
        for hold in HOLDS
    ]
    best = min((error - error.mean() for error in thresholds), key=rms)
    each = np.min([rms(error - error.mean(axis=1, keepdims=True), axis=1) for error in thresholds], axis=0)
    return best, _errors(ChangePoint(device=device, **options), frames, middle), each


def errors(result: Result, middle: Doubles) -> Doubles:
    """Return the errors in frames, for travel of 1 a frame; no answer is off by half the stack."""
    return np.where(result.status == 1, -np.nan_to_num(result.height) - middle, FRAMES / 2)


def _errors(operation: Any, frames: NDArray[np.uint8], middle: Doubles) -> Doubles:
    return errors(run_unchecked(operation, frames, travel=np.arange(float(FRAMES))), middle)


def measure() -> Table:
    """Return the errors by noise; the last column has the ratio of each width of a ramp."""
    rows = []
    for noise in NOISES:
        best, change, each = compare(noise, pixels=4000)
        cells = [f"{rms(error):.3f} ({np.median(np.abs(error)):.3f})" for error in (best, change)]
        ratios = rms(change, axis=1) / each
        rows.append((f"{noise}", *cells, f"{ratios.min():.2f}-{ratios.max():.2f}"))
    head = ("noise, counts", "best threshold", "change-point", "over the best threshold of each width")
    return Table("Errors on ramps, in frames: RMS (median of the magnitude)", head, rows)


if __name__ == "__main__":
    print(measure())
