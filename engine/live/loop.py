"""The live loop, which pushes frames of a camera into a run with bounded latency."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.running import part_of
from mirrorskin.engine.live.run import LiveRun
from mirrorskin.engine.live.status import PUSHED, RAISED, SHOWN, UPDATED, WAITED, Monitor, Status, Update
from mirrorskin.engine.live.tracking import Events, Limit, Tracker, Trackers
from mirrorskin.io import Block, InputError, LiveSource
from mirrorskin.io.base.threads import computes
from mirrorskin.io.storage.layout import POSITIONS

LATENCY = 0.1
"""Seconds after which a frame is too old, by default."""

OnUpdate = Callable[[Update, Status], None]
Mark = Callable[[int, NDArray[np.bool_]], None]

_INTERVALS = 32  # number of frames from which the frame rate is estimated
_PICTURES = 8  # number of arrays that are kept for the pictures of updates
_PATIENCE = 0.01  # seconds: least time that an update waits for slow maps
_IDLE_MARGIN = 0.001  # seconds before the next expected frame in which no work is started


class _Pictures:
    """Copies of frames, in arrays that are used again as soon as nothing else refers to them.

    A view of an array refers to it, so an array is not changed while any part of it is in use.
    """

    def __init__(self) -> None:
        self._arrays: deque[NDArray[Any]] = deque(maxlen=_PICTURES)

    def copy(self, picture: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of a frame."""
        for number in range(len(self._arrays)):
            if _references(self._arrays, number) == _ALONE:
                copied = self._arrays[number]
                break
        else:
            copied = np.empty(picture.shape, picture.dtype)
            self._arrays.append(copied)
        np.copyto(copied, picture)
        return copied


def _references(objects: Sequence[object], number: int) -> int:
    """Return the number of references to an object of a sequence, with those that counting needs."""
    return sys.getrefcount(objects[number])


_ALONE = _references([object()], 0)  # without any other reference


class _Begun(NamedTuple):
    """An update without answers of trackers, when it was begun, and when its newest frame was exposed."""

    update: Update
    started: float
    taken: float


class _Following:
    """The next update, which may be begun before the one before it is handed out; an error waits for that."""

    def __init__(self, updates: Iterator[_Begun]) -> None:
        self._updates = updates
        self._begun: _Begun | None = None
        self._error: Exception | None = None
        self._is_begun = False

    def begin(self) -> Update | None:
        """Begin it, and return it; None if no frame waits."""
        self._is_begun = True
        try:
            self._begun = next(self._updates, None)
        except Exception as error:
            self._error = error
        return None if self._begun is None else self._begun.update

    def take(self) -> _Begun | None:
        """Return it, or raise the error of its frame; None if no frame waits."""
        if self._error is not None:
            raise self._error
        return self._begun if self._is_begun else next(self._updates, None)


