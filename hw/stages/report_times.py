"""When to query a report, the time of a report, and the detection of silence."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

SLICE = 0.02
"""Maximum time of a read, seconds: the resolution at which silence is measured."""

_DELAYED = 2 * SLICE  # own delay, seconds, after which a silence may be due to a busy computer
_PART = 0.5  # share of a slice that counts as silence after such a delay
_REAL_SILENCE = 0.4  # seconds after which a silence is real, however busy the computer is
_MEDIAN_OF = 15  # number of round trips of which the median is the usual one
_TIMES, _LATE = 3.0, 0.004  # factor and seconds by which a trusted round trip may exceed the usual one
_REPEAT_AFTER = 0.04  # seconds, and at least two usual round trips, after which a query is repeated
_FIRST = 0.2  # the same before the first answer
# the repeat interval after an ambiguous answer, in times of that answer, until an answer is trusted
_WIDER = 2.0


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer: the time of its query, the time at which it was valid, and whether these are reliable."""

    asked: float
    time: float
    sure: bool


class ReportTimes:
    """Records the times of queries and answers.

    A query that stays open is repeated. It is then unknown to which query an answer belongs, until an
    interval without answers has passed; the next repetition also waits longer.
    """

    def __init__(self, period: float) -> None:
        self.period = period  # interval of queries, seconds; may be changed at any time
        self._quiet = -math.inf  # start of the interval without queries and ambiguous answers
        self._wider = 0.0
        self._resume = 0.0  # time after which no answers to earlier queries are expected
        self._open: list[float] = []
        self._out = 0.0  # time at which the first open query was sent
        self._unsure = False
        self._silence = 0.0
        self._trips: deque[float] = deque(maxlen=_MEDIAN_OF)

    @property
    def usual(self) -> float:
        """Usual round trip, seconds; NaN before the first."""
        return statistics.median(self._trips) if self._trips else math.nan

    @property
    def longest(self) -> float:
        """Longest recent round trip, seconds; NaN before the first."""
        return max(self._trips, default=math.nan)

    def listened(self, began: float, now: float) -> None:
        """Record a read of at most `SLICE` seconds; call this before its answers are added."""
        if self._open:
            delayed = now - began > _DELAYED
            self._silence += _PART * SLICE if delayed else max(0.0, now - max(began, self._out))

    def silence(self, now: float) -> float:
        """Return how long a query has been open while somebody was reading."""
        if self._open and now - self._out > _REAL_SILENCE:
            return now - self._out
        return self._silence

    def due(self, now: float) -> bool:
        """Return whether to send a query now."""
        if not self._open:
            return now - self._quiet >= self.period and now >= self._resume
        wait = max(_REPEAT_AFTER, 2 * self.usual) if self._trips else _FIRST
        return now - self._open[-1] >= max(wait, self._wider)

    def ask(self, now: float) -> None:
        """Record that a query is about to be sent."""
        self._unsure = bool(self._open)
        self._open.append(now)
        self._quiet = now
        if not self._unsure:
            self._out = now

    def sent(self, now: float) -> None:
        """Record that it was sent, which may be late on a busy computer; before that there was no silence."""
        if not self._unsure:
            self._out, self._silence = now, 0.0

    def answer(self, now: float) -> Answer:
        """Record an answer; it was valid in the middle between query and answer.

        It is unreliable if no query or several queries were open, or if it was late.
        """
        asked, self._open = self._open, []
        self._silence = 0.0
        if self._unsure or not asked:
            self._quiet = now
            if asked:
                # homing answers nothing for a long time
                self._wider = min(_WIDER * (now - asked[0]), _REAL_SILENCE)
                self._resume = asked[-1] + self._wider
            return Answer(-math.inf, now, False)
        trip = now - asked[0]
        late = bool(self._trips) and trip > _LATE + _TIMES * self.usual
        self._trips.append(trip)
        self._wider = self._wider if late else 0.0
        return Answer(asked[0], now - trip / 2, not late)
