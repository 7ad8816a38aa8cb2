"""The twin as a camera that watches a stage: frames arrive in real time and show the body's position."""

from __future__ import annotations

import itertools
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.cameras.camera_thread import ThreadedCamera
from mirrorskin.io.base.types import InputError
from mirrorskin.twin import Twin
from mirrorskin.twin.movement import Pose, Twist, pose_at_lean, pose_at_press

_LOOK = 0.002  # interval at which the trigger is polled, seconds


def pose_at(place: Position, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Pose:
    """Return the pose of the object in the frame of a body at a position."""
    lean = pose_at_lean(place.travel, place.tilt, place.phase, pivot)
    if not (place.x or place.y or place.twist):
        return lean
    back = Twist([0.0], 0.0).pose(np.asarray(place.twist)).rotation
    shift = back @ np.array([-place.x, -place.y, 0.0])
    return Pose(lean.rotation @ back, lean.rotation @ shift + lean.shift)


class _Frame(NamedTuple):
    """A frame in transfer: its image, its time of arrival, and the number of frames lost before it."""

    pixels: NDArray[Any]
    arrival: float
    lost: int


class TwinCamera(ThreadedCamera):
    """A `mirrorskin.hw.Camera` that shows the twin at the current position of the body.

    Frame n is exposed about the time t = start + n / rate and arrives at t + delay + N(0, jitter), but not
    before its exposure ends, nor before the preceding frame. Its time is this arrival on the emulated
    camera's clock, so delays of a busy computer do not affect it. A frame that is not rendered within a
    period after its arrival is lost and counted, as in a camera that cannot keep up.

    With a `trigger`, which returns the times at which a line was switched on, off, on, ..., one frame is
    exposed each time that the line is switched on.

    `where` returns the body's `Position` at a past time of the `clock`; the twin's movement only bounds the
    positions. `delay` and `jitter` are seconds. The body rotates about `pivot`, mm from the centre of the
    undeformed sheet. ``lateness`` returns an additional delay of a frame number in seconds; inf loses the
    frame. ``light`` is relative to that at which full light has the camera's bright level in an exposure of a
    whole period.
    """

    def __init__(
        self,
        twin: Twin,
        where: Callable[[float], Position],
        *,
        delay: float = 0.0,
        jitter: float = 0.0,
        seed: int = 0,
        pivot: tuple[float, float, float] = (0.0, 0.0, 0.0),
        trigger: Callable[[], list[float]] | None = None,
        light: float = 1.0,
        clock: Clock = SYSTEM,
    ) -> None:
        rate = twin.frame_rate
        for name, value in (("delay", delay), ("jitter", jitter)):
            if not 0 <= value < math.inf:
                raise InputError(
                    f"{name} {value} of the emulated camera is not possible: give seconds, 0 or more"
                )
        super().__init__(twin.name, twin.shape[1:], twin.dtype, rate, clock=clock)
        self._twin, self._where, self._pivot = twin, where, pivot
        self._trigger = trigger
        self._rate, self._delay, self._jitter = rate, delay, jitter
        self._light, self._period = light, 1 / rate
        self.exposure = self._period
        self._random = np.random.default_rng(seed)
        self._in_transit: deque[_Frame] = deque()
        self._change = clock.condition()
        self._stalled, self._ended = threading.Event(), clock.event()
        self.lateness: Callable[[int], float] = lambda number: 0.0
        self._threads = [
            clock.thread(partial(self._report_failure, work), f"{self.name}: {name}")
            for name, work in (("exposes", self._expose), ("delivers", self._deliver))
        ]
        for thread in self._threads:
            thread.start()

    def set_exposure(self, seconds: float, /) -> float:
        """Expose later frames for a time, at most a period, and return it, seconds."""
        if not 0 < seconds < math.inf:
            raise InputError(f"{self.name}: an exposure of {seconds} s is not possible: give one above 0")
        self.exposure = min(seconds, self._period)
        return self.exposure

    def stall(self) -> None:
        """Deliver no more frames, without an error."""
        self._stalled.set()

    def lose(self) -> None:
        """Fail permanently: no more frames arrive, and readers get an error."""
        self._stalled.set()
        self._fail(f"{self.name} was lost: check its power supply and its cable")

    def close(self) -> None:
        """Stop; frames in transfer do not arrive. A second call does nothing."""
        self._ended.set()
        with self._change:
            self._change.notify_all()
        for thread in self._threads:
            thread.join()
        self._fail(f"{self.name} is closed")

    def _report_failure(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # readers get the error; the other thread ends when the camera is closed
            self._fail(f"{self.name} failed: {error}")

    def _expose(self) -> None:
        """Render each frame when its exposure is over, or skip it if it would be too late."""
        # A device's first launch takes longer than later ones.
        self._twin.look(lambda late: pose_at_press(0.0), 0, np.empty(self.shape, self.dtype))
        period, lost, last = 1 / self._rate, 0, -math.inf
        for number, middle in enumerate(self._exposures(period)):
            exposure_end = middle + self._twin.exposure / 2
            arrival = max(
                exposure_end, last, middle + self._delay + self._jitter * self._random.standard_normal()
            )
            arrival += self.lateness(number)
            if self._wait_until(exposure_end):
                return
            late = self._trigger is None and self.clock.now() > arrival + period
            if self._stalled.is_set() or late or arrival == math.inf:
                lost += 1
            else:
                pixels = self._render(middle, number)
                with self._change:
                    self._in_transit.append(_Frame(pixels, arrival, lost))
                    self._change.notify_all()
                last, lost = arrival, 0

    def _exposures(self, period: float) -> Iterator[float]:
        """Yield the middle of each exposure, possibly ahead of time."""
        if self._trigger is None:
            start = self.clock.now()
            yield from (start + number * period for number in itertools.count())
            return
        frames = 0
        while not self._ended.wait(_LOOK):
            for went_on in self._trigger()[::2][frames:]:
                frames += 1
                yield went_on + self._twin.exposure / 2

    def _render(self, middle: float, number: int) -> NDArray[Any]:
        pixels = np.empty(self.shape, self.dtype)

        def pose(late: float) -> Pose:
            return pose_at(self._where(middle + late), self._pivot)

        self._twin.look(pose, number, pixels, self._light * (self.exposure / self._period))
        return pixels

    def _deliver(self) -> None:
        """Deliver each frame when it is due."""
        missed = 0
        while True:
            with self._change:
                while not (self._in_transit or self._ended.is_set()):
                    self._change.wait()
                if self._ended.is_set():
                    return
                frame = self._in_transit.popleft()
            if self._wait_until(frame.arrival):
                return
            if self._stalled.is_set():
                missed += 1 + frame.lost
                continue
            self._slot()[:] = frame.pixels
            self._put(frame.arrival, frame.lost + missed)
            missed = 0

    def _wait_until(self, due: float) -> bool:
        """Wait until a time, and return whether the camera was closed meanwhile."""
        return self._ended.wait(max(0.0, due - self.clock.now()))
