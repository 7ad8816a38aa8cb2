"""What a stop is: hold, and once the machine rests, reset."""

from __future__ import annotations

import math

HOLDING = 0.3
"""Seconds that a stop waits for rest before it resets."""

_RESETTING = 0.3  # seconds that a reset may take to be answered

LONGEST = HOLDING + _RESETTING
"""Seconds that a stop takes at most."""


class Stopping:
    """Where a stop has got to; it needs no lock, so that anyone can begin it at any moment.

    Attributes
    ----------
    over : bool
        Whether it is done.
    """

    def __init__(self) -> None:
        self.over = False
        self._began = math.inf
        self._reset = math.inf

    @property
    def begun(self) -> bool:
        """Whether the machine was told to hold."""
        return self._began < math.inf

    @property
    def resetting(self) -> bool:
        """Whether it was told to reset."""
        return self._reset < math.inf

    def begin(self, now: float) -> None:
        """Note that the machine was told to hold."""
        self._began = min(self._began, now)

    def reset(self, now: float, rested: float, gone: bool) -> bool:
        """Return whether to reset now: the machine rests, the line is gone, or the time is up.

        Parameters
        ----------
        now : float
            Seconds.
        rested : float
            When the newest report was asked for, if it tells of rest.
        gone : bool
            Whether there is nobody to wait for.
        """
        if self.resetting or not (gone or rested > self._began or now - self._began > HOLDING):
            return False
        self._reset = now
        return True

    def finish(self, now: float, answered: bool) -> None:
        """Note whether the reset was answered: then the stop is over, and after a while in any case."""
        self.over = self.over or answered or now - self._reset > _RESETTING
