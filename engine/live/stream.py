"""Frames of your own camera: pushed from any thread; maps can be read at any time."""

from __future__ import annotations

import asyncio
import math
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import TracebackType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.device_arrays import on_host
from mirrorskin.engine.base.frames import as_frames, check_dtype
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import COMPONENTS, Operation
from mirrorskin.engine.live.loop import LATENCY, Loop, OnUpdate
from mirrorskin.engine.live.run import LiveRun
from mirrorskin.engine.live.status import Event, Status, Update
from mirrorskin.engine.live.tracking import Limit, Tracker
from mirrorskin.io import Block, Header, InputError, Motion, Result
from mirrorskin.io.base.arguments import check_number, unknown_argument
from mirrorskin.io.base.types import Closing, Floats
from mirrorskin.io.model.positions import check_finite
from mirrorskin.io.storage.layout import LIVE, POSITIONS, as_series

WAITING = 64
"""Largest number of frames that wait to be processed."""

_ENDLESS = 1 << 40  # frames that a stream may have


class Stream(Closing):
    """Push frames of your own camera and stage into an operation, and read its maps at any time.

    A separate thread runs the operation by the policy of `Loop`: frames that waited longer than ``latency``
    are skipped, except for the newest one. An error there is raised by the next call, or by `close` if no
    other call raised it. A stream to which nothing refers any more ends its thread. All kernels are compiled
    and run once before the first frame.

    Parameters
    ----------
    operation : Operation or Method
        Such as ``engine.Press(dark=16, bright=223)``; `Frames` for trackers alone.
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    motion : {"vertical", "axial", "horizontal", "twist"}, optional
        How the body moves; by default the motion that the operation applies to, and any if it takes no
        positions.
    header : Header, optional
        Properties of all frames, such as the pixel size; its motion is used.
    latency : float
        Seconds; 0 to use only the newest frame; infinite to use all frames: then `push` waits while 64 wait.
    trackers, events : mapping, optional
        Trackers and limits by name; see `Loop`.
    on_update : callable, optional
        Called with each update and the status, in the stream's thread, which waits for it. What it raises
        ends the stream as an error of the operation does.

    Raises
    ------
    mirrorskin.io.InputError
        The operation cannot run live, or does not apply to the motion; a tracker or a limit is none.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> press = engine.Press(dark=0, bright=255, fill=False)
    >>> with engine.live.Stream(press, (2, 3), latency=math.inf) as stream:
    ...     for travel in (0.0, 0.1, 0.2, 0.3):
    ...         stream.push(np.full((2, 3), 255 * (travel > 0.15), np.uint8), travel=travel)
    ...     height = stream.result().height
    >>> height[0]
    array([-0.15, -0.15, -0.15], dtype=float32)
    """

    def __init__(
        self,
        operation: Operation | Method,
        shape: tuple[int, int],
        dtype: DTypeLike = np.uint8,
        *,
        motion: Motion | None = None,
        header: Header | None = None,
        latency: float = LATENCY,
        trackers: Mapping[str, Tracker] | None = None,
        events: Mapping[str, Limit] | None = None,
        on_update: OnUpdate | None = None,
    ) -> None:
        header = _header(operation, motion, header)
        self._source = _Pushed(header, shape, check_dtype(dtype), latency, on_update)
        self._run = LiveRun(self._source, operation)
        if not self._run.operation.positions:
            self._source.needed = ()
        if {"pose", "tilt"} & {name for name, needed in self._run.operation.positions.items() if needed}:
            self._source.needed += ("tilt",)
        self._loop = Loop(
            self._source,
            self._run,
            latency=latency,
            trackers=trackers,
            events=events,
            on_update=self._source.keep,
        )
        self._loop.precompile()
        self._thread = threading.Thread(
            target=_run, args=(self._loop, self._source), name="mirrorskin-stream", daemon=True
        )
        self._thread.start()
        weakref.finalize(self, self._source.abandon).atexit = False

    def push(self, frames: ArrayLike, *, time: float | None = None, **positions: ArrayLike) -> None:
        """Process the next frame, (H, W), or frames, (n, H, W): they are copied, and processed later.

        Parameters
        ----------
        frames : array_like
        time : float, optional
            Seconds, of the newest of them, on the scale of `now`, not before that of earlier frames; by
            default the time of this call.
        **positions : float or array_like, (n,)
            Of the body, one of each frame: ``travel``, mm, ``phase``, ``twist`` or ``tilt``, radians, or
            ``displacement``, mm, two numbers. The same ones with each frame.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another size or type, or a time or a position that is missing or impossible: then
            nothing is pushed. Or whatever the operation refused: then the stream can only be closed.
        """
        self._source.put(frames, time, positions)

    def now(self) -> float:
        """Return the seconds since the stream was made."""
        return self._source.now()

    def latest(self) -> Update | None:
        """Return the newest maps, for a display, without waiting; None before the first ones."""
        self._source.check()
        return self._source.latest

    async def updates(self) -> AsyncIterator[Update]:
        """Yield the newest maps whenever there are new ones, until the stream is closed.

        An update that is not taken before the next one is omitted, except for its events, which are in the
        next one. Whatever the operation refused is raised.

        Examples
        --------
        >>> import asyncio
        >>> from mirrorskin import engine
        >>> async def watch():
        ...     with engine.live.Stream(engine.Press(dark=0, bright=255), (2, 3)) as stream:
        ...         stream.push(np.full((2, 3), 255, np.uint8), travel=0.1)
        ...         async for update in stream.updates():
        ...             return update.frames
        >>> asyncio.run(watch())
        1
        """
        shown, changed, loop = None, asyncio.Event(), asyncio.get_running_loop()
        with self._source.watched(lambda: loop.call_soon_threadsafe(changed.set)) as events:
            while True:
                changed.clear()
                ended = self._source.finished
                newest = self.latest()
                if newest is not None and newest is not shown:
                    shown = newest
                    yield replace(newest, events=tuple(events.popleft() for _ in range(len(events))))
                elif ended:
                    return
                else:
                    await changed.wait()

    @property
    def status(self) -> Status:
        """Numbers of used, skipped and lost frames, and their latencies."""
        return self._loop.status

    def result(self) -> Result:
        """Wait until all frames pushed so far are processed, and return all maps of the operation.

        Raises
        ------
        mirrorskin.io.InputError
            The frames do not determine them, or whatever the operation refused.
        """
        self._source.wait()
        return self._run.result()

    def close(self) -> None:
        """End the thread; frames that still wait are processed before.

        Raises
        ------
        mirrorskin.io.InputError
            Whatever the operation refused, unless it was raised before.
        """
        self._source.close()
        self._thread.join()
        self._source.check(again=False)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._source.close()
        self._thread.join()
        if error is None:
            self._source.check(again=False)


