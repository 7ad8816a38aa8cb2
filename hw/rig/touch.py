"""A rig as the sensor of a touch: a frame at rest at each position that is asked for."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.base.errors import HardwareError
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


_OLD_FRAMES = 4  # that a camera may deliver with the exposure before
_CATCHING_UP = (
    0.5  # share of a period: frames in quicker succession were held up, and may show an earlier place
)


class RigTouch:
    """A rig for `mirrorskin.engine.live.touch`; its limits are checked before anything moves.

    Entering it lifts the body and takes the dark reference. Leaving it without an error lifts the body again;
    leaving it during a move or by an error stops the stage. The exposure is then again that of the rig file.

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
        self.header = self._stated = make_header(rig.settings, plan)  # and that of the rig file
        self._exposure: float | None = None  # seconds, if it was changed

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

    def expose(self, ratio: float, /) -> None:
        """Lift the body, and multiply the exposure of the camera by a ratio below 1; the header follows.

        A dark reference that is not from the rig file is taken again. InputError if the camera keeps its
        exposure.
        """
        camera, stated = self._rig.camera, self._rig.settings.camera.exposure
        set_exposure = getattr(camera, "set_exposure", None)
        if set_exposure is None:
            raise InputError(f"{camera.name} cannot change its exposure while it is open")
        if stated is None:
            raise InputError(
                f"{self.name}: state camera.exposure in the rig file, so that it can be shortened"
            )
        if self._exposure is None:
            self._exposure = self._first = set_exposure(stated)  # as rounded by the camera
        shorter = set_exposure(ratio * self._exposure)
        if not 0 < shorter < self._exposure:
            set_exposure(self._exposure)
            raise InputError(f"{camera.name} does not take an exposure below {self._exposure:.3g} s")
        self._exposure = shorter
        self.lift()
        self._rig.clock.sleep(_OLD_FRAMES * self._rig.period)
        total = shorter / self._first
        header = replace(self._stated, exposure_ratio=total * (self._stated.exposure_ratio or 1.0))
        self.header = self._with_dark(header).exposed(total)

    def _with_dark(self, header: Header) -> Header:
        """Return a header with the dark reference of the rig file, or one that is taken now."""
        if header.dark is not None:
            return header
        late = max(0.2, self._rig.settings.camera.delay or 0.0) + self._rig.period
        return replace(header, dark=take_dark(self._rig, self.now() + late))

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
        self.header = self._with_dark(self.header)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        try:
            if kind is None and not self._rig.moving:
                self.lift()
            else:
                self._rig.stage.stop()
        finally:
            if self._exposure is not None:
                with suppress(HardwareError, InputError):  # of a camera that is lost
                    self._rig.camera.set_exposure(self._first)  # type: ignore[attr-defined]


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
