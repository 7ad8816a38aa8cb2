"""What a precession makes of balls and plates, as numbers that can be fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball.scene import rotations
from mirrorskin.engine.calibration.ball.search import Followed
from mirrorskin.engine.calibration.tilt.tracks import Tilts

Doubles = NDArray[np.float64]

NAMES = ("tilt", "phase_offset", "oval_x", "oval_y", "centre_x", "centre_y", "pivot_x", "pivot_y", "pivot_z")
"""The body's parameters, by which each vector begins; then come three of each ball, and two of each wedge."""

AWAY, DEEP, PLATE = 0, 1, 2
"""Kinds of residuals: of a ball's x and y, of its z, and of a plate's zenith."""

_HALF = 0.5  # share of the tilt that one begins with, as its standard error
_WEAK = np.array([0.0, 10.0, 1.0, 1.0, 0.2, 0.2, 1e3, 1e3, 1e3])  # no more is taken for known beforehand
_LEVEL = np.zeros(2)
_NOWHERE = 1e-9  # standard error of what is not free


@dataclass(frozen=True, slots=True, eq=False)
class BallTrack:
    """A ball's places in the frames of a turn; `phase` (T,) in radians, as the recording says."""

    phase: Doubles
    seen: Followed


@dataclass(frozen=True, slots=True, eq=False)
class PlateTrack:
    """A plate's zeniths in the frames of a turn, and whether it is level."""

    phase: Doubles
    seen: Tilts
    level: bool


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Residuals of tracks, by the parameters of a precession of a given direction.

    The body leans by ``l = centre + tilt (u(a) + oval)`` with a = direction phase + phase_offset, u(a) =
    (cos a, sin a), and oval = (gx cos a + gy sin a, gy cos a - gx sin a), which makes an ellipse of the
    circle: (gx, gy) is the ellipticity times (cos, sin) of twice the azimuth of its major axis.

    Attributes
    ----------
    balls, plates
        The tracks.
    direction : {1, -1}
    free_centre : bool
        Whether the mean lean is looked for, or the mean pose taken for upright.
    """

    balls: Sequence[BallTrack]
    plates: Sequence[PlateTrack]
    direction: int
    free_centre: bool

    def lean(self, parameters: Doubles, phase: Doubles) -> Doubles:
        """Return how the body leans, (T, 2), radians."""
        tilt, offset, oval_x, oval_y, x, y = parameters[:6]
        angle = self.direction * phase + offset
        cosine, sine = np.cos(angle), np.sin(angle)
        along = x + tilt * (cosine + oval_x * cosine + oval_y * sine)
        across = y + tilt * (sine + oval_y * cosine - oval_x * sine)
        return np.stack([along, across], axis=1)

    def residuals(self, parameters: Doubles, start: Doubles) -> Doubles:
        """Return what is left, in standard errors, then how far parameters are from a start, (n,)."""
        phases = [ball.phase for ball in self.balls] + [plate.phase for plate in self.plates]
        turns = rotations(self.lean(parameters, np.concatenate(phases)))
        each = np.split(turns, np.cumsum([len(phase) for phase in phases])[:-1])
        places = parameters[len(NAMES) : len(NAMES) + 3 * len(self.balls)].reshape(-1, 3)
        left = [
            _of_ball(track, turn, place, parameters[6:9])
            for track, turn, place in zip(self.balls, each, places, strict=False)
        ]
        wedges = iter(parameters[len(NAMES) + places.size :].reshape(-1, 2))
        for track, turn in zip(self.plates, each[len(self.balls) :], strict=True):
            left.append(_of_plate(track, turn, _LEVEL if track.level else next(wedges)))
        weak = np.full(len(parameters), 1e3)
        weak[: len(_WEAK)] = _WEAK
        weak[0] = _HALF * start[0]
        if not self.free_centre:
            weak[4:6] = _NOWHERE
        return np.concatenate([*left, (parameters - start) / weak])

    def kinds(self) -> NDArray[np.intp]:
        """Return of which kind the residuals are that come before the parameters', (n,)."""
        kinds: list[NDArray[np.intp]] = []
        for track in self.balls:
            known = int(np.isfinite(track.seen.centres[:, 0]).sum())
            kinds.append(np.tile([AWAY, AWAY, DEEP], known))
        kinds += [np.full(len(track.phase), PLATE) for track in self.plates]
        return np.concatenate(kinds)


def _of_ball(track: BallTrack, turns: Doubles, place: Doubles, pivot: Doubles) -> Doubles:
    """Return what is left of a ball's places, in standard errors."""
    left = (track.seen.centres - pivot - turns @ (place - pivot)) / track.seen.sigma
    return np.asarray(left[np.isfinite(left[:, 0])].ravel())


def _of_plate(track: PlateTrack, turns: Doubles, inclined: Doubles) -> Doubles:
    """Return what is left of a plate's zeniths, in standard errors."""
    # A body that leans by l sees an upright normal as one that is inclined by |l| towards l.
    normal = turns @ rotations(inclined[np.newaxis])[0, :, 2]
    zenith = np.arctan2(np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2), normal[:, 2])
    return np.asarray((track.seen.zenith - zenith) / track.seen.sigma)
