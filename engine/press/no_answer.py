"""Why a press has no height at any pixel."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.steps import Context, Step
from mirrorskin.engine.summary import status_shares
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, with_findings


class NoAnswer(Step):
    """Add the reason to the warnings of a result without any height."""

    needs = ("height", "status")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result; its process says why there is no height at any pixel."""
        on_grid = () if context.samples is None else context.neighbours(result)
        if np.isfinite(on_grid).any() or np.isfinite(result.height).any():
            return result
        return with_findings(result, Finding("no height", _reason(result, context)))


def _reason(result: Result, context: Context) -> str:
    operation = cast("PressOperation", context.operation)
    text = f"no height at any pixel ({status_shares(result)})"
    dtype = np.dtype(operation.dtype)
    top = float(np.iinfo(dtype).max) if dtype.kind == "u" else None
    levels = _middle(operation.dark, 0.0), _middle(operation.bright, top)
    counts = np.empty(0) if context.samples is None else context.samples.values
    counts = counts[np.isfinite(counts)]
    if levels[0] is None or levels[1] is None or not counts.size:
        return text
    low, high = float(counts.min()), float(counts.max())
    light = levels[0] + operation.lowest_threshold * (levels[1] - levels[0])
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
