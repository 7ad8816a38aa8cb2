"""Steps after any press: the correction for a rolling shutter, and why there is no height."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.base.summary import status_shares
from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.io import InputError, Recording, Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.kernels.array_types import Doubles


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


class RollingShutter(Step):
    """Correct the heights for the travel of the body when each row was exposed.

    The time and the travel of a frame belong to its middle row. With ``line_time`` l, row r of R is exposed
    (r - (R - 1) / 2) l later; in between, the body moves as from frame to frame.
    """

    needs = ("height",)

    line_time: float | None = option(
        default=None,
        unit="s",
        help="time from the exposure of a row to that of the next one, of a rolling shutter; negative if the"
        " last row is the first",
        shown_default="that of the recording, or 0",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights at the travel of their rows, if the shutter is a rolling one."""
        source = context.source
        line_time = source.header.line_time if self.line_time is None else self.line_time
        if not line_time:
            return result
        if context.time is None:
            raise InputError("a rolling shutter needs the time of each frame: record it, or give time")
        travel, kept = np.unique(context.positions("travel"), return_index=True)
        if len(travel) < 2:  # the body rests
            return result
        time = context.time[kept]
        rows, columns = result.height.shape
        top, whole = 0, rows
        recording = getattr(source, "source", source)
        if isinstance(recording, Recording):
            top, whole = recording.origin[0], recording.full_shape[1]
        late = line_time * (top + np.arange(rows) - (whole - 1) / 2)
        finite = np.isfinite(result.height)
        when = np.interp(-result.height[finite], travel, time)
        when += np.broadcast_to(late[:, np.newaxis], (rows, columns))[finite]
        height = result.height.copy()
        height[finite] = -_travel_at(when, time, travel)
        return result.assign(height=height, process={**result.process, "line_time": line_time})


def _travel_at(when: Doubles, time: Doubles, travel: Doubles) -> Doubles:
    """Return the travel at times; outside the frames, the speed is that of the nearest interval."""
    order = np.argsort(time)
    time, travel = time[order], travel[order]
    speeds = np.diff(travel) / np.diff(time)
    before, after = np.minimum(when - time[0], 0), np.maximum(when - time[-1], 0)
    return np.asarray(np.interp(when, time, travel) + speeds[0] * before + speeds[-1] * after)
