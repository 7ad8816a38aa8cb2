"""Which frames of an endless rotation make a turn."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.phases import Doubles

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
    way = np.unwrap(phase)
    starts = [0] if len(way) else []
    for frame, angle in enumerate(way):
        if abs(angle - way[starts[-1]]) >= _WHOLE:
            starts.append(frame)
    return [slice(start, stop) for start, stop in zip(starts, [*starts[1:], len(way)], strict=True)]


def longest_turn(phase: Doubles) -> int:
    """Return the number of frames of the longest turn."""
    return max((turn.stop - turn.start for turn in cut_into_turns(phase)), default=0)
