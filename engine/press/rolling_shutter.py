"""Correction for a rolling shutter, which exposes the rows of a picture one after the other."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.options import option
from mirrorskin.engine.steps import Context, Step
from mirrorskin.io import InputError, Recording, Result
from mirrorskin.kernels.array_types import Doubles


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
        own = getattr(source, "source", source)
        if isinstance(own, Recording):
            top, whole = own.origin[0], own.full_shape[1]
        late = line_time * (top + np.arange(rows) - (whole - 1) / 2)
        known = np.isfinite(result.height)
        when = np.interp(-result.height[known], travel, time)
        when += np.broadcast_to(late[:, np.newaxis], (rows, columns))[known]
        height = result.height.copy()
        height[known] = -_travel_at(when, time, travel)
        return result.assign(height=height, process={**result.process, "line_time": line_time})


def _travel_at(when: Doubles, time: Doubles, travel: Doubles) -> Doubles:
    """Return the travel at times; outside the frames, the speed is that of the nearest interval."""
    order = np.argsort(time)
    time, travel = time[order], travel[order]
    speeds = np.diff(travel) / np.diff(time)
    before, after = np.minimum(when - time[0], 0), np.maximum(when - time[-1], 0)
    return np.asarray(np.interp(when, time, travel) + speeds[0] * before + speeds[-1] * after)
