"""From where the body is to the light that each pixel gets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.movement import Movement, Pose
from mirrorskin.hw.twin.skin import Sheet
from mirrorskin.io.types import Floats

Light = NDArray[np.float32]
Shade = Callable[[Light, Floats, float], Light]

_BLUR_POSES = 5  # poses that stand for the exposure of a moving body
_BLUR = (np.arange(_BLUR_POSES) + 0.5) / _BLUR_POSES - 0.5  # when, as shares of the exposure


class Skin(Protocol):
    """How the sheet lies in a pose."""

    def drape(self, pose: Pose, /) -> Sheet:
        """Lay the sheet on the object."""


class Optics(Protocol):
    """What the camera sees in the mirror."""

    def light(self, sheet: Sheet, /) -> Light:
        """Return the share of full light of each pixel, (H, W), float32."""


class Scene(Protocol):
    """What is seen in each frame."""

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure, (H, W), float32; not to be written to."""


class CachedScene:
    """Any movement: sheet and optics are found for each place where the body is.

    Places that come back, as those of a rotation do, are kept as long as there is memory for their light.
    ``share`` is the part of the time between frames that an exposure takes. ``shade`` turns that light into
    what is seen of it, by the sheet's height and the time, in frames, where that depends on what was before.
    """

    def __init__(
        self,
        skin: Skin,
        optics: Optics,
        movement: Movement,
        share: float,
        shape: tuple[int, int],
        memory_limit: int,
        shade: Shade | None = None,
    ) -> None:
        self._skin = skin
        self._optics = optics
        self._movement = movement
        self._moments = share * _BLUR if share > 0 else np.zeros(1)
        self._places, self._number = _distinct_places(movement, self._moments)
        each = np.dtype(np.float32).itemsize + (np.dtype(np.float64).itemsize if shade else 0)
        self._room = memory_limit // (each * shape[0] * shape[1])
        self._shade = shade
        self._kept: dict[int, tuple[Light, Floats | None]] = {}
        self._visited = np.zeros(len(self._places), bool)
        self._touched = np.ones(shape, bool)
        self._force = np.full(len(self._places), np.nan)

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure."""
        lights = [
            self._at(place, frame + moment)
            for place, moment in zip(self._number[frame], self._moments, strict=True)
        ]
        return lights[0] if len(lights) == 1 else np.mean(lights, axis=0, dtype=np.float32)

    def touched_throughout(self) -> NDArray[np.bool_]:
        """Return where sheet and object touch in all frames, (H, W); goes to the places not yet seen."""
        for place in np.flatnonzero(~self._visited):
            self._lie(int(place))
        return self._touched

    def forces(self) -> Floats:
        """Return the normal force at the middle of each frame's exposure, (T,), N; NaN if not worked out."""
        middle = self._number[:, self._number.shape[1] // 2]
        for place in np.unique(middle[~self._visited[middle]]):
            self._lie(int(place))
        return self._force[middle]

    def _at(self, place: int, moment: float) -> Light:
        if place not in self._kept:
            sheet = self._lie(place)
            light = self._optics.light(sheet)
            if len(self._kept) >= max(1, self._room):
                self._kept.pop(next(iter(self._kept)))  # the oldest
            self._kept[place] = light, sheet.height if self._shade else None
        light, height = self._kept[place]
        return light if self._shade is None or height is None else self._shade(light, height, moment)

    def _lie(self, place: int) -> Sheet:
        sheet = self._skin.drape(self._movement.pose(self._places[place]))
        self._visited[place], self._force[place] = True, sheet.force
        self._touched &= sheet.contact
        return sheet


class PoseScene:
    """The body wherever it is, for a camera that watches a stage.

    Upright above its own place it is seen by the `Imprint`, where there is one. Of other poses the light of
    the last few is kept: a body that stands still is rendered once. ``shade`` turns that light into what is
    seen of it, by the sheet's height and the pose, where that depends on the poses before.
    """

    def __init__(
        self,
        skin: Skin,
        optics: Optics,
        imprint: Imprint | None,
        exposure: float,
        shade: Callable[[Light, Floats, Pose], Light] | None = None,
    ) -> None:
        self._skin, self._optics, self._imprint, self._shade = skin, optics, imprint, shade
        self._ends = exposure * np.array([-0.5, 0.0, 0.5]) if exposure > 0 else np.zeros(1)
        self._moments = exposure * _BLUR if exposure > 0 else np.zeros(1)
        self._kept: dict[bytes, tuple[Light, Floats]] = {}

    def light(self, pose_at: Callable[[float], Pose], /) -> Light:
        """Return the mean light over an exposure; it holds until the next call.

        ``pose_at`` returns the pose so many seconds after the exposure's middle.
        """
        if self._imprint is not None:
            poses = [pose_at(float(late)) for late in self._ends]
            if all(pose.upright and not pose.shift[:2].any() for pose in poses):
                return self._imprint.light(*(float(pose.shift[2]) for pose in poses))
        lights = [self._at(pose_at(float(late))) for late in self._moments]
        return lights[0] if len(lights) == 1 else np.mean(lights, axis=0, dtype=np.float32)

    def _at(self, pose: Pose) -> Light:
        key = pose.rotation.tobytes() + pose.shift.tobytes()
        if key not in self._kept:
            if len(self._kept) >= _BLUR_POSES:
                self._kept.pop(next(iter(self._kept)))
            sheet = self._skin.drape(pose)
            self._kept[key] = self._optics.light(sheet), sheet.height
        light, height = self._kept[key]
        return light if self._shade is None else self._shade(light, height, pose)


class Imprint:
    """A press without resistance, seen from straight above, under a light that goes by slope alone.

    Then a pixel that touches looks the same however deep it is, and no frame needs more than its travel: of
    the object its ``height``, mm, NaN where there is none, and the light of each pixel in contact and out of
    it.
    """

    def __init__(self, height: Floats, touched: Light, untouched: Light) -> None:
        self._reached_at = np.where(np.isnan(height), np.inf, -height)
        self._untouched = untouched
        self._gained = touched - untouched
        self._glows = bool(untouched.any())
        # Fresh arrays would cost more, by their page faults, than what is written to them.
        self._touches, self._light = np.empty(height.shape, bool), np.empty_like(touched)

    def light(self, *passed: float) -> Light:
        """Return the light at one travel, or the mean over an exposure; it holds until the next call.

        ``passed`` is the travel, or those at the exposure's begin, middle and end, with constant velocity in
        between, mm.
        """
        time: NDArray[Any] = self._touches
        if len(passed) == 1:
            np.greater_equal(passed[0], self._reached_at, out=self._touches)
        else:
            begin, middle, end = passed
            time = (self._time(begin, middle) + self._time(middle, end)) / np.float32(2)
        np.multiply(time, self._gained, out=self._light)
        if self._glows:
            self._light += self._untouched
        return self._light

    def _time(self, begin: float, end: float) -> Light:
        """Return the share of the time in which a steady travel is at least that of the touch, float32."""
        low, high = min(begin, end), max(begin, end)
        if high == low:
            return (low >= self._reached_at).astype(np.float32)
        ahead = (high - self._reached_at).astype(np.float32)
        return np.clip(ahead / np.float32(high - low), 0, 1, out=ahead)


class Press:
    """The frames of a vertical movement, by the `Imprint` of its press."""

    def __init__(self, imprint: Imprint, travel: Floats, share: float) -> None:
        self._imprint = imprint
        ends = np.array([-share / 2, 0.0, share / 2]) if share > 0 else np.zeros(1)
        self._passed = _passed(travel, ends)

    def light(self, frame: int, /) -> Light:
        """Return the mean light over a frame's exposure; it holds until the next call."""
        return self._imprint.light(*map(float, self._passed[frame]))


def _distinct_places(movement: Movement, offsets: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the places where the body is in some exposure, each once, and their numbers of each frame."""
    passed = movement.reduced(_passed(movement.path, offsets))
    count, each, *place = passed.shape
    distinct, number = np.unique(passed.reshape(count * each, -1), axis=0, return_inverse=True)
    return distinct.reshape(-1, *place), number.reshape(count, each)


def _passed(path: Floats, offsets: Floats) -> Floats:
    """Return where the body is so many frames before or after each frame, (T, offsets, ...).

    Its velocity is constant between two frames, and that of the nearest interval before the first and after
    the last.
    """
    steps = np.diff(path, axis=0) if len(path) > 1 else np.zeros_like(path)
    before, after = np.concatenate([steps[:1], steps]), np.concatenate([steps, steps[-1:]])
    late = offsets.reshape(-1, *([1] * (path.ndim - 1)))
    step = np.where(late < 0, before[: len(path), np.newaxis], after[: len(path), np.newaxis])
    return np.asarray(path[:, np.newaxis] + late * step)
