"""A rig as the sensor of a touch: a frame at rest at each position that is asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.rig_file import RigSettings
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import AxialPlan, check_plan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import SETTLE, make_header, settle_at, take_dark
from mirrorskin.io.base.types import Header, InputError

TILT = math.radians(2.5)
"""Half-angle of the turn, radians, by default."""

SEARCH = 0.2
"""Distance between frames until there is contact, mm, by default."""


_CATCHING_UP = (
    0.5  # share of a period: frames in quicker succession were held up, and may show an earlier place
)


class RigTouch:
    """A rig for `mirrorskin.engine.live.touch`; its limits are checked before anything moves.

    Entering it lifts the body and takes the dark reference. Leaving it without an error lifts the body again;
    leaving it during a move or by an error stops the stage.

    Parameters
    ----------
    rig : Rig
        Opened with ``steps=True``.
    press : float, optional
        Greatest travel, mm; by default that of the rig file.
    start : float, optional
        Travel without contact at which the search starts, mm; by default the least of its limits.
    tilt : float
        Half-angle of the turn, radians.
    search : float
        Distance between frames until there is contact, mm, above 0.

    Raises
    ------
    InputError
        A position beyond the limits, or fewer than four places of the search.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml"), steps=True) as rig, RigTouch(rig) as sensor:  # doctest: +SKIP
    ...     frame = sensor.take(0.5)
    """

    header: Header

    def __init__(
        self,
        rig: Rig,
        press: float | None = None,
        start: float | None = None,
        tilt: float = TILT,
        search: float = SEARCH,
    ) -> None:
        self._rig, self.name = rig, rig.name
        self.shape, self.dtype = rig.camera.shape, rig.camera.dtype
        plan = touch_plan(rig.settings, press, start, tilt, search)
        check_plan(plan, rig.settings.stage, rig.stage.name, rig.stage)
        limits = rig.stage.limits
        self.start = limits.travel[0] if start is None else start
        limits.check(Position(self.start), rig.stage.name)
        self.deepest, self.search = plan.press, search
        self.header = make_header(rig.settings, plan)

    def take(self, travel: float, tilt: float = 0.0, phase: float = 0.0, /) -> NDArray[Any]:
        """Move to a travel, mm, and a lean, radians, rest there, and return a frame of its own, (H, W)."""
        place = Position(travel, tilt * math.cos(phase), tilt * math.sin(phase))
        since = settle_at(self._rig, place, SETTLE)
        camera, last = self._rig.settings.camera, math.inf
        least = _CATCHING_UP * self._rig.period  # seconds between frames that did not wait for each other
        if self._rig.trigger is not None or not (camera.delay is None or camera.streamed):
            last = -math.inf
        while True:
            taken = self._rig.take(1)
            time = float(taken.time[-1])
            if time > since and time - last >= least:
                return np.array(taken.pixels[-1])
            last = time

    def lift(self) -> None:
        """Set the body upright, and lift it to the end of its travel."""
        stage = self._rig.stage
        for place in dict.fromkeys(stage.limits.retreat_path(stage.report().position)):
            self._rig.go(place)

    def now(self) -> float:
        """Return the time, seconds."""
        return self._rig.clock.now()

    def __enter__(self) -> Self:
        self.lift()
        if self.header.dark is None:
            late = max(0.2, self._rig.settings.camera.delay or 0.0) + self._rig.period
            self.header = replace(self.header, dark=take_dark(self._rig, self.now() + late))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        if kind is None and not self._rig.moving:
            self.lift()
        else:
            self._rig.stage.stop()


def touch_plan(
    settings: RigSettings,
    press: float | None = None,
    start: float | None = None,
    tilt: float = TILT,
    search: float = SEARCH,
) -> AxialPlan:
    """Return the deepest turn of a touch; InputError if a rig cannot execute it, before it is opened."""
    limits = settings.stage.limits
    deepest = min(limits.press, limits.travel[1]) if press is None else press
    first = limits.travel[0] if start is None else start
    if not search > 0 or not math.isfinite(search):
        raise InputError(f"a search step of {search:g} mm is not possible: give one above 0")
    if not deepest - first > 3 * search:
        raise InputError(
            f"{settings.name}: a touch from {first:g} to {deepest:g} mm has no place to search for contact in"
            f" steps of {search:g} mm: start higher, or press deeper"
        )
    plan = AxialPlan(deepest, tilt, phase_step=math.tau / 4)
    check_plan(plan, settings.stage, settings.name)
    limits.check(Position(first), settings.name)
    return plan