def _run(loop: Loop, source: _Pushed) -> None:
    """Process frames, without a reference to the stream, which is deleted when it is forgotten."""
    try:
        loop.run()
    except BaseException as error:  # it is raised by the next call of another thread
        source.fail(error)
    finally:
        source.finish()


def _header(operation: Operation | Method, motion: Motion | None, header: Header | None) -> Header:
    """Return the header of a stream, with its motion."""
    if header is not None:
        if motion not in (None, header.motion):
            raise InputError(f"motion {motion!r} contradicts the header's, {header.motion!r}: leave it out")
        return header
    possible = operation.motions or tuple(POSITIONS)
    needs_positions = isinstance(operation, Method) or bool(operation.positions)
    if motion is None and len(possible) > 1 and needs_positions:
        name, motions = type(operation).__name__, ", ".join(possible)
        raise InputError(f"{name} applies to several motions: give motion, one of {motions}")
    return Header(cast(Motion, motion or possible[0]))


class _Pushed(Closing):
    """A live source whose frames come from another thread."""

    name = "stream"
    rewindable = False

    def __init__(
        self,
        header: Header,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        latency: float,
        on_update: OnUpdate | None,
    ) -> None:
        self.header, self.motion = header, header.motion
        self.shape, self.dtype = (_ENDLESS, *shape), dtype
        self.needed: tuple[str, ...] = (POSITIONS[self.motion],)
        self.latest: Update | None = None
        self._start = time.monotonic()
        self._keeps_all, self._on_update = latency == math.inf, on_update
        self._changed = threading.Condition()
        self._waiting: deque[tuple[NDArray[Any], float, dict[str, Floats]]] = deque()
        self._free: list[NDArray[Any]] = []  # arrays of frames that were processed
        self._count = self._lost = 0
        self._newest, self._names = -math.inf, frozenset[str]()
        self._idle = self._ended = self._raised = False
        self.finished = False  # the last frame was processed, or an error ended it
        self._watchers: list[tuple[Callable[[], object], deque[Event]]] = []
        self._error: BaseException | None = None

    def now(self) -> float:
        return time.monotonic() - self._start

    def positions(self) -> Mapping[str, Floats]:
        return {}

    def rewind(self) -> None:
        raise RuntimeError("a stream cannot be rewound")

    def keep(self, update: Update, status: Status) -> None:
        """Keep the newest maps, and tell those who wait for them."""
        with self._changed:
            for _, events in self._watchers:
                events.extend(update.events)
            self.latest = update
        self._tell()
        if self._on_update is not None:
            self._on_update(update, status)

    @contextmanager
    def watched(self, tell: Callable[[], object]) -> Iterator[deque[Event]]:
        """Call a function, from the reader's thread, after each update and at the end; collect events.

        The first events are those of the newest update.
        """
        with self._changed:
            watcher = tell, deque[Event](() if self.latest is None else self.latest.events)
            self._watchers.append(watcher)
        try:
            yield watcher[1]
        finally:
            self._watchers.remove(watcher)

    def finish(self) -> None:
        """Note that no update follows."""
        self.finished = True
        self._tell()

    def _tell(self) -> None:
        for tell, _ in tuple(self._watchers):
            with suppress(RuntimeError):  # its event loop has ended
                tell()

    def put(self, frames: ArrayLike, at: float | None, positions: Mapping[str, ArrayLike]) -> None:
        """Add frames, after everything about them has been checked."""
        array = on_host(as_frames("frames", frames))
        single = array.ndim == 2
        array = array[np.newaxis] if single else array
        if array.ndim != 3 or array.shape[1:] != self.shape[1:] or array.dtype != self.dtype:
            raise InputError(
                f"frames are {array.dtype} {np.shape(frames)}: {self.dtype} {self.shape[1:]} are expected"
            )
        places = self._checked(positions, len(array), single)
        at = None if at is None else float(check_number("time", at, "s"))
        if at is not None and not math.isfinite(at):
            raise InputError(f"time is {at}: a finite number of seconds is needed")
        with self._changed:
            self._check()
            when = self._in_order(at, places)
            for number, frame in enumerate(array):
                if self._keeps_all:
                    self._changed.wait_for(lambda: len(self._waiting) < WAITING or self._stopped)
                self._check()
                if len(self._waiting) == WAITING:
                    self._free.append(self._waiting.popleft()[0])
                    self._lost += 1
                here = {name: value[number] for name, value in places.items()}
                copied = self._free.pop() if self._free else np.empty(self.shape[1:], self.dtype)
                np.copyto(copied, frame)
                self._waiting.append((copied, when, here))
                self._changed.notify_all()

    def _checked(self, positions: Mapping[str, ArrayLike], count: int, single: bool) -> dict[str, Floats]:
        """Return the positions of frames, (count,) or (count, components)."""
        if unknown := positions.keys() - LIVE:
            raise InputError(unknown_argument("push()", min(unknown), [*LIVE], "position"))
        places = {name: as_series(name, value) for name, value in positions.items() if value is not None}
        if missing := [name for name in self.needed if name not in places]:
            raise InputError(f"{missing[0]} is needed of each frame: push(frame, {missing[0]}=...)")
        for name, value in places.items():
            width = COMPONENTS.get(name, ())
            if value.shape != (width if single else (count, *width)):
                numbers = "two numbers are" if width else "one number is"
                raise InputError(f"{name} has shape {value.shape}: {numbers} needed of each frame")
            places[name] = check_finite(value.reshape(count, *width), count, name, width=width)
        return places

    def _in_order(self, at: float | None, names: Collection[str]) -> float:
        """Return the time of frames that follow the earlier ones, and have positions of the same names."""
        if self._names and self._names != set(names):
            now, before = (" and ".join(sorted(each)) for each in (names, self._names))
            raise InputError(
                f"frames have {now}, but earlier ones had {before}. Push the same with each frame"
            )
        when = self.now() if at is None else at
        if when < self._newest:
            raise InputError(
                f"time {when:.6g} s is before that of an earlier frame, {self._newest:.6g} s. Push frames in"
                " the order of their times, on the scale of now()"
            )
        self._newest, self._names = when, frozenset(names)
        return when

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        assert out is not None
        with self._changed:
            self._idle = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._waiting or self._ended)
            self._idle = False
            taken = [self._waiting.popleft() for _ in range(min(len(out), len(self._waiting)))]
            lost, self._lost = self._lost, 0
            self._changed.notify_all()
        if not taken:
            return None
        frames, times, places = zip(*taken, strict=True)
        part = out[: len(taken)]
        for copied, frame in zip(part, frames, strict=True):
            np.copyto(copied, frame)
        self._free += frames
        first, self._count = self._count, self._count + len(taken)
        positions: dict[str, Any] = {name: np.array([place[name] for place in places]) for name in places[0]}
        return Block(part, first, time=np.array(times), dropped=lost, **positions)

    def wait(self) -> None:
        """Wait until no frame waits and the reader asks for more."""
        with self._changed:
            self._changed.wait_for(lambda: (self._idle and not self._waiting) or self._stopped)
            self._check()

    def close(self) -> None:
        """Let the reader end after the waiting frames."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def abandon(self) -> None:
        """Let the reader end without the waiting frames."""
        with self._changed:
            self._waiting.clear()
            self.close()

    def fail(self, error: BaseException) -> None:
        """Raise an error at the next call of another thread."""
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def check(self, again: bool = True) -> None:
        """Raise the error that ended the reader, if any; if it was raised before, only if ``again``."""
        with self._changed:
            if self._error is not None and (again or not self._raised):
                self._raised = True
                raise self._error

    @property
    def _stopped(self) -> bool:
        return self._ended or self._error is not None

    def _check(self) -> None:
        self.check()
        if self._ended:
            raise InputError("the stream is closed: push frames, and ask for its result, before")
