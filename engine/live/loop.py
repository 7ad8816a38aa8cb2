"""The live loop: from a source that does not wait into an estimator, within a bounded time."""

from __future__ import annotations

import gc
import math
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.estimator import LiveEstimator
from mirrorskin.engine.live.types import PUSHED, SHOWN, UPDATED, WAITED, Status, Update
from mirrorskin.engine.live.watch import Watch
from mirrorskin.io import Block, InputError, LiveSource

LATENCY = 0.1
"""Seconds after which a frame is too old, where nothing else is said."""

OnUpdate = Callable[[Update, Status], None]
Mark = Callable[[int, NDArray[np.bool_]], None]

_INTERVALS = 32  # between frames, that tell when the next one is due
_ENDING = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
_MARGIN = 0.001  # seconds before that, in which nothing is begun any more


def run(
    source: LiveSource,
    estimator: LiveEstimator,
    *,
    latency: float = LATENCY,
    updates: float | None = None,
    on_update: OnUpdate | None = None,
    stop: Callable[[], bool] | None = None,
    mark: Mark | None = None,
) -> Status:
    """Push the frames of a live source into an estimator until it ends.

    *Policy.* All frames that wait are taken at once. Those that are older than ``latency`` then are skipped,
    but the newest of them never; what the source lost before is told as dropped. After each push there is an
    update, at most ``updates`` a second of them; time that is left until the next frame is due goes into
    what can wait. So nothing queues up, and each frame is pushed once, skipped or dropped, and counted.

    Parameters
    ----------
    source : LiveSource
    estimator : LiveEstimator
        Best warm; see there.
    latency : float
        Seconds.
    updates : float, optional
        A second, at most; by default what is of use to the estimator.
    on_update : callable, optional
        Is given each update and the status; the loop waits for it.
    stop : callable, optional
        Asked after each push whether to end.
    mark : callable, optional
        Is told of frames, from a number on, which were used: ``StreamRecorder.mark``.

    Returns
    -------
    Status

    Raises
    ------
    mirrorskin.io.InputError
        A latency or rate that is not above 0, or what source and estimator raise.
    """
    known = latency, updates, on_update, stop, mark
    return Loop(source, estimator, *known).run()


class Loop:
    """The loop of `run`, whose status can be asked for after an exception as well.

    Parameters
    ----------
    source, estimator, latency, updates, on_update, stop, mark
        As for `run`.
    """

    def __init__(
        self,
        source: LiveSource,
        estimator: LiveEstimator,
        latency: float = LATENCY,
        updates: float | None = None,
        on_update: OnUpdate | None = None,
        stop: Callable[[], bool] | None = None,
        mark: Mark | None = None,
    ) -> None:
        most = estimator.most_updates if updates is None else updates
        for name, number in (("latency", latency), ("updates", most)):
            if not number > 0:
                raise InputError(f"{name} {number}: a number above 0 is needed")
        self._source, self._estimator = source, estimator
        self._latency, self._period = latency, 1 / most
        self._on_update, self._stop, self._mark = on_update, stop, mark
        self._watch = Watch()
        self._newest = self._updated = -math.inf  # time of the newest frame that was pushed, of an update
        self._pending = False
        self._times: deque[float] = deque(maxlen=_INTERVALS)

    @property
    def status(self) -> Status:
        """What was counted and timed so far."""
        return self._watch.status(fresh=True)

    def run(self) -> Status:
        """Do all; see `run`."""
        gc.freeze()  # a collector that looks through all that was there before would hold up frames
        try:
            self._follow()
        finally:
            gc.unfreeze()
        return self.status

    def _follow(self) -> None:
        while (block := self._source.read(self._estimator.room)) is not None:
            self._take(block)
            if self._stop is not None and self._stop():
                break
            if self._source.now() - self._updated >= self._period:
                self._update()
            self._estimator.spare(self._idle())
        if self._pending:
            self._update()

    def _take(self, block: Block) -> None:
        """Push the frames of a block that are to be used, and mark all."""
        now, count = self._source.now(), len(block.frames)
        time = np.full(count, now) if block.time is None else block.time
        used = (now - time <= self._latency) | (np.arange(count) == count - 1)
        used &= (block.index + np.arange(count)) % self._estimator.every == 0
        self._watch.took(now, count, int(np.count_nonzero(used)), block.dropped)
        self._watch.time(WAITED, now - time)
        self._times.extend(time.tolist())
        with _whole():
            for part in _runs(used):
                self._estimator.push(_cut(block, part))
            if self._mark is not None:
                self._mark(block.index, used)
        if used.any():
            self._newest, self._pending = float(time[used][-1]), True
            self._watch.time(PUSHED, self._source.now() - now)

    def _update(self) -> None:
        if not self._pending:
            return
        begun = self._source.now()
        update = self._estimator.update()
        done = self._source.now()
        self._updated, self._pending = begun, False
        self._watch.updated()
        self._watch.time(UPDATED, done - begun)
        if update.height is not None or update.normals is not None:
            self._watch.time(SHOWN, done - self._newest)
        if self._on_update is not None:
            self._on_update(update, self._watch.status())

    def _idle(self) -> float:
        """Return the seconds until the next frame is due, less a margin."""
        if len(self._times) < 2:
            return 0.0
        interval = (self._times[-1] - self._times[0]) / (len(self._times) - 1)
        return self._times[-1] + interval - _MARGIN - self._source.now()


def _runs(used: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the frames that are used, in runs that follow each other."""
    edges = np.flatnonzero(np.diff(used, prepend=False, append=False))
    for start, stop in edges.reshape(-1, 2).tolist():
        yield slice(start, stop)


def _cut(block: Block, part: slice) -> Block:
    """Return some frames of a block."""
    if part == slice(0, len(block.frames)):
        return block
    time, travel, phase = (
        None if values is None else values[part] for values in (block.time, block.travel, block.phase)
    )
    return replace(
        block,
        frames=block.frames[part],
        index=block.index + part.start,
        time=time,
        travel=travel,
        phase=phase,
        dropped=0,
    )


@contextmanager
def _whole() -> Iterator[None]:
    """Put signals off until a step is done, so that an estimator's frames and its books agree."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: handler for number in _ENDING if callable(handler := signal.getsignal(number))}
    waiting: list[tuple[int, FrameType | None]] = []
    for number in handlers:
        signal.signal(number, lambda number, frame: waiting.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if waiting:
        handlers[signal.Signals(waiting[0][0])](*waiting[0])
