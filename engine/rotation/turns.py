"""Which frames of an endless rotation make a turn."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.rotation.phases import Doubles

LONGEST = 64
"""Frames of one turn that are taken at most."""

_WHOLE = 2 * np.pi - 1e-6  # a turn, but for the rounding of phases


def cut_into_turns(phase: Doubles) -> list[slice]:
    """Return the turns that are over, and the one that may go on.

    A turn is over with the first frame that is a whole turn away from its own first. Phases that fall back
    by more than half a turn are taken for going on, as those that are told modulo a turn.

    Parameters
    ----------
    phase : ndarray, (N,), float64
        Radians.

    Returns
    -------
    list of slice
        They meet, and the last one holds the last frame; none without frames.
    """
    if len(phase) == 0:
        return []
    steps = np.diff(phase)
    forward = 1.0 if (np.median(steps) if len(steps) else 0.0) >= 0 else -1.0
    steps = np.where(forward * steps < -np.pi, steps + forward * 2 * np.pi, steps)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    starts = [0]
    for frame, angle in enumerate(way):
        if abs(angle - way[starts[-1]]) >= _WHOLE:
            starts.append(frame)
    return [slice(start, stop) for start, stop in zip(starts, [*starts[1:], len(way)], strict=True)]


def goes_round(phase: Doubles) -> bool:
    """Tell whether no gap between phases is above half a turn."""
    points = np.sort(np.mod(phase, 2 * np.pi))
    return bool(np.max(np.diff(points, append=points[0] + 2 * np.pi)) <= np.pi + 1e-6)


def longest_turn(phase: Doubles) -> int:
    """Return the number of frames of the longest turn."""
    return max((turn.stop - turn.start for turn in cut_into_turns(phase)), default=0)
