"""A press in progress: the height map grows as contact spreads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.press.press import add_hysteresis, finish_press
from mirrorskin.engine.press.strokes import StrokeSearch
from mirrorskin.engine.provenance import attach_provenance, level_origin
from mirrorskin.engine.reconstruction import undistorted
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError, LiveSource, Result
from mirrorskin.io.maps import PressStatus
from mirrorskin.io.types import ProcessValue
from mirrorskin.kernels.device import Device

_ROOM = 64  # frames that may wait to be taken at once
_UPDATES = 15.0  # a second, as many as people follow; each costs as much as many frames


class LivePress(ThreadSafe):
    """Heights of a press so far, by `StrokeSearch`; see `mirrorskin.engine.live.LiveEstimator`.

    Parameters
    ----------
    source : LiveSource
        Of vertical motion; its header's references are used.
    threshold, hold, subframe, noise, device
        As for ``find_onset``.
    fill : bool
        Whether to fill holes in the result; see ``reconstruct_press``.

    Raises
    ------
    mirrorskin.io.InputError
        The source is of another motion, or parameters cannot be used.
    """

    device: Device
    room: NDArray[Any]

    position = "travel"
    every = 1
    most_updates = _UPDATES

    def __init__(
        self,
        source: LiveSource,
        *,
        threshold: float = 0.5,
        hold: int = 2,
        subframe: bool = True,
        noise: float | None = None,
        fill: bool = True,
        device: str | Device | None = None,
    ) -> None:
        if source.motion != "vertical":
            raise InputError(f"{source.name} is of {source.motion} motion: heights of a press are vertical")
        self._source, self._threshold, self._fill = source, threshold, fill
        self._process: dict[str, ProcessValue] = {
            "event": "onset",
            "method": "threshold",
            "threshold": threshold,
            "hold": hold,
            "subframe": subframe,
            "dark": level_origin(source, "dark"),
            "bright": level_origin(source, "bright"),
        }
        shape = source.shape[1:]
        self._search = StrokeSearch(
            shape,
            source.dtype,
            dark=source.header.dark,
            bright=source.header.bright,
            threshold=threshold,
            hold=hold,
            subframe=subframe,
            noise=noise,
            device=device,
            memory_limit=2 * _ROOM * math.prod(shape) * source.dtype.itemsize,
        )
        self.device, self.room = self._search.device, self._search.room

    def warm(self) -> None:
        """Push frames of nothing, and forget them."""
        for step in (0.0, 1.0, 2.0, 1.0, 0.0):
            self.push(np.zeros((1, *self._source.shape[1:]), self._source.dtype), travel=[step])
            self.maps()
        self.reset()

    def push(self, frames: NDArray[Any], *, travel: ArrayLike | None, lent: bool = False) -> None:
        """Take in the next frames; see `StrokeSearch.push`."""
        self._search.push(frames, travel=travel, lent=lent)

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return the heights so far; none before the second frame."""
        if len(self._search.travel) < 2:
            return {}
        onset = self._search.onset()
        contact = np.asarray(np.isin(onset.status, (PressStatus.ONSET, PressStatus.LIGHT_AT_START)), np.uint8)
        return {"height": onset.height, "contact": contact, "contact_area": area_of(contact, self._source)}

    def spare(self, seconds: float) -> None:
        """Do nothing: nothing can wait."""

    def reset(self) -> None:
        """Forget the frames so far."""
        self._search.reset()

    def result(self) -> Result:
        """Return the heights, with holes filled if ``fill`` says so, and how they were found.

        Of a press that turned back there is the hysteresis as well.

        Raises
        ------
        mirrorskin.io.InputError
            There were fewer than two frames.
        """
        found, travel = self._search.result(), self._search.travel
        onset = found.onset
        process = self._process | {"first_frame": 0, "frames": len(travel), "noise": onset.noise}
        result, done = finish_press(onset, self._source, travel, "onset", self._threshold, self._fill)
        if found.strokes > 1:
            result, done = add_hysteresis(result, found, "onset"), done | {"strokes": found.strokes}
        signed = attach_provenance(result, self._source, self.device, process | done | {"live": True})
        return undistorted(signed, self._source)


def area_of(contact: ArrayLike, source: LiveSource) -> float | None:
    """Return the area in contact, mm^2, if the pixels' size is known."""
    size = source.header.pixel_size
    return None if size is None else float(np.count_nonzero(contact)) * size[0] * size[1]
