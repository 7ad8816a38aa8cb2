"""A continuous scan: positions of frames are computed from the stage's reports."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.camera import Frames
from mirrorskin.hw.rig.delay import Delay, measure_delay
from mirrorskin.hw.rig.plans import AxialPlan, Plan
from mirrorskin.hw.rig.rig import Move, Rig, untriggered
from mirrorskin.hw.rig.scan import MARGIN, SETTLE, Scan, StepScan, check_there
from mirrorskin.hw.rig.track import LiveTrack, Progress, Track, even_times
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io.base.types import Block, Floats

_SLOWER = 1.01  # factor by which a turn may be slower than planned without having too many frames


class SweepScan(Scan):
    """Records in continuous motion; see ``Scan``.

    The live position of a frame is the planned trajectory, synchronised to the latest reports, at the frame's
    arrival minus the camera's delay. Afterwards ``positions`` returns more accurate ones, computed from all
    reports and from the constant frame rate of a camera. A delay that the rig file does not give, and that of
    a stream, is measured first by a short move back and forth.

    Parameters
    ----------
    rig : Rig
    plan : Plan
        With a speed or a rate.
    turn_frames : int, optional
        Maximum number of frames per turn: if necessary, only every second, third, ... frame is returned.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml")) as rig:  # doctest: +SKIP
    ...     with StreamRecorder(SweepScan(rig, VerticalPlan(0.0, 1.5, speed=0.5)), "press.h5") as recorder:
    ...         while recorder.read() is not None:
    ...             pass
    """

    def __init__(self, rig: Rig, plan: Plan, turn_frames: int | None = None) -> None:
        if rig.trigger is not None:
            raise untriggered(rig.settings)
        self._path = plan.path
        super().__init__(rig, plan)
        self._turn_frames = turn_frames
        self._move: Move | None = None
        self._every = 1
        self._live_track = LiveTrack(self._path, math.inf)
        self._progress = Progress(plan)
        self._reports: list[tuple[float, float]] = []
        self._frames: list[tuple[NDArray[np.int64], Floats]] = []

    @property
    def expected(self) -> int:
        """Expected number of frames."""
        rate = self.rig.rate
        all_frames = (self._path.duration + MARGIN) * rate
        return math.ceil(all_frames / self.every) if math.isfinite(rate) else 1

    @property
    def every(self) -> int:
        """One of this many frames of the camera is returned."""
        plan, rate = self.plan, self.rig.rate
        if self._turn_frames is None or not isinstance(plan, AxialPlan) or not math.isfinite(rate):
            return 1
        turn = Trapezoid.planned(math.tau, self._path.speed).duration
        return max(1, math.ceil(_SLOWER * turn * rate / self._turn_frames))

    @property
    def rate(self) -> float:
        """Measured frames per second of the camera during the scan."""
        if not self._frames:
            return super().rate
        number, time = (np.concatenate(parts) for parts in zip(*self._frames, strict=True))
        return float(np.ptp(number) / np.ptp(time)) if len(time) > 1 else super().rate

    @property
    def remark(self) -> str:
        """The camera's delay."""
        late = f"; frames {1e3 * self.delay.seconds:.1f} ms after their exposure"
        measured = f" (± {1e3 * self.delay.error:.1f} ms, measured)" if self.delay.error else ""
        thinned = f"; 1 of {self._every} frames kept" if self._every > 1 else ""
        return late + measured + thinned

    @functools.cached_property
    def delay(self) -> Delay:
        """The camera's delay, from the rig file or measured on first access."""
        camera = self.rig.settings.camera
        if camera.delay is None or camera.streamed:
            return measure_delay(self.rig, self.plan)
        return Delay(camera.delay, 0.0)

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of all frames, computed from all reports once the motion has ended."""
        if not (self._complete and self._frames):  # all frames may have been before or after the motion
            return super().positions()
        number, arrival = (np.concatenate(parts) for parts in zip(*self._frames, strict=True))
        times, reported = zip(*self._reports, strict=True)
        track = Track(times, reported, self._path)
        distances = track.at(even_times(number, arrival) - self.delay.seconds)
        return {self.plan.series: self.plan.recorded(distances)}

    @property
    def _lateness(self) -> float:
        """Seconds from an exposure to its arrival."""
        return self.delay.seconds

    def _prepare(self) -> None:
        super()._prepare()
        _ = self.delay

    def _next(self, limit: int, origin: float) -> Block | None:
        if self._move is None:
            taken, rest = self._begin(limit)
            if not isinstance(self.plan, AxialPlan):
                return self._give(taken, rest, np.zeros(rest.stop - rest.start), taken.dropped, origin)
        move = self._move
        assert move is not None  # set by _begin
        dropped = 0  # frames lost since the last block
        while True:
            taken = self.rig.take(limit)
            self._add_reports()
            exposed = taken.time - self.delay.seconds
            distance = self._live_track.at(exposed)
            moving = self._part(move, exposed, distance)
            dropped += taken.dropped if moving.start < moving.stop else 0
            part = self._thinned(taken, moving)
            if part.start < part.stop:
                return self._give(taken, part, distance[part], dropped, origin)
            if part.stop < len(distance):
                end = self.plan.place(self.plan.length)
                check_there(self.rig.end(move), end, self.rig.stage.name)
                self._add_reports()
                return None

    def _give(self, taken: Frames, part: slice, distance: Floats, dropped: int, origin: float) -> Block:
        """Return a block with a part of the frames, and record their times."""
        time = taken.time[part]
        self._frames.append((taken.number[part], time))
        return self._block(taken.pixels[part], time, self.plan.recorded(distance), dropped, origin)

    def _begin(self, limit: int) -> tuple[Frames, slice]:
        """Wait until frames show the body at rest, and start the motion; return these frames."""
        plan, stage = self.plan, self.rig.stage
        self._every = self.every  # at the current rate
        self.rig.camera.flush()
        rests = stage.report().time + self.delay.seconds
        while (taken := self.rig.take(limit)).time[-1] <= rests:
            pass
        self._move = self.rig.begin(lambda: plan.begin(stage), timed=True)
        self._live_track = LiveTrack(self._path, self._move.began)
        self._reports = [(self._move.began, 0.0)]
        return taken, slice(int(np.searchsorted(taken.time, rests, side="right")), len(taken.time))

    def _add_reports(self) -> None:
        """Add the reports received since the last call."""
        for report in self.rig.stage.history(self._reports[-1][0]):
            distance = self._progress(report)
            self._reports.append((report.time, distance))
            self._live_track.add(report.time, distance)

    def _part(self, move: Move, exposed: Floats, distance: Floats) -> slice:
        """Return which frames belong to the scan.

        A straight scan includes frames at rest before and after the motion. A rotation does not: one phase
        would be weighted too much.
        """
        end = int(np.searchsorted(exposed, move.ended, side="right"))
        if not isinstance(self.plan, AxialPlan):
            return slice(0, end)
        end = min(end, int(np.searchsorted(distance, self._path.length)))
        return slice(min(end, int(np.searchsorted(exposed, move.began))), end)

    def _thinned(self, taken: Frames, part: slice) -> slice:
        """Return the part without the frames to be skipped."""
        if part.start >= part.stop:
            return part
        skipped = -int(taken.number[part.start]) % self._every
        return slice(min(part.start + skipped, part.stop), part.stop, self._every)


def make_scan(
    rig: Rig,
    plan: Plan,
    settle: float | None = None,
    frames: int | None = None,
    turn_frames: int | None = None,
) -> StepScan | SweepScan:
    """Join a rig and a plan to a source of frames; see ``StepScan`` and ``SweepScan``."""
    if plan.in_steps:
        return StepScan(rig, plan, SETTLE if settle is None else settle, frames or 1)
    return SweepScan(rig, plan, turn_frames)
