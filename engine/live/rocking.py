"""A body that rocks in progress: the slope along its way, of all frames so far."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.live.press import area_of
from mirrorskin.engine.live.status import Maps
from mirrorskin.engine.provenance import attach_provenance, naming
from mirrorskin.engine.reconstruction import undistorted
from mirrorskin.engine.rotation.normals_kernel import options_from
from mirrorskin.engine.rotation.normals_pose import PoseEstimator, PoseNormals
from mirrorskin.engine.rotation.rotation import rotation_at_poses, rotation_maps
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError, LiveSource, Result
from mirrorskin.io.types import body_axes
from mirrorskin.kernels.device import Device

_UPDATES = 15.0  # a second, as many as people follow
_FEWEST = 4  # frames of an update: 3 determine a slope, and no noise
_WARMING = 8  # frames


class LiveRocking(ThreadSafe):
    """The slope along the way that the body rocks; see `mirrorskin.engine.live.LiveEstimator`.

    Frames are estimated in windows of 64, and what they say is averaged; see `PoseEstimator`.

    Parameters
    ----------
    source : LiveSource
        Of axial motion with a tilt of each frame, and a zenith gain.
    noise, device
        As for ``estimate_normals``.

    Raises
    ------
    mirrorskin.io.InputError
        The source is of another motion or has no zenith gain, or parameters cannot be used.
    """

    position = "pose"
    every = 1
    most_updates = _UPDATES

    def __init__(
        self, source: LiveSource, *, noise: float | None = None, device: str | Device | None = None
    ) -> None:
        header = source.header
        if source.motion != "axial" or header.tilt is not None:
            raise InputError(f"{source.name} does not rock: slopes take an axial motion with a tilt a frame")
        if header.zenith_gain is None:
            raise InputError(f"{source.name} has no zenith gain, so no slopes: zenith_gain in the rig file")
        self._source, self._frames = source, 0
        options = options_from(header, "exact", noise, None, device)
        self._estimator = PoseEstimator(source.shape[1:], source.dtype, **options)
        self.device: Device = self._estimator.device

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W)."""
        return self._estimator.room

    def warm(self) -> None:
        """Rock a plane, and forget it."""
        tilts = np.linspace(-0.05, 0.05, _WARMING)
        level = np.random.default_rng(0).normal(100, 1, (_WARMING, *self._source.shape[1:]))
        frames = (level + 500 * tilts[:, np.newaxis, np.newaxis]).astype(self._source.dtype)
        self.push(frames, pose=body_axes(np.zeros(_WARMING), tilts))
        self.maps()
        self.reset()

    def push(self, frames: NDArray[Any], *, pose: ArrayLike, lent: bool = False) -> None:
        """Take in the next frames; see `PoseEstimator.push`."""
        with naming(self._source):
            self._estimator.push(frames, pose=pose, lent=lent)
        self._frames += len(frames)

    def maps(self, seconds: float = math.inf, /) -> Maps:
        """Return the slope and the contact of the frames so far; none before they determine a slope."""
        if self._frames < _FEWEST:
            return {}
        try:
            found = self._normals()
        except InputError:  # such as frames before the body rocks
            return {}
        return {
            "slope": found.slope,
            "contact": found.contact,
            "contact_area": area_of(found.contact, self._source),
        }

    def spare(self, seconds: float) -> None:
        """Do nothing: nothing can wait."""

    def reset(self) -> None:
        """Forget the frames so far."""
        self._estimator.reset()
        self._frames = 0

    def result(self) -> Result:
        """Return the maps of all frames, and how they were found.

        Raises
        ------
        mirrorskin.io.InputError
            The frames determine no slope.
        """
        with naming(self._source):
            found = rotation_at_poses(self._normals(), self.device)
        result = attach_provenance(
            rotation_maps(found), self._source, self.device, {**found.process, "live": True}
        )
        return undistorted(result, self._source)

    def _normals(self) -> PoseNormals:
        found = self._estimator.result()
        assert isinstance(found, PoseNormals)
        return found
