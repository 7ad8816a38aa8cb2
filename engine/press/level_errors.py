"""What levels of dark and light that changed during a press do to its heights."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.method import Context, Step
from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.press.strokes import Strokes
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, with_findings
from mirrorskin.io.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.least_squares import mad_sigma

_PART = 0.1  # of the frames, at each end, in which levels are compared with the references
_AWAY = 0.3  # of the travel, least distance of these frames from the onset of a pixel
_FEWEST = 64  # pixels
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_CLEAR, _LEAST = 5.0, 0.01  # standard errors, and share of the rise to light, from which on a level differs
_COMMON = 2.0  # standard deviations of the pixels' own differences: a smaller one is not common to them


class LevelErrors(Step):
    """Add to the standard deviation of heights what levels do that differ from their references.

    The darkness of the first frames and the light of the last ones are compared with the references, at
    pixels that turn light much later or earlier. On a slope g, a level that is wrong by the share u of the
    rise to light moves the crossing by u g.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and a note, if levels differ."""
        operation = context.operation
        if not isinstance(operation, PressOperation) or isinstance(operation, Strokes):
            return result
        dark, bright, samples = operation.dark, operation.bright, operation.seen
        if samples is None or dark is None or bright is None:
            return result
        travel = context.pushed("travel")
        if samples.count != len(travel):
            return result
        errors = _find_errors(samples, travel, result.height, dark, bright)
        share = math.hypot(*errors) / math.sqrt(2)
        if not share:
            return result
        said = " and ".join(
            f"{name} by {100 * error:+.2g} %"
            for name, error in zip(("dark", "light"), errors, strict=True)
            if error
        )
        text = f"levels differ from their references, {said} of the rise; height_sigma includes this"
        moved = np.float32(share) * _rise(result.height)
        larger = np.hypot(result.height_sigma, np.where(np.isfinite(moved), moved, 0))
        return with_findings(result.assign(height_sigma=larger), Finding("levels", text, False))


def _find_errors(
    samples: FrameSamples, travel: Doubles, height: NDArray[Any], dark: ArrayLike, bright: ArrayLike
) -> tuple[float, float]:
    """Return by how much dark and light differ from the references, in shares of the rise; 0 if hardly."""
    onset = -samples.of_map(height).astype(np.float64)
    low, high = (
        samples.of_map(np.broadcast_to(np.asarray(level, np.float32), height.shape))
        for level in (dark, bright)
    )
    values = samples.values
    if travel[-1] < travel[0]:  # of a release
        values = values[::-1]
    few, least, most = max(1, round(_PART * len(travel))), float(travel.min()), float(travel.max())
    away = _AWAY * (most - least)
    found = []
    for frames, level, usable in (
        (values[:few], low, onset > least + away),
        (values[-few:], high, onset < most - away),
    ):
        error = ((frames.mean(axis=0) - level) / (high - low))[usable]
        error = error[np.isfinite(error)]
        if error.size < _FEWEST:
            return 0.0, 0.0
        middle = float(np.median(error))
        spread = mad_sigma(error - middle)
        clear = max(_LEAST, _COMMON * spread, _CLEAR * _OF_MEDIAN * spread / math.sqrt(error.size))
        found.append(middle if abs(middle) > clear else 0.0)
    return found[0], found[1]


def _rise(height: NDArray[Any]) -> NDArray[np.float32]:
    """Return by how much heights change over a pixel."""
    kernel = np.array([[-0.5, 0, 0.5]], np.float32)
    source = height.astype(np.float32)
    across, along = (
        cv2.filter2D(source, -1, one, borderType=cv2.BORDER_REPLICATE) for one in (kernel, kernel.T.copy())
    )
    return np.asarray(np.abs(across) + np.abs(along))
