"""A scan in steps: move, wait until the body rests, let it settle, take frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.rig.plans import Plan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import UNKNOWN_DELAY, Scan
from mirrorskin.hw.stage import Position, Report
from mirrorskin.io.types import Block, Floats, InputError

_ASTRAY = (0.02, 2e-3)
"""How far from where it was sent the body may rest, mm and rad."""


class StepScan(Scan):
    """Stands still for each of its frames; see ``Scan``.

    Frames count whose exposure began after the body had settled: they arrive later by the camera's delay,
    which is taken as 0.2 s where the rig file does not say, and half an exposure.

    Parameters
    ----------
    rig : Rig
    plan : VerticalPlan or AxialPlan
        With steps.
    settle : float
        Seconds from rest to the first exposure.
    frames : int
        At each place, 1 or more.
    """

    def __init__(self, rig: Rig, plan: Plan, settle: float = 0.1, frames: int = 1) -> None:
        if not 0 <= settle < np.inf:
            raise InputError(f"a settling time of {settle} s cannot be: give 0 or more")
        if frames < 1:
            raise InputError(f"{frames} frames a step cannot be: give 1 or more")
        super().__init__(rig, plan)
        self.settle, self.frames = settle, frames
        self._values, self._places = plan.values, plan.places
        self._step = -1
        self._left = 0
        self._since = 0.0

    @property
    def expected(self) -> int:
        """Frames that the scan will give."""
        return len(self._values) * self.frames

    def _next(self, most: int, origin: float) -> Block | None:
        if self._left == 0:
            if self._step + 1 == len(self._values):
                return None
            self._go_on()
        frames, arrival, dropped = self._take(min(most, self._left))
        self._left -= len(frames)
        place = np.full(len(frames), self._values[self._step])
        return self._block(frames, arrival, place, dropped, origin)

    def _go_on(self) -> None:
        """Move to the next place, and tell from when on frames show the body settled there."""
        self._step += 1
        place = self._places[self._step]
        rest = self.rig.go(place)
        _check_there(rest, place, self.rig.stage.name)
        camera = self.rig.settings.camera
        delay = UNKNOWN_DELAY if camera.delay is None else camera.delay
        exposure = self.rig.period if camera.exposure is None else camera.exposure
        self._since = rest.time + self.settle + delay + exposure / 2
        self._left = self.frames
        self.rig.camera.flush()

    def _take(self, most: int) -> tuple[NDArray[Any], Floats, int]:
        """Take frames that are new enough; what was lost before the first of a place does not matter."""
        while True:
            taken = self.rig.take(most)
            new = int(np.searchsorted(taken.time, self._since, side="right"))
            if new < len(taken.time):
                first = self._left == self.frames
                return taken.pixels[new:], taken.time[new:], 0 if first else taken.dropped


def _check_there(rest: Report, place: Position, name: str) -> None:
    """Refuse a stage that rests elsewhere than it was sent."""
    travel, lean = _ASTRAY
    off = abs(rest.position.travel - place.travel)
    leans = max(abs(rest.position.pitch - place.pitch), abs(rest.position.roll - place.roll))
    if off > travel or leans > lean:
        raise HardwareError(
            f"{name} rests {off:.3f} mm and {np.degrees(leans):.3f} degrees from where it was sent:"
            " look at its steps per mm and for what holds it"
        )
