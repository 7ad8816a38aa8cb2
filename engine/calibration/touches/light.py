"""The light of the pixels of a window, by a response that is linear in the zenith."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.engine.diagnosis.turn_light import GLOBALS, PixelScale, SlopeAngles, light_of
from mirrorskin.kernels.array_types import Doubles

FOOTPRINT = PIXEL + LEAST_BLUR**2
"""Assumed variance of a pixel's footprint, square pixels; the parameter is the relative error of it."""

UNEVEN_TERMS = tuple(f"uneven_{term}" for term in ("x", "y", "xx", "xy", "yy"))
"""Names of the terms of uneven light."""

_OF_MOVEMENT = ("tilt", "phase")


class Seen(NamedTuple):
    """What m pixels see in T frames."""

    slopes: Doubles  # (2, T, m)
    phase: Doubles  # (T, 1): azimuth of the lean, radians
    tilt: Doubles  # (T, 1): half-angle, radians
    changes: tuple[Doubles, Doubles]  # of slopes from column to column and row to row, (2, m)
    heights: Doubles  # (m,) mm
    pivot_z: float  # error of the pivot's assumed height, mm
    gains: Doubles  # (T, 1): of the frames
    offsets: Doubles  # (T, 1)


class Lit(NamedTuple):
    """Light of m pixels in T frames, counts, and its derivatives."""

    counts: Doubles  # (T, m)
    by_slopes: Doubles  # (2, T, m)
    by_gains: Doubles  # (T, m)
    by_tilt: Doubles  # (T, m): per radian
    by_phase: Doubles  # (T, m)
    by_footprint: Doubles  # (T, m)
    by_response: Doubles  # (k, T, m): by the parameters of the response


@dataclass(frozen=True, slots=True, eq=False)
class LinearLight:
    """The light of n pixels by `mirrorskin.engine.diagnosis.turn_light`.

    An error of the zenith offset is light, so that of a pixel is in proportion to its gain.
    """

    gain: Doubles  # (n,)
    base: Doubles  # (n,)
    dark: Doubles  # (n,)
    full: float
    usual: float  # gain of the usual pixel
    places: Doubles  # (5, n): terms of uneven light

    names: ClassVar[tuple[str, ...]] = (
        *(name for name in GLOBALS if name not in _OF_MOVEMENT),
        *UNEVEN_TERMS,
    )

    def of(self, seen: Seen, chosen: NDArray[np.bool_], named: Mapping[str, float]) -> Lit:
        """Return the light of chosen pixels."""
        angles = SlopeAngles.of(seen.slopes, seen.phase, seen.tilt, seen.changes)
        bend = FOOTPRINT * angles.bend
        dark, share = self.dark[chosen], self.gain[chosen] / self.usual
        base = self.base[chosen] + named["zenith_offset"] * (share - 1)
        scale = PixelScale(self.gain[chosen], base, dark, self.full)
        values = np.array([named[name] for name in (*GLOBALS, *UNEVEN_TERMS)])
        light = light_of(
            angles, (1 + named["footprint"]) * bend, scale, seen.gains, seen.offsets, values,
            self.places[:, chosen],
        )  # fmt: skip
        of_movement = [GLOBALS.index(name) for name in _OF_MOVEMENT]
        by_tilt, by_phase = light.by_globals[of_movement]
        light.by_globals[GLOBALS.index("zenith_offset")] *= share
        return Lit(
            light.light + dark,
            light.by_angle * angles.by_slopes,
            light.by_gain,
            by_tilt,
            by_phase,
            light.by_angle * bend,
            np.delete(light.by_globals, of_movement, axis=0),
        )
