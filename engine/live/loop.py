"""The live loop, which pushes frames of a camera into a run with bounded latency."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.run import LiveRun
from mirrorskin.engine.live.status import PUSHED, RAISED, SHOWN, UPDATED, WAITED, Monitor, Status, Update
from mirrorskin.io import Block, InputError, LiveSource
from mirrorskin.io.storage.layout import POSITIONS

LATENCY = 0.1
"""Seconds after which a frame is too old, by default."""

OnUpdate = Callable[[Update, Status], None]
Mark = Callable[[int, NDArray[np.bool_]], None]

_INTERVALS = 32  # number of frames from which the frame rate is estimated
_PATIENCE = 0.01  # seconds: least time that an update waits for slow maps
_IDLE_MARGIN = 0.001  # seconds before the next expected frame in which no work is started


class Loop:
    """Push the frames of a live source into a run; the status is available after an exception, too.

    *Policy.* All waiting frames are taken at once. Frames that are older than ``latency`` are skipped, except
    for the newest one; frames that the source has lost are counted as dropped. An update follows each push,
    at most ``updates`` per second. Low-priority work is done until the next frame is expected. So no queue
    grows, and each frame is counted as pushed, skipped or dropped.

    Parameters
    ----------
    source : LiveSource
    run : LiveRun
        Call ``run.precompile()`` first.
    latency : float
        Seconds.
    updates : float, optional
        Updates per second at most; by default as many as the operation states.
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
        A latency or rate that is not above 0.
    """

    def __init__(
        self,
        source: LiveSource,
        run: LiveRun,
        *,
        latency: float = LATENCY,
        updates: float | None = None,
        on_update: OnUpdate | None = None,
        stop: Callable[[], bool] | None = None,
        mark: Mark | None = None,
        guard: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> None:
        rate_limit = run.operation.updates_per_second if updates is None else updates
        for name, number in (("latency", latency), ("updates", rate_limit)):
            if not number > 0:
                raise InputError(f"{name} {number}: a number above 0 is needed")
        self._source, self._run = source, run
        self._latency, self._period = latency, 1 / rate_limit
        self._on_update, self._stop, self._mark, self._guard = on_update, stop, mark, guard
        self._monitor = Monitor()
        self._taken = self._updated = -math.inf  # time of the newest frame that was pushed, of an update
        self._newest: tuple[float, float, NDArray[Any]] | None = None  # its time, position and picture
        self._pending = False
        self._times: deque[float] = deque(maxlen=_INTERVALS)
        self._arrived: deque[float] = deque(maxlen=_INTERVALS)  # times of the newest frames of updates

    @property
    def status(self) -> Status:
        """Counts and times so far."""
        return self._monitor.status(fresh=True)

    def run(self) -> Status:
        """Push until the source ends, or ``stop`` returns True."""
        while (block := self._source.read(self._run.staging_buffer)) is not None:
            self._take(block)
            if self._stop is not None and self._stop():
                break
            if self._source.now() - self._updated >= self._period:
                self._update()
            self._run.idle_work(self._idle())
        if self._pending:
            self._update()
        return self.status

    def _take(self, block: Block) -> None:
        """Push the frames of a block, except for those that are skipped, and mark them."""
        now, count = self._source.now(), len(block.frames)
        time = np.full(count, now) if block.time is None else block.time
        used = (now - time <= self._latency) | (np.arange(count) == count - 1)
        used &= (block.index + np.arange(count)) % self._run.every == 0
        self._monitor.time(WAITED, *(now - time).tolist())
        self._times.extend(time.tolist())
        with self._guard():
            self._monitor.took(now, count, int(np.count_nonzero(used)), block.dropped)
            edges = np.flatnonzero(np.diff(used, prepend=False, append=False))
            part = block
            for start, stop in edges.reshape(-1, 2).tolist():  # contiguous frames
                self._run.push_block(part, slice(start, stop))
                part = replace(block, dropped=0)  # lost frames are counted once
            if self._mark is not None:
                self._mark(block.index, used)
        if used.any():
            last = int(np.flatnonzero(used)[-1])
            at = math.nan if block.time is None else float(block.time[last])
            places = getattr(block, self._run.position)  # a tilt, if the source has those of frames
            place = (getattr(block, POSITIONS[self._source.motion]) if places is None else places)[last]
            self._newest = at, float(np.hypot(*place) if np.ndim(place) else place), block.frames[last]
            self._taken, self._pending = float(time[last]), True
            self._monitor.time(PUSHED, self._source.now() - now)

    def _update(self) -> None:
        if not self._pending or self._newest is None:
            return
        started = self._source.now()
        (at, position, picture), frames = self._newest, self._monitor.used
        maps = self._run.maps(max(_PATIENCE, self._idle()))
        finished = self._source.now()
        motion = self._source.motion
        update = Update(frames, at, motion, position, picture.copy(), maps, finished - at)
        self._updated, self._pending = started, False
        self._monitor.updated()
        self._monitor.time(UPDATED, finished - started)
        self._arrived.append(self._taken)
        if update.first is not None:
            self._monitor.time(SHOWN, finished - self._taken)
        if update.height is not None:
            lag = min(update.height_lag, len(self._arrived) - 1)
            self._monitor.time(RAISED, finished - self._arrived[-1 - lag])
        if self._on_update is not None:
            self._on_update(update, self._monitor.status())

    def _idle(self) -> float:
        """Return the seconds until the next frame is expected, less a margin."""
        if len(self._times) < 2:
            return 0.0
        interval = (self._times[-1] - self._times[0]) / (len(self._times) - 1)
        return self._times[-1] + interval - _IDLE_MARGIN - self._source.now()