class Loop:
    """Push the frames of a live source into a run; the status is available after an exception, too.

    *Policy.* All waiting frames are taken at once. Frames that are older than ``latency`` are skipped, except
    for the newest one: with a latency of 0 only the newest frame is used, with an infinite one all are.
    Frames that the source has lost are counted as dropped. An update follows each push, at most ``updates``
    per second. Low-priority work is done until the next frame is expected. So no queue grows, and each frame
    is counted as pushed, skipped or dropped.

    *Trackers* give an answer for each update. With trackers, frames that waited together are pushed one by
    one, so that each used frame has an update. If the next one waits when the first tracker that works on a
    device has answered, its maps are computed, and trackers that have answered start their work for it. What
    a tracker refuses, such as a frame without contact, is stated in ``Update.lost``, and the loop continues.

    Parameters
    ----------
    source : LiveSource
    run : LiveRun
        Call ``run.precompile()`` first.
    latency : float
        Seconds, from 0; see *Policy*.
    updates : float, optional
        Updates per second at most; by default as many as the operation states, and with trackers one per
        frame.
    trackers : mapping of str to trackers or callables, optional
        A `PoseTracker` or a `ForceTracker`, which gets the maps of each update and the body's travel, a
        `SlipTracker`, which gets its frame and a map of contact, a `TurnTracker`, which gets its frame and
        phase, or a function of the `Update`, which has the answers of the trackers before it. Answers are in
        ``Update.tracked``. The mapping may be changed while the loop runs, as for a new tracker of a new
        contact.
    events : mapping of str to Limit, optional
        Conditions on updates; what starts or ends is in ``Update.events``.
    on_update : callable, optional
        Called with each update and the status; the loop waits for it.
    stop : callable, optional
        Called after each push; the loop ends when it returns True.
    mark : callable, optional
        Called with the number of the first frame of a block and a mask of the used ones, such as
        ``StreamRecorder.mark``.
    guard : callable, optional
        Returns a context in which frames are pushed and marked, to protect this from interrupts.

    Raises
    ------
    mirrorskin.io.InputError
        A latency below 0, or a rate that is not above 0; an object that is not a tracker or a limit.
    """

    def __init__(
        self,
        source: LiveSource,
        run: LiveRun,
        *,
        latency: float = LATENCY,
        updates: float | None = None,
        trackers: Mapping[str, Tracker] | None = None,
        events: Mapping[str, Limit] | None = None,
        on_update: OnUpdate | None = None,
        stop: Callable[[], bool] | None = None,
        mark: Mark | None = None,
        guard: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> None:
        usual = math.inf if trackers is not None else run.operation.updates_per_second
        rate_limit = usual if updates is None else updates
        if not latency >= 0:
            raise InputError(f"latency {latency}: a number of seconds of at least 0 is needed")
        if not rate_limit > 0:
            raise InputError(f"updates {rate_limit}: a number above 0 is needed")
        self._source, self._run = source, run
        self._trackers = None if trackers is None else Trackers(trackers, source.motion)
        self._events = Events(events or {})
        self._latency, self._period = latency, 1 / rate_limit
        self._on_update, self._stop, self._mark, self._guard = on_update, stop, mark, guard
        self._monitor, self._pictures = Monitor(), _Pictures()
        self._taken = self._updated = -math.inf  # time of the newest frame that was pushed, of an update
        self._newest: tuple[float, float, NDArray[Any]] | None = None  # its exposure, position and picture
        self._pending = self._ends = False
        self._times: deque[float] = deque(maxlen=_INTERVALS)
        self._arrived: deque[float] = deque(maxlen=_INTERVALS)  # times of the newest frames of updates

    @property
    def status(self) -> Status:
        """Counts and times so far."""
        return self._monitor.status(fresh=True)

    def precompile(self) -> None:
        """Compile and run all kernels of the run and of the trackers, before the first frame."""
        self._run.precompile()
        if self._trackers is not None:
            self._trackers.precompile(self._source.shape[1:], self._source.dtype)

    def run(self) -> Status:
        """Push until the source ends, or ``stop`` returns True."""
        while not self._ends and (block := self._source.read(self._run.staging_buffer)) is not None:
            updates = self._updates_of(block)
            begun = next(updates, None)
            while begun is not None:
                begun = self._complete(begun, updates)
            if not self._ends:
                self._run.idle_work(self._idle())
        if (begun := self._begin()) is not None:  # frames were pushed since the last update
            self._complete(begun, iter(()))
        return self.status

    def _updates_of(self, block: Block) -> Iterator[_Begun]:
        """Push the frames of a block, and yield the updates that are due, until ``stop`` returns True."""
        used = self._monitor.used
        for part in self._parts(block):
            newest = part.index + len(part.frames) == block.index + len(block.frames)
            self._take(part, newest and self._monitor.used == used)
            self._ends = self._stop is not None and self._stop()
            if self._ends:
                return
            if self._source.now() - self._updated >= self._period and (begun := self._begin()) is not None:
                yield begun

    def _parts(self, block: Block) -> Iterator[Block]:
        """Yield what is pushed together: all frames of a block, or one by one for trackers."""
        if self._trackers is None or len(block.frames) == 1:
            yield block
            return
        for number in range(len(block.frames)):
            part = part_of(block, slice(number, number + 1))
            yield part if number == 0 else replace(part, dropped=0)  # lost frames are counted once

    @computes
    def _take(self, block: Block, newest: bool) -> None:
        """Push the frames of a block, except for those that are too old, and mark them.

        The last one is used at any age if it is the newest of those that waited together.
        """
        now, count = self._source.now(), len(block.frames)
        times = [now] * count if block.time is None else block.time.tolist()
        used = [
            (now - time <= self._latency or (newest and number == count - 1))
            and (block.index + number) % self._run.every == 0
            for number, time in enumerate(times)
        ]
        self._monitor.time(WAITED, *(now - time for time in times))
        self._times.extend(times)
        with self._guard():
            self._monitor.took(now, count, sum(used), block.dropped)
            edges = [n for n in range(count + 1) if (n > 0 and used[n - 1]) != (n < count and used[n])]
            for start, stop in zip(edges[::2], edges[1::2], strict=True):  # contiguous frames
                part = block if start == edges[0] else replace(block, dropped=0)  # losses are counted once
                self._run.push_block(part, slice(None) if stop - start == count else slice(start, stop))
            if self._mark is not None:
                self._mark(block.index, np.array(used))
        if edges:
            last = edges[-1] - 1
            at = math.nan if block.time is None else times[last] - block.lateness
            places = getattr(block, self._run.position)  # a tilt, if the source has those of frames
            places = getattr(block, POSITIONS[self._source.motion]) if places is None else places
            place: Any = math.nan if places is None else places[last]
            self._newest = at, float(np.hypot(*place) if np.ndim(place) else place), block.frames[last]
            self._taken, self._pending = times[last], True
            self._monitor.time(PUSHED, self._source.now() - now)

    @computes
    def _begin(self) -> _Begun | None:
        """Return the update with the maps of the frames so far, if there are new ones."""
        if not self._pending or self._newest is None:
            return None
        started = self._source.now()
        (at, position, picture), frames = self._newest, self._monitor.used
        maps, motion = self._run.maps(max(_PATIENCE, self._idle())), self._source.motion
        update = Update(frames, at, motion, position, self._pictures.copy(picture), maps, tracked={}, lost={})
        self._updated, self._pending = started, False
        return _Begun(update, started, self._taken)

    @computes
    def _complete(self, begun: _Begun, updates: Iterator[_Begun]) -> _Begun | None:
        """Let trackers answer, hand out an update, and return the next one of those that wait."""
        (update, started, taken), following = begun, _Following(updates)
        if self._trackers is not None:
            self._trackers.track(update, self._source.header.press, following.begin)
        finished = self._source.now()
        self._monitor.updated()
        self._monitor.time(UPDATED, finished - started)
        self._arrived.append(taken)
        if update.tracked or update.first is not None:
            self._monitor.time(SHOWN, finished - taken)
        if update.height is not None:
            lag = min(update.height_lag, len(self._arrived) - 1)
            self._monitor.time(RAISED, finished - self._arrived[-1 - lag])
        status = self._monitor.status()
        events = self._events.of(update)
        p99 = status.latency[SHOWN].p99 + taken - update.time  # from the exposure
        update = replace(update, latency=finished - update.time, latency_p99=p99, events=events)
        if self._on_update is not None:
            self._on_update(update, status)
        return following.take()

    def _idle(self) -> float:
        """Return the seconds until the next frame is expected, less a margin."""
        if len(self._times) < 2:
            return 0.0
        interval = (self._times[-1] - self._times[0]) / (len(self._times) - 1)
        return self._times[-1] + interval - _IDLE_MARGIN - self._source.now()
