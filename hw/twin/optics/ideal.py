"""How bright the mirror sheet looks under a uniformly lit wall."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats

BODY_DIAMETER = 35.0
BODY_HEIGHT = 40.0
SCATTER = math.radians(3.0)

# A ray reflected at twice the zenith meets the wall below its upper rim, and still goes up.
ZENITH_MIN = math.atan2(BODY_DIAMETER / 2, BODY_HEIGHT) / 2
ZENITH_MAX = math.pi / 4


def uniform_response(zenith: Floats) -> Floats:
    """Return the share of full light that a camera sees from a sheet of given zenith.

    An orthographic camera looks down the axis, so what it sees in a mirror of zenith t lies 2 t off the axis.
    From the sheet's centre that ray meets the lit wall (radius 17.5 mm, height 40 mm) where ::

        tan 2t >= 17.5 / 40  and  2t <= 90 degrees,     that is  t0 = 11.8 degrees <= t <= t1 = 45 degrees

    The sheet scatters the ray evenly over +-3 degrees, which are +-w = 1.5 degrees of zenith, so that the
    window's two edges become ramps 3 degrees wide: the window convolved with a box of half-width w ::

        g(t) = (clip(t + w, t0, t1) - clip(t - w, t0, t1)) / 2w

    The window is the same for the whole field: how it changes off the axis is left out here.

    Parameters
    ----------
    zenith : ndarray, float64
        Radians.

    Returns
    -------
    ndarray, float64
        0 (dark) to 1 (full light), shaped as the zenith; NaN where that is NaN.
    """
    half_width = SCATTER / 2
    upper = np.clip(zenith + half_width, ZENITH_MIN, ZENITH_MAX)
    lower = np.clip(zenith - half_width, ZENITH_MIN, ZENITH_MAX)
    return (upper - lower) / (2 * half_width)
