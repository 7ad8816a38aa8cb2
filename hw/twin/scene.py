"""From where the body is to the light that each pixel gets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.movement import Movement, Pose
from mirrorskin.hw.twin.sheet import Sheet
from mirrorskin.io.types import Floats

Light = NDArray[np.float32]

_BLUR_POSES = 5  # poses that stand for the exposure of a moving body
_BYTES_KEPT = 5  # of each pixel at each place


class Contact(Protocol):
    """How the sheet lies in a pose."""

    def lie(self, pose: Pose, /) -> Sheet:
        """Lay the sheet on the object; poses are asked for in their order."""

    def restart(self) -> None:
        """Begin anew, so that the same poses give the same sheets again."""


class Optics(Protocol):
    """What the camera sees in the mirror."""

    def light(self, sheet: Sheet, /) -> Light:
        """Return the share of full light of each pixel, (H, W), float32."""


class Scene(Protocol):
    """The light of each frame, asked for in order."""

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure, (H, W), float32; not to be written to."""

    def restart(self) -> None:
        """Begin again at the first frame."""


class Film:
    """Any movement: sheet and optics are worked out for each place where the body is.

    Places that come back, as those of a rotation do, are worked out once if the light of all fits in memory;
    else each is worked out when it comes. Which of the two does not depend on how frames are read, and
    neither does the light.

    Parameters
    ----------
    contact : Contact
    optics : Optics
    movement : Movement
    share : float
        Part of the time between frames that an exposure takes.
    shape : (int, int)
        Rows and columns of a frame.
    memory_limit : int
        Bytes that what is kept may take.
    """

    def __init__(
        self,
        contact: Contact,
        optics: Optics,
        movement: Movement,
        share: float,
        shape: tuple[int, int],
        memory_limit: int,
    ) -> None:
        self._contact = contact
        self._optics = optics
        self._movement = movement
        self._shape = shape
        self._places, self._number = _places(movement, share)
        self._keeps = _BYTES_KEPT * shape[0] * shape[1] * len(self._places) <= memory_limit
        self._seen: dict[int, _Seen] = {}

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure."""
        lights = [self._at(place).light for place in self._number[frame]]
        return lights[0] if len(lights) == 1 else np.mean(lights, axis=0, dtype=np.float32)

    def touched_throughout(self) -> NDArray[np.bool_]:
        """Go through the whole movement, and return where sheet and object touch all the time, (H, W)."""
        self.restart()
        touched = np.ones(self._shape, bool)
        for place in range(len(self._places)):
            touched &= self._at(place).contact
        self.restart()
        return touched

    def restart(self) -> None:
        """Begin again at the first frame."""
        if not self._keeps:
            self._contact.restart()
            self._seen.clear()

    def _at(self, place: int) -> _Seen:
        if place not in self._seen:
            if not self._keeps:
                self._seen.clear()
            sheet = self._contact.lie(self._movement.pose(self._places[place]))
            self._seen[place] = _Seen(self._optics.light(sheet), sheet.contact)
        return self._seen[place]


class _Seen(NamedTuple):
    """What is kept of a place."""

    light: Light
    contact: NDArray[np.bool_]


class Press:
    """A press without resistance, seen from straight above, under a light that goes by slope alone.

    Then a pixel that touches looks the same however deep it is, and no frame needs more than its travel.

    Parameters
    ----------
    height : ndarray, (H, W), float64
        Of the object, mm; NaN where there is none.
    touched, untouched : ndarray, (H, W), float32
        Light of each pixel in contact and out of it.
    travel : ndarray, (T,), float64
        Millimetres.
    share : float
        Part of the time between frames that an exposure takes.
    """

    def __init__(
        self, height: Floats, touched: Light, untouched: Light, travel: Floats, share: float
    ) -> None:
        self._reached_at = -height
        self._untouched = untouched
        self._gained = touched - untouched
        self._travel = travel
        self._share = share

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure."""
        time: NDArray[Any] = self._travel[frame] >= self._reached_at
        if self._share > 0:
            time = _contact_time(_path(self._travel, frame, self._share), self._reached_at)
        light: Light = self._untouched + time * self._gained
        return light

    def restart(self) -> None:
        """Begin again: nothing is kept."""


def _contact_time(path: Sequence[tuple[float, float, float]], reached_at: Floats) -> Light:
    """Return the share of an exposure in which the travel is at least so much.

    ``path`` has the exposure's pieces of constant velocity: their shares of the time, and the travel at
    either end.
    """
    time = np.zeros(reached_at.shape, np.float32)
    for share, begin, end in path:
        low, high = min(begin, end), max(begin, end)
        if high == low:
            time += np.where(low >= reached_at, share, 0.0).astype(np.float32)
        else:
            passed = np.clip((high - reached_at) / (high - low), 0.0, 1.0)
            time += (share * np.nan_to_num(passed)).astype(np.float32)
    return time


def _path(travel: Floats, frame: int, share: float) -> list[tuple[float, float, float]]:
    """Cut a frame's exposure into the time before its middle and after it, each of constant velocity."""
    begin, middle, end = _between(travel, frame, np.array([-share / 2, 0.0, share / 2]))
    return [(0.5, float(begin), float(middle)), (0.5, float(middle), float(end))]


def _places(movement: Movement, share: float) -> tuple[Floats, NDArray[np.intp]]:
    """Return the places where the body is in some exposure, each once and in the order of their first time.

    Returns
    -------
    places : ndarray, (n, ...), float64
    number : ndarray, (T, m), intp
        Of each frame's m places.
    """
    positions = movement.path
    if share > 0:
        offsets = share * ((np.arange(_BLUR_POSES) + 0.5) / _BLUR_POSES - 0.5)
        passed = np.stack([_between(positions, frame, offsets) for frame in range(len(positions))])
    else:
        passed = positions[:, np.newaxis]
    reduced = movement.reduced(passed)
    flat = reduced.reshape(passed.shape[0] * passed.shape[1], -1)
    _, first, number = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    places = reduced.reshape(-1, *positions.shape[1:])[first[order]]
    return places, rank[number.reshape(-1)].reshape(len(positions), -1)


def _between(positions: Floats, frame: int, offsets: Floats) -> Floats:
    """Return where the body is so many frames before or after a frame, at constant velocity in between.

    Before the first frame and after the last it goes on as it went next to them.
    """
    if len(positions) == 1:
        return np.repeat(positions, len(offsets), axis=0)
    before = min(max(frame - 1, 0), len(positions) - 2)
    after = min(frame, len(positions) - 2)
    steps = np.where(
        (offsets < 0).reshape(-1, *([1] * (positions.ndim - 1))),
        positions[before + 1] - positions[before],
        positions[after + 1] - positions[after],
    )
    return np.asarray(positions[frame] + steps * offsets.reshape(-1, *([1] * (positions.ndim - 1))))
