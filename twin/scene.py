"""The light of each pixel at a position of the body."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats
from mirrorskin.twin.movement import Pose
from mirrorskin.twin.skin import Sheet

Light = NDArray[np.float32]
Shade = Callable[[Light, Floats, Pose, float], Light]

_BLUR_POSES = 5  # number of poses that represent the exposure of a moving body
_BLUR = (np.arange(_BLUR_POSES) + 0.5) / _BLUR_POSES - 0.5  # their times, as shares of the exposure


class Skin(Protocol):
    """The shape of the sheet in a pose."""

    def drape(self, pose: Pose, /) -> Sheet:
        """Return the sheet in a pose."""


class Optics(Protocol):
    """The light that the camera sees in the mirror."""

    def light(self, sheet: Sheet, /) -> Light:
        """Return the share of full light of each pixel, (H, W), float32."""


class Scene:
    """The light of the body in any pose.

    The light of the latest poses is cached, so that recurring poses, as in a rotation, are rendered once. An
    upright body at its own position is rendered by the `Imprint`, if there is one.

    Parameters
    ----------
    skin, optics
        Models of the sheet's shape and of its light.
    exposure : float
        Exposure, in the unit of the moments.
    kept_poses : int
        Number of poses whose light is cached, at least 1.
    imprint : Imprint, optional
    shade : callable, optional
        Turns a light into what is seen of it, by the sheet's height, the pose and the moment, where that
        depends on what was before.

    Attributes
    ----------
    moments : list of float
        Times of the poses that represent an exposure, from its middle.
    """

    def __init__(
        self,
        skin: Skin,
        optics: Optics,
        exposure: float = 0.0,
        kept_poses: int = _BLUR_POSES,
        imprint: Imprint | None = None,
        shade: Shade | None = None,
    ) -> None:
        self._skin, self._optics, self._imprint, self._shade = skin, optics, imprint, shade
        self._ends = [0.0]
        self.moments: list[float] = [0.0]
        if exposure > 0:
            self._ends = [-exposure / 2, 0.0, exposure / 2]
            self.moments = (exposure * _BLUR).tolist()
        self._room = max(1, kept_poses)
        self._kept: dict[bytes, tuple[Light, Floats | None]] = {}

    def light(self, pose_at: Callable[[float], Pose], middle: float = 0.0) -> Light:
        """Return the mean light over an exposure, (H, W), float32; it is valid until the next call.

        ``pose_at`` returns the pose at a time after the exposure's middle.
        """
        if self._imprint is not None:
            poses = [pose_at(late) for late in self._ends]
            if all(pose.upright and not pose.shift[:2].any() for pose in poses):
                return self._imprint.light(*(float(pose.shift[2]) for pose in poses))
        lights = [self._at(pose_at(late), middle + late) for late in self.moments]
        return lights[0] if len(lights) == 1 else np.mean(lights, axis=0, dtype=np.float32)

    def render_ahead(self, poses: Iterable[Pose], meanwhile: Callable[[], object]) -> None:
        """Render future poses in a thread, as many as are cached, while a function runs."""
        thread = ThreadPoolExecutor(max_workers=1)
        try:
            rendered = [thread.submit(self._render, pose) for pose in itertools.islice(poses, self._room)]
            meanwhile()
            for light in rendered:
                light.result()
        finally:
            thread.shutdown(cancel_futures=True)

    def _at(self, pose: Pose, moment: float) -> Light:
        light, height = self._render(pose)
        return light if self._shade is None or height is None else self._shade(light, height, pose, moment)

    def _render(self, pose: Pose) -> tuple[Light, Floats | None]:
        key = _key(pose)
        if key not in self._kept:
            sheet = self._skin.drape(pose)
            light = self._optics.light(sheet)
            if len(self._kept) >= self._room:
                self._kept.pop(next(iter(self._kept)))  # the oldest
            self._kept[key] = light, sheet.height if self._shade else None
        return self._kept[key]


class Witness:
    """A skin that records where it has touched in all poses so far, (H, W), and the force in each, N."""

    def __init__(self, skin: Skin, shape: tuple[int, int]) -> None:
        self.touched: NDArray[np.bool_] = np.ones(shape, bool)
        self._skin = skin
        self._forces: dict[bytes, float] = {}

    def drape(self, pose: Pose) -> Sheet:
        """Return the sheet in a pose."""
        sheet = self._skin.drape(pose)
        self.touched &= sheet.contact
        self._forces[_key(pose)] = sheet.force
        return sheet

    def force(self, pose: Pose) -> float:
        """Return the normal force in a pose, computed if it is new; NaN without contact mechanics."""
        if _key(pose) not in self._forces:
            self.drape(pose)
        return self._forces[_key(pose)]


def _key(pose: Pose) -> bytes:
    return pose.rotation.tobytes() + pose.shift.tobytes()


class Imprint:
    """A press without resistance, seen from straight above, whose light depends on the slope only.

    A pixel in contact then looks the same at any depth, and a frame needs only its travel. The imprint is the
    object's ``height``, mm, NaN where there is none, and the light of each pixel in contact and out of it.
    """

    def __init__(self, height: Floats, touched: Light, untouched: Light) -> None:
        self._reached_at = np.where(np.isnan(height), np.inf, -height)
        self._untouched = untouched
        self._gained = touched - untouched
        self._glows = bool(untouched.any())
        # New arrays would cost more in page faults than writing them.
        self._touches, self._light = np.empty(height.shape, bool), np.empty_like(touched)

    def light(self, *passed: float) -> Light:
        """Return the light at one travel, or the mean over an exposure; it is valid until the next call.

        ``passed`` is the travel, or the travels at the exposure's start, middle and end, with constant
        velocity in between, mm.
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
        """Return the share of the time in which a uniform travel exceeds that of the touch, float32."""
        low, high = min(begin, end), max(begin, end)
        if high == low:
            return (low >= self._reached_at).astype(np.float32)
        ahead = (high - self._reached_at).astype(np.float32)
        return np.clip(ahead / np.float32(high - low), 0, 1, out=ahead)
