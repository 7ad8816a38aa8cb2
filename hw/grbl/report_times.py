"""When to ask for a report, what time an answer is of, and when there was none for too long."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

SLICE = 0.02
"""Longest time that a read waits, seconds: how finely a silence is measured."""

_DELAYED = 2 * SLICE  # of our own sleep: a busy computer may hush others, too
_PART = 0.5  # of a slice that such a sleep counts as silence
_SURELY = 0.4  # seconds after which nobody is that busy
_MEDIAN_OF = 15  # round trips that the usual one is the median of
_TIMES, _LATE = 3.0, 0.004  # of the usual, and seconds more, that a round trip may take to be trusted
_AGAIN = 0.04  # seconds, and at least two usual round trips, after which a question is asked again
_FIRST = 0.2  # the same before any was answered
_WIDER = 2.0  # times what an answer took that several questions were open for: the same until one is trusted


@dataclass(frozen=True, slots=True)
class Answer:
    """When an answer was asked for, when it was so, and whether that can be trusted."""

    asked: float
    time: float
    sure: bool


class ReportTimes:
    """Keeps the times of questions and answers.

    A question that stays open is asked again. From then on nobody knows which one an answer is meant for,
    until a period has passed without any; and it is waited longer before the next is asked again.
    """

    def __init__(self, period: float) -> None:
        self.period = period  # seconds from one question to the next; may be changed at any time
        self._quiet = -math.inf  # since when nothing was asked, nor answered that cannot be trusted
        self._wider = 0.0
        self._resume = 0.0  # when no answers to earlier questions are to be expected any more
        self._open: list[float] = []
        self._out = 0.0  # when the first of the open questions was on its way
        self._unsure = False
        self._silence = 0.0
        self._trips: deque[float] = deque(maxlen=_MEDIAN_OF)

    @property
    def usual(self) -> float:
        """Seconds of the usual round trip; NaN before the first."""
        return statistics.median(self._trips) if self._trips else math.nan

    @property
    def longest(self) -> float:
        """Seconds of the longest of the latest round trips; NaN before the first."""
        return max(self._trips, default=math.nan)

    def listened(self, began: float, now: float) -> None:
        """Note that somebody listened for `SLICE` seconds at most; an answer is noted afterwards."""
        if self._open:
            delayed = now - began > _DELAYED
            self._silence += _PART * SLICE if delayed else max(0.0, now - max(began, self._out))

    def silence(self, now: float) -> float:
        """Return for how long a question has been open, as far as somebody listened for an answer."""
        if self._open and now - self._out > _SURELY:
            return now - self._out
        return self._silence

    def due(self, now: float) -> bool:
        """Return whether to ask now."""
        if not self._open:
            return now - self._quiet >= self.period and now >= self._resume
        wait = max(_AGAIN, 2 * self.usual) if self._trips else _FIRST
        return now - self._open[-1] >= max(wait, self._wider)

    def ask(self, now: float) -> None:
        """Note that the question is about to be sent."""
        self._unsure = bool(self._open)
        self._open.append(now)
        self._quiet = now
        if not self._unsure:
            self._out = now

    def sent(self, now: float) -> None:
        """Note that it was sent, which a busy computer may do late: there was no silence before."""
        if not self._unsure:
            self._out, self._silence = now, 0.0

    def answer(self, now: float) -> Answer:
        """Note that an answer came: it was so in the middle between question and answer.

        It cannot be trusted if no question was open or several were, which makes it as if asked for never,
        or if it came late.
        """
        asked, self._open = self._open, []
        self._silence = 0.0
        if self._unsure or not asked:
            self._quiet = now
            if asked:
                self._wider = min(_WIDER * (now - asked[0]), _SURELY)  # homing answers nothing for long
                self._resume = asked[-1] + self._wider
            return Answer(-math.inf, now, False)
        trip = now - asked[0]
        late = bool(self._trips) and trip > _LATE + _TIMES * self.usual
        self._trips.append(trip)
        self._wider = self._wider if late else 0.0
        return Answer(asked[0], now - trip / 2, not late)
