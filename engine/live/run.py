"""Live operation: a run of an operation or a method over a source whose frames arrive in real time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.running import Run, check_motion
from mirrorskin.engine.base.steps import Undistortion
from mirrorskin.io import InputError, LiveSource, Map, Result, pixel_axes
from mirrorskin.io.storage.layout import POSITIONS

if TYPE_CHECKING:
    from mirrorskin.io.base.types import ProcessValue

_FRAMES = 64  # largest number of frames of a push
_AREA = {"contact_area": Map("area where sheet and object touch", "mm²", "float64", "none")}


class LiveRun(Run):
    """A run that `Loop` pushes frames into, and the source of these frames.

    Parameters
    ----------
    source : LiveSource
        Options that are not given are taken from its header and calibration, if available.
    operation : Operation or Method
        The steps of a method are applied by `result`.
    every : int
        Only frames whose number is a multiple of this are used.

    Raises
    ------
    mirrorskin.io.InputError
        The operation does not apply to the source's motion, or needs data that are not available live.
    """

    def __init__(self, source: LiveSource, operation: Operation | Method, *, every: int = 1) -> None:
        if every < 1:
            raise InputError(f"every {every}: a number of frames of at least 1 is needed")
        self.every = every
        with naming(source):
            check_motion(source, operation)
            plan = getattr(operation, "live_plan", operation.plan)(source)
            steps = [*plan.steps, Undistortion()] if hasattr(operation, "live_plan") else plan.steps
            _check_positions(source, plan.operation)
            limit = 2 * _FRAMES * math.prod(source.shape[1:]) * source.dtype.itemsize
            configured = plan.operation.with_options(memory_limit=limit)
            super().__init__(replace(plan, operation=configured, steps=steps), source)
        rocks = source.motion == "axial" and source.header.tilt is None
        self.position: str = "tilt" if rocks else POSITIONS[source.motion]

    def maps(self, seconds: float = math.inf, /) -> Result:
        """Return the maps of the frames so far for a display; none before they are determined."""
        source = cast("LiveSource", self._source)
        with naming(source):
            shown = self.preview(seconds)
        contact, size = shown.contact, source.header.pixel_size
        if size is None:
            return shown
        area = None if contact is None else float(np.count_nonzero(contact)) * math.prod(size)
        x, y = pixel_axes(source.shape[1:], size)
        return shown.assign(contact_area=area, x=x, y=y, declarations=_AREA)

    def result(self, *, ended: bool = False, process: Mapping[str, ProcessValue] | None = None) -> Result:
        """Return all maps of the frames so far, with findings and provenance; see `Run.result`."""
        live = {"live": True, **({"every": self.every} if self.every > 1 else {})}
        with naming(cast("LiveSource", self._source)):
            return super().result(ended=ended, process={**live, **(process or {})})


def _check_positions(source: LiveSource, operation: Operation) -> None:
    """Raise InputError unless an operation can run over frames that come while the body moves."""
    if operation.passes == 2:
        raise InputError(f"{type(operation).__name__} needs all frames twice, so it cannot run live")
    available = {POSITIONS[source.motion], "time"}
    if source.motion == "axial" and source.header.tilt is None:
        available |= {"tilt", "pose"}
    needed = {name for name, is_needed in operation.positions.items() if is_needed}
    if missing := needed - available:
        names = ", ".join(sorted(missing))
        raise InputError(
            f"{type(operation).__name__} needs {names}. While the body moves, {source.name} has"
            f" {', '.join(sorted(available))} of each frame"
        )
