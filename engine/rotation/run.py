"""Passes over the frames of a rotation: one if its pixels are linear, two if places count as well."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mirrorskin.engine.nearest import with_nearest
from mirrorskin.engine.provenance import naming
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.first_turn import FirstTurn
from mirrorskin.engine.rotation.launch import NormalMethod
from mirrorskin.engine.rotation.normals import NormalEstimator, Normals
from mirrorskin.engine.rotation.options import options_of
from mirrorskin.engine.rotation.phases import Doubles
from mirrorskin.engine.rotation.registration import Registered, check_heights
from mirrorskin.engine.rotation.response import HALF_WAY, Response, first_response
from mirrorskin.engine.rotation.standing import standing_heights
from mirrorskin.engine.rotation.turns import LONGEST, longest_turn
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.io import Header, ProcessValue, Source, WallResponse
from mirrorskin.kernels.device import Device

_REACH = 5  # pixels across, of which a registered sample may be made
_ROUNDS = 2  # in which it is found how high the object stands


@dataclass(frozen=True, slots=True)
class Found:
    """What a run tells; see ``mirrorskin.engine.rotation.axial.Rotation``."""

    normals: Normals
    white: NDArray[np.float32]
    edges: NDArray[np.uint8]
    systematic: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """How a rotation is to be told.

    Attributes
    ----------
    source : Source
    header : Header
        What to believe of it; a tilt of None is one to estimate.
    device : Device
    method, noise, per_turn, memory_limit, progress
        As for ``reconstruct_rotation``.
    """

    source: Source
    header: Header
    device: Device
    method: NormalMethod
    noise: float | None
    per_turn: bool
    memory_limit: int
    progress: Progress | None

    def linear(self, heights: ArrayLike | None) -> Found:
        """Tell the normals of pixels that are linear in the zenith; registered, if there are heights."""
        frames: Source = self.source
        if heights is not None:
            frames = Registered(self.source, heights, self.device, self.header)
        return self._told(frames, self._normals(frames, None, self.per_turn, self.progress))

    def calibrated(
        self, wall: WallResponse, heights: ArrayLike | None
    ) -> tuple[Found, dict[str, ProcessValue]]:
        """Tell the normals under a wall, and how.

        Where a pixel looks depends on the height of what it sees. Heights that are not given are found in the
        first turn; see `standing_heights`. Frames are registered with them where the pivot is known.
        """
        response = first_response(wall, self.source, self.header)
        if heights is not None:
            known = check_heights(heights, self.source.shape[1:])
            how, stand = "given", with_nearest(known).astype(np.float64)
        elif self.source.rewindable:
            how, stand = "found in the first turn", self._stand(response)
        else:
            how, stand = "half the press: the source cannot be read twice", self._half_way()
        frames, response = self._placed_at(self.source, response, stand)
        found = self._told(frames, self._normals(frames, response, self.per_turn, self.progress))
        process: dict[str, ProcessValue] = {
            "zenith": "calibrated",
            "zenith_error": wall.error,
            "heights": how,
            "registered": isinstance(frames, Registered),
        }
        return replace(found, systematic=response.sigma), process

    def _stand(self, response: Response) -> Doubles:
        """Find from the first turn how high the object is, less the press, (H, W), mm."""
        pixel_size, press = self.header.pixel_size, self.header.press
        assert pixel_size is not None
        assert press is not None
        turn, heights = FirstTurn(self.source), self._half_way()
        for _ in range(_ROUNDS):
            frames, response = self._placed_at(turn, response, heights)
            normals = self._normals(frames, response, False, None)
            maps = normals.vectors, normals.contact, response.level(normals.mean)
            heights = standing_heights(*maps, pixel_size, press, self.device) - press
        return heights

    def _half_way(self) -> Doubles:
        """Return the height of an object of which nothing is known yet, less the press, (H, W), mm."""
        assert self.header.press is not None
        return np.full(self.source.shape[1:], -HALF_WAY * self.header.press)

    def _placed_at(self, source: Source, response: Response, heights: Doubles) -> tuple[Source, Response]:
        """Return frames that follow an object of known heights, mm, if they can, and the response to them."""
        follows = self.header.pivot is not None and self.header.tilt is not None
        assert self.header.press is not None
        response = response.at(self.header.press + heights, follows)
        if follows:
            levels = self._levels(response)
            return Registered(source, heights, self.device, levels, response.sight), response
        return source, response

    def _levels(self, response: Response) -> Header:
        """Return the header with each pixel's counts without light, and for full light, as a scale."""
        offset, per_count = response.planes[:2]
        return replace(self.header, zenith_offset=offset, zenith_gain=1 / per_count)

    def _normals(
        self, frames: Source, response: Response | None, per_turn: bool, progress: Progress | None
    ) -> Normals:
        """Feed the frames through an estimator."""
        size = math.prod(frames.shape) * frames.dtype.itemsize
        with naming(self.source):
            estimator = NormalEstimator(
                frames.shape[1:],
                frames.dtype,
                longest=_longest_turn(frames),
                per_turn=per_turn,
                memory_limit=min(self.memory_limit, 2 * size),
                **options_of(self.header, self.method, self.noise, response, self.device),
            )
            feed(frames, estimator, range(frames.shape[0]), progress)
            return estimator.result()

    def _told(self, frames: Source, normals: Normals) -> Found:
        """Find the edges, and account for a registration."""
        edges = _edges(normals, self.device)  # where contact ends, before that is moved inwards
        white = normals.sigma
        if isinstance(frames, Registered):
            white = white if self.noise is not None else white / frames.noise_gain
            normals = _mend(normals, frames.noise_gain, given=self.noise is not None)
        return Found(normals, white, edges)


def _edges(normals: Normals, device: Device) -> NDArray[np.uint8]:
    """Find the edges of each turn, or of their mean."""
    maps = normals.vectors, normals.sigma, normals.contact
    if normals.contact.ndim == 2:
        return find_edges(*maps, device=device)
    return np.stack([find_edges(*turn, device=device) for turn in zip(*maps, strict=True)])


def _longest_turn(source: Source) -> int:
    """Return how many frames a turn may have: as many as they have, where that is known beforehand."""
    phase: NDArray[np.float64] | None = getattr(source, "phase", None)
    return LONGEST if phase is None else longest_turn(phase)


def _mend(normals: Normals, noise_gain: NDArray[np.float32], given: bool) -> Normals:
    """Account for what interpolation did to a pixel's noise, and where it reached beyond the contact.

    Noise that was told from the frames themselves knows of the former. Samples are made of 4 x 4, of which
    two on either side may have lost contact.
    """
    reach = np.ones((1,) * (normals.contact.ndim - 2) + (_REACH, _REACH), bool)
    lost = np.isfinite(normals.sigma) & (normals.contact == 0)
    inside = normals.contact * ~ndimage.binary_dilation(lost, reach)
    sigma = normals.sigma * noise_gain if given else normals.sigma
    return replace(normals, sigma=sigma, contact=inside)
