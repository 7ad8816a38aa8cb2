"""Why a press has no height at any pixel."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.summary import status_shares
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, with_findings


def with_reason(
    result: Result, operation: PressOperation, threshold: float, frames: Iterable[NDArray[Any]]
) -> Result:
    """Return a result; if it has no height at any pixel, the warnings of its process state why.

    Parameters
    ----------
    result : Result
        Heights and status of a press.
    operation : PressOperation
        What computed it, for its levels.
    threshold : float
        Share of the range from dark to bright.
    frames : iterable of ndarray, (H, W)
        Some of the frames; they are only read if there is no height.
    """
    if np.isfinite(result.height).any():
        return result
    parts = [frame[np.isfinite(frame)] for frame in frames]
    counts = np.concatenate(parts) if parts else np.empty(0)
    reason = _reason(result, operation, threshold, counts)
    return with_findings(result, Finding("no height", reason))


def _reason(result: Result, operation: PressOperation, threshold: float, counts: NDArray[Any]) -> str:
    text = f"no height at any pixel ({status_shares(result)})"
    dtype = np.dtype(operation.dtype)
    top = float(np.iinfo(dtype).max) if dtype.kind == "u" else None
    levels = _middle(operation.dark, 0.0), _middle(operation.bright, top)
    if levels[0] is None or levels[1] is None or not counts.size:
        return text
    low, high = float(counts.min()), float(counts.max())
    light = levels[0] + threshold * (levels[1] - levels[0])
    if low <= light <= high:
        return text
    where, question = ("below", "was there light") if high < light else ("above", "was it dark at first")
    return (
        f"{text}: samples are {low:.4g} to {high:.4g}, {where} the threshold of {light:.4g} between dark "
        f"{levels[0]:.4g} and bright {levels[1]:.4g}: are these counts of the frames, and {question}?"
    )


def _middle(level: ArrayLike | None, default: float | None) -> float | None:
    if level is None:
        return default
    values = np.asarray(level, np.float64)
    return float(np.nanmedian(values)) if np.isfinite(values).any() else None
