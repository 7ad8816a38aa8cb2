"""A user's own estimator while the body moves."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.estimator import Maker, finish, prepare, wanted
from mirrorskin.engine.live.press import area_of
from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.streaming import Estimator
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError, LiveSource, Result
from mirrorskin.io.layout import POSITIONS

_ROOM = 64  # frames that may wait to be taken at once
_UPDATES = 15.0  # a second
_SHOWN = ("height", "normals", "contact", "edges", "displacement", "slope")


class LiveOwn(ThreadSafe):
    """Maps of a user's own estimator so far; see `mirrorskin.engine.live.LiveEstimator`.

    Parameters
    ----------
    source : LiveSource
    estimator : Estimator, or callable
        As for `mirrorskin.engine.run`; ``push`` may take the position of the motion, such as ``travel``.

    Raises
    ------
    mirrorskin.io.InputError
        The estimator lacks a method, or needs what is not known while the body moves.
    """

    every = 1
    most_updates = _UPDATES

    def __init__(self, source: LiveSource, estimator: Estimator | Maker) -> None:
        self._source, self._shape = source, source.shape[1:]
        self.position: str = POSITIONS[source.motion]
        self.room: NDArray[Any] = np.empty((_ROOM, *self._shape), source.dtype)
        self._estimator = prepare(estimator, self._shape, source.dtype)
        self.device: Any = getattr(self._estimator, "device", None)
        self._wanted = wanted(self._estimator, {self.position: None, "lent": False}, f"{source.name}, live,")

    def warm(self) -> None:
        """Push a frame of nothing, and forget it."""
        place: Any = {self.position: np.zeros((1, 2) if self.position == "displacement" else 1)}
        self.push(np.zeros((1, *self._shape), self._source.dtype), **place)
        self.maps()
        self.reset()

    def push(self, frames: NDArray[Any], *, lent: bool = False, **place: Any) -> None:
        """Take in the next frames; see `Estimator`."""
        known = {"lent": lent, **place}
        self._estimator.push(frames, **{name: known[name] for name in self._wanted})

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return those of the maps so far that a viewer shows; none as long as the estimator refuses."""
        try:
            found = finish(self._estimator, self._shape, None)
        except InputError:
            return {}
        area = None if found.contact is None else area_of(found.contact, self._source)
        return cast(Maps, {name: getattr(found, name) for name in _SHOWN} | {"contact_area": area})

    def spare(self, seconds: float) -> None:
        """Do nothing: nothing can wait."""

    def reset(self) -> None:
        """Forget the frames so far."""
        self._estimator.reset()

    def result(self) -> Result:
        """Return the maps of all frames; see `mirrorskin.engine.run`."""
        found = finish(self._estimator, self._shape, self._source)
        return found.assign(process={**found.process, "live": True})
