"""The trajectory of a stage from rest to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.io.base.types import Floats

_RAMP = 0.1  # assumed acceleration time of a stage, seconds, before it is known


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """A trajectory from rest to rest with a trapezoidal speed profile.

    It may consist of several equal legs, each from rest to rest.
    """

    length: float  # total of all legs, mm or radians, above 0
    speed: float  # speed in the middle of a leg, mm/s or rad/s; not reached on a short leg
    acceleration: float
    legs: int = 1

    @classmethod
    def planned(cls, length: float, speed: float, legs: int = 1) -> Trapezoid:
        """Return a trajectory with an assumed acceleration."""
        return cls(length, speed, speed / _RAMP, legs)

    @property
    def leg(self) -> float:
        """Length of a leg."""
        return self.length / self.legs

    @property
    def ramp(self) -> float:
        """Duration of the acceleration, seconds."""
        return min(self.speed, math.sqrt(self.leg * self.acceleration)) / self.acceleration

    @property
    def duration(self) -> float:
        """Total duration, seconds."""
        return self.legs * self._leg_duration

    @property
    def _leg_duration(self) -> float:
        return self.leg / (self.acceleration * self.ramp) + self.ramp

    def place(self, time: ArrayLike) -> Floats:
        """Return the distance travelled after a time, seconds; constant before start and after end."""
        t = np.clip(np.asarray(time, np.float64), 0, self.duration)
        number = np.clip(t // self._leg_duration, 0, self.legs - 1)
        t = t - number * self._leg_duration
        remaining = self._leg_duration - t
        up, down = np.minimum(t, self.ramp), np.minimum(remaining, self.ramp)
        cruise = self.acceleration * self.ramp * (t - self.ramp / 2)
        early, late = self.acceleration / 2 * up**2, self.leg - self.acceleration / 2 * down**2
        return number * self.leg + np.where(
            t < self.ramp, early, np.where(remaining < self.ramp, late, cruise)
        )

    def time(self, place: ArrayLike) -> Floats:
        """Return the time at which a distance is reached, seconds; the inverse of ``place``."""
        s = np.clip(np.asarray(place, np.float64), 0, self.length)
        number = np.clip(s // self.leg, 0, self.legs - 1)
        s = s - number * self.leg
        remaining = np.maximum(self.leg - s, 0)
        ramp_end = self.acceleration / 2 * self.ramp**2
        early = np.sqrt(2 * s / self.acceleration)
        late = self._leg_duration - np.sqrt(2 * remaining / self.acceleration)
        cruise = s / (self.acceleration * self.ramp) + self.ramp / 2
        within = np.where(s < ramp_end, early, np.where(remaining < ramp_end, late, cruise))
        return number * self._leg_duration + within
