"""Live operation: an operation or a method, and the source of its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.method import Method, Plan, check_motion, undistorted
from mirrorskin.engine.operation import Operation
from mirrorskin.engine.provenance import describe, naming
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError, LiveSource, Result
from mirrorskin.io.layout import POSITIONS

_FRAMES = 64  # largest number of frames of a push
_SHOWN = ("height", "normals", "contact", "edges", "displacement", "slope", "height_lag", "offset_unknown")


class LiveOperation(ThreadSafe):
    """An operation or a method that `Loop` pushes frames into, and the source of these frames.

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

    Attributes
    ----------
    operation : Operation
        Configured for the source, and ready for its frames.
    """

    def __init__(self, source: LiveSource, operation: Operation | Method, *, every: int = 1) -> None:
        if every < 1:
            raise InputError(f"every {every}: a number of frames of at least 1 is needed")
        self._source, self.every, shape = source, every, source.shape[1:]
        with naming(source):
            self._plan = _live_plan(source, operation, _FRAMES * math.prod(shape) * source.dtype.itemsize)
            self.operation: Operation = self._plan.operation
            self._check_positions()
            self.operation.begin(shape, source.dtype)
        self.positions: Mapping[str, bool] = self.operation.positions
        rocks = source.motion == "axial" and source.header.tilt is None
        self.position: str = "tilt" if rocks else POSITIONS[source.motion]
        self.updates_per_second: float = self.operation.updates_per_second

    def _check_positions(self) -> None:
        operation, source = self.operation, self._source
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

    @property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return self.operation.room

    def warm(self) -> None:
        """Compile and run all kernels, so that the first frames are not delayed."""
        self.operation.warm()

    def push(self, frames: NDArray[Any], **positions: Any) -> None:
        """Process the next frames."""
        with naming(self._source):
            self.operation.push(frames, **positions)

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return the maps of the frames so far for a display; none before they are determined."""
        try:
            with naming(self._source):
                preview = self.operation.preview(seconds)
        except InputError:
            return {}
        names = {}
        if isinstance(preview, Result):
            names = {name: preview.name_of(name) or name for name in _SHOWN}
        maps = {name: preview.get(names.get(name, name)) for name in _SHOWN}
        if maps["offset_unknown"] is not None:  # one flag per piece, or one for all
            maps["offset_unknown"] = bool(np.any(maps["offset_unknown"]))
        contact, size = maps["contact"], self._source.header.pixel_size
        area = None if contact is None or size is None else float(np.count_nonzero(contact)) * math.prod(size)
        available = {**maps, "contact_area": area}.items()
        return cast(Maps, {name: value for name, value in available if value is not None})

    def spare(self, seconds: float) -> None:
        """Do low-priority work, for some seconds at most."""
        self.operation.spare(seconds)

    def reset(self) -> None:
        """Forget the frames so far."""
        self.operation.reset()

    def result(self) -> Result:
        """Return all maps of the frames so far, with provenance.

        Raises
        ------
        mirrorskin.io.InputError
            The frames do not determine them.
        """
        with naming(self._source):
            process = {"live": True, **({"every": self.every} if self.every > 1 else {})}
            result = self._plan.finish(self.operation.result(), self._source, process)
        return undistorted(result, self._source)


def _live_plan(source: LiveSource, operation: Operation | Method, size: int) -> Plan:
    """Return the plan for a source; ``size`` is the largest number of bytes of a push."""
    check_motion(source, operation)
    if isinstance(operation, Method):
        plan = operation.live_plan(source)
    else:
        configured = operation.configured_for(source)
        plan = Plan(configured, process=describe(configured, source))
    return replace(plan, operation=plan.operation.with_options(memory_limit=2 * size))
